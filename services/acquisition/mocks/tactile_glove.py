"""Pressures of one hand come in; a glove with its own offsets and gains goes out as packets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import ShapeError
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, Side, expand_taxels
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.tactile_glove import FULL_SCALE_COUNTS, MAGIC
from services.acquisition.mocks.glove_answers import GloveAnswers
from services.acquisition.mocks.replay import ReplayStream, device_rng

OFFSET_COUNTS = 120.0
GAIN_COUNTS_PER_KPA = 40.0
OFFSET_SPREAD_COUNTS = 10.0
GAIN_SPREAD = 0.05


@dataclass(frozen=True)
class GloveCalibration:
    """counts = tare + gain · pressure, cell by cell in raw scan order."""

    tare_counts: Float64[np.ndarray, "360"]
    gain_counts_per_kpa: Float64[np.ndarray, "360"]

    @staticmethod
    def seeded(side: Side, seed: int) -> "GloveCalibration":
        """A glove as it comes from the factory: no two cells alike."""
        rng = device_rng(seed, f"calibration_{side}")
        spread = rng.uniform(-1.0, 1.0, (2, NUM_RAW_TAXELS))
        return GloveCalibration(
            OFFSET_COUNTS + OFFSET_SPREAD_COUNTS * spread[0],
            GAIN_COUNTS_PER_KPA * (1.0 + GAIN_SPREAD * spread[1]),
        )

    def counts(self, taxels_kpa: np.ndarray, *, side: Side) -> np.ndarray:
        """Raw counts (uint16 [..., 360]) of pressures [..., 320]; clipped at full scale."""
        raw_kpa = expand_taxels(np.asarray(taxels_kpa, dtype=np.float64), side=side)
        counts = np.rint(self.tare_counts + self.gain_counts_per_kpa * raw_kpa)
        return np.clip(counts, 0, FULL_SCALE_COUNTS).astype("<u2")


class TactileGloveSource:
    """Packets of one glove.

    Args:
        stream: float32 [n, 320] in kPa.
        side: which hand.
        calibration: of this glove.
        dead_taxels: raw cells that read zero.
        answers: to the host's requests; without it the glove hears nothing.
    """

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        calibration: GloveCalibration,
        dead_taxels: Sequence[int] = (),
        answers: GloveAnswers | None = None,
    ) -> None:
        if stream.descriptor.shape != (NUM_TAXELS,):
            raise ShapeError(
                f"{stream.descriptor.name}: got {stream.descriptor.shape}, expected ({NUM_TAXELS},)"
            )
        self._stream = stream
        self._side = side
        self._answers = answers
        self._counts = calibration.counts(stream.values, side=side)
        self._counts[:, list(dead_taxels)] = 0

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet, and the reply that waited for it, if any."""
        counts = self._counts[index]
        packet = Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, counts.tobytes())
        replies = [] if self._answers is None else self._answers.note_packet(counts)
        return [encode_packet(MAGIC, packet), *replies]
