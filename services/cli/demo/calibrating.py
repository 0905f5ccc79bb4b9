"""Glove calibration of the demo, measured as at a station: a rest take, then known pressures.

The mock gloves know their own tare and gain. The demo does not use that knowledge, so that its
errors contain those of a calibration.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import Matrix, TakePrompt, matrix_rows
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation, MockTake
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.replay import ReplayStream
from services.alignment.calibration.tactile_gain import TaxelPress
from services.alignment.calibration.tactile_glove_calibration import calibrate_glove
from services.alignment.calibration.tactile_tare import measure_tare

PRESSURES_KPA = (10.0, 20.0, 40.0)
# A weight on an area is known to about this share.
PRESSURE_SIGMA = 0.01
PART_S = 2.0
# Readings next to a change of pressure are left out.
MARGIN_S = 0.2


def measure_gloves(
    streams: Sequence[ReplayStream], spool_root: Path, *, seed: int
) -> dict[str, Matrix]:
    """Calibration matrices of the mock gloves that play these streams.

    Args:
        streams: of the take that follows; its gloves are calibrated.
        spool_root: folder for the calibration take.
        seed: of the mock station, whose gloves differ by seed, and of the errors of the pressures.
    """
    gloves = {side: s for s in streams for side in SIDES if s.descriptor.name == f"tactile_{side}"}
    if not gloves:
        return {}
    errors = np.random.default_rng([seed, len(PRESSURES_KPA)]).normal(size=len(PRESSURES_KPA))
    true_kpa = np.array([0.0, *(PRESSURES_KPA * (1 + PRESSURE_SIGMA * errors))])
    with MockStation(
        [_pressed(stream, true_kpa) for stream in gloves.values()],
        FaultScript.first_light(),
        seed,
        VirtualClock(),
        spool_root=spool_root,
    ) as station:
        take = station.run_take(TakePrompt(task="calibration", instruction="press all taxels"))
    found: dict[str, Matrix] = {}
    for side in gloves:
        rest, *pressed = _parts(take, side)
        tare = measure_tare(rest, side=side)
        everywhere = np.ones(NUM_TAXELS, dtype=np.bool_)
        presses = [
            TaxelPress(kpa, PRESSURE_SIGMA * kpa, counts, everywhere)
            for kpa, counts in zip(PRESSURES_KPA, pressed, strict=True)
        ]
        matrices = calibrate_glove(tare, presses).matrices()
        found |= {name: matrix_rows(matrix) for name, matrix in matrices.items()}
    return found


def _pressed(stream: ReplayStream, true_kpa: Float64[np.ndarray, " parts"]) -> ReplayStream:
    """The glove of a stream under one pressure after the other, the same on all taxels."""
    period_ns = stream.descriptor.period_ns()
    per_part = round(PART_S * 1e9 / period_ns)
    values = np.repeat(true_kpa.astype(np.float32), per_part)[:, None]
    t_ns = np.arange(len(values), dtype=np.int64) * period_ns
    return ReplayStream(stream.descriptor, t_ns, np.repeat(values, NUM_TAXELS, axis=1))


def _parts(take: MockTake, side: Side) -> Iterator[Float64[np.ndarray, "time 360"]]:
    """Counts of the rest and of every press."""
    spool = SpoolReader(take.spool_path)
    batch = spool.read(f"tactile_{side}")
    t_s = (batch.t_host_ns - take.ledger.start_host_ns) * 1e-9
    for part in range(1 + len(PRESSURES_KPA)):
        since_s = t_s - part * PART_S
        inside = (since_s >= MARGIN_S) & (since_s <= PART_S - MARGIN_S)
        yield batch.values[inside].astype(np.float64)
