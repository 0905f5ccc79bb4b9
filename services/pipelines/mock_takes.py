"""Takes of the twin recorded by a mock station: packets, real drivers, recorder and spool.

The mock gloves know their own tare and gain, and their script its path delay; all are measured the
same as at a station, by a rest take, known pressures and answers to time requests, so that errors
contain those of a calibration.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from dextouch.episodes.spool import SpoolReader
from dextouch.errors import UnavailableError
from dextouch.schemas import DeviceHealth, Matrix, SaveTake, TakePrompt, matrix_rows
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.mock_station import MockStation, MockTake
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.path_latency import add_latencies
from services.alignment.calibration.tactile_gain import TaxelPress, calibrate_glove
from services.alignment.calibration.tactile_tare import measure_tare

PRESSURES_KPA = (10.0, 20.0, 40.0)
# A weight on an area is known to about this share.
PRESSURE_SIGMA = 0.01
PART_S = 2.0
# Readings next to a change of pressure are left out.
MARGIN_S = 0.2
MAX_MORE_TAKES = 3
CALIBRATION = TakePrompt(task="calibration", instruction="press all taxels")


@dataclass(frozen=True)
class TakePlan:
    """A take to record: what the devices play, what is said about it, and what is calibrated.

    Takes with one `unit_seed` are of one station, with the same gloves and calibration; `seed`
    draws all other errors.
    """

    streams: Sequence[ReplayStream]
    prompt: TakePrompt
    success: bool | None
    calibration: Mapping[str, Matrix]
    recording_id: str
    seed: int
    unit_seed: int


def play_take(
    plan: TakePlan, spool_root: Path, *, station: str
) -> tuple[MockTake, Sequence[DeviceHealth]]:
    """Play a take through all mock devices, with the faults of an ordinary station.

    The clock is virtual, so that equal plans give equal takes.

    Returns:
        The take in the spool, and the health counters of every device.
    """
    with MockStation(
        plan.streams,
        FaultScript.first_light(),
        plan.seed,
        VirtualClock(),
        spool_root=spool_root,
        name=station,
        calibration=plan.calibration,
        unit_seed=plan.unit_seed,
    ) as mock:
        take = mock.run_take(
            plan.prompt,
            recording_id=plan.recording_id,
            how=SaveTake(success=plan.success, accept_incomplete=True),
        )
        return take, mock.station.health.report().devices


def measure_gloves(
    streams: Sequence[ReplayStream],
    spool_root: Path,
    *,
    seed: int,
    clock: StationClock | None = None,
) -> dict[str, Matrix]:
    """Calibration matrices of the mock gloves that play these streams.

    By default the take runs in real time, in which the station asks its gloves for their time, and
    path delays are measured, too. With a virtual clock they are not (a mock station knows them with
    an error), but equal arguments give equal matrices.

    Args:
        streams: of the take that follows; its gloves are calibrated.
        spool_root: folder for the calibration takes.
        seed: of the mock station, whose gloves differ by seed, and of the errors of the pressures.
        clock: of the station.

    Raises:
        UnavailableError: a glove's path delay could not be measured in several takes.
    """
    gloves = {side: s for s in streams for side in SIDES if s.descriptor.name == f"tactile_{side}"}
    if not gloves:
        return {}
    errors = np.random.default_rng([seed, len(PRESSURES_KPA)]).normal(size=len(PRESSURES_KPA))
    true_kpa = np.array([0.0, *(PRESSURES_KPA * (1 + PRESSURE_SIGMA * errors))])
    found: dict[str, Matrix] = {}
    with MockStation(
        [_pressed(stream, true_kpa) for stream in gloves.values()],
        FaultScript.first_light(),
        seed,
        clock or StationClock(),
        spool_root=spool_root,
    ) as station:
        take = station.run_take(CALIBRATION)
        if not isinstance(clock, VirtualClock):
            found = _path_delays(station, [f"tactile_{side}" for side in gloves])
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


def origin_in_truth_ns(
    take: MockTake, *, started_t_host_ns: int, quality: Mapping[str, float]
) -> int:
    """Time 0 of an aligned episode on the time axis of the streams that the devices played."""
    origin_ns = started_t_host_ns + round(quality["origin_after_start_ns"])
    return origin_ns - take.ledger.start_host_ns


def _path_delays(station: MockStation, names: list[str]) -> dict[str, Matrix]:
    """What the station measured by the answers of its gloves; a busy host may need more takes."""
    for _ in range(MAX_MORE_TAKES):
        if set(names) <= set(station.station.paths.latencies()):
            break
        station.run_take(CALIBRATION)
    measured = station.station.paths.latencies()
    missing = sorted(set(names) - set(measured))
    if missing:
        raise UnavailableError(
            f"mock station: the path delays of {', '.join(missing)} could not be measured within "
            f"{1 + MAX_MORE_TAKES} takes; close other programs and run it again"
        )
    return add_latencies({}, {name: measured[name] for name in names}, stated=())


def _pressed(stream: ReplayStream, true_kpa: Float64[np.ndarray, " parts"]) -> ReplayStream:
    """The glove of a stream under one pressure after the other, the same on all taxels."""
    period_ns = stream.descriptor.period_ns()
    per_part = round(PART_S * 1e9 / period_ns)
    values = np.repeat(true_kpa.astype(np.float32), per_part)[:, None]
    t_ns = np.arange(len(values), dtype=np.int64) * period_ns
    return ReplayStream(stream.descriptor, t_ns, np.repeat(values, NUM_TAXELS, axis=1))


def _parts(take: MockTake, side: Side) -> Iterator[Float64[np.ndarray, "time 360"]]:
    """Counts of the rest and of every press."""
    spool, name = SpoolReader(take.spool_path), f"tactile_{side}"
    batch = spool.read(name)
    # By the number of the sample: when it came depends on the machine's other work.
    t_s = batch.sequence * (spool.streams[name].period_ns() * 1e-9)
    for part in range(1 + len(PRESSURES_KPA)):
        since_s = t_s - part * PART_S
        inside = (since_s >= MARGIN_S) & (since_s <= PART_S - MARGIN_S)
        yield batch.values[inside].astype(np.float64)
