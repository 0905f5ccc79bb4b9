"""Raw counts of a glove and its calibration record in, pressures in kPa and dead taxels out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.tactile.layout import NUM_RAW_TAXELS, Side, select_taxels

# A cell that never moves is dead if it rests further than this from its tare.
DEAD_OFFSET_KPA = 1.0
MIN_SAMPLES_TO_JUDGE = 30


@dataclass(frozen=True)
class TactileCalibration:
    """counts = tare + gain · pressure for each of the 360 raw cells of one glove.

    Raises:
        NonFiniteError: NaN or infinity.
        InvalidInputError: a gain that is not positive.
    """

    side: Side
    tare_counts: Float64[np.ndarray, "360"]
    gain_counts_per_kpa: Float64[np.ndarray, "360"]

    def __post_init__(self) -> None:
        for name in ("tare_counts", "gain_counts_per_kpa"):
            if not np.isfinite(getattr(self, name)).all():
                raise NonFiniteError(f"tactile calibration {self.side}: {name} is not finite")
        if not (self.gain_counts_per_kpa > 0).all():
            raise InvalidInputError(
                f"tactile calibration {self.side}: got a gain of "
                f"{self.gain_counts_per_kpa.min():g} counts/kPa, expected all above 0"
            )

    @classmethod
    def from_record(
        cls, record: Mapping[str, Sequence[Sequence[float]]], side: Side
    ) -> "TactileCalibration":
        """From a recording's calibration matrices.

        Raises:
            InvalidInputError: the tare or gain of this side is missing or not 1 × 360.
        """
        names = (f"tactile_{side}_tare_counts", f"tactile_{side}_gain_counts_per_kpa")
        rows = []
        for name in names:
            if name not in record:
                raise InvalidInputError(
                    f"calibration: {name!r} is missing, so counts of the {side} glove cannot "
                    f"become kPa; expected it beside: {', '.join(sorted(record)) or 'nothing'}"
                )
            matrix = np.array(record[name], dtype=np.float64)
            if matrix.shape != (1, NUM_RAW_TAXELS):
                raise InvalidInputError(
                    f"calibration {name!r}: got {matrix.shape}, expected (1, {NUM_RAW_TAXELS})"
                )
            rows.append(matrix[0])
        return cls(side, *rows)

    def dead_taxels(self, counts: np.ndarray) -> Bool[np.ndarray, "320"]:
        """Taxels that stand still over a whole take although not at their tare."""
        raw = _checked(counts, self.side)
        if len(raw) < MIN_SAMPLES_TO_JUDGE:
            return np.zeros(320, dtype=bool)
        still = raw.min(axis=0) == raw.max(axis=0)
        offset_kpa = np.abs(raw[0] - self.tare_counts) / self.gain_counts_per_kpa
        return select_taxels(still & (offset_kpa > DEAD_OFFSET_KPA), side=self.side)

    def to_kpa(
        self, counts: np.ndarray, *, dead: np.ndarray | None = None
    ) -> Float32[np.ndarray, "time 320"]:
        """Pressures in anatomical order; below the tare they are zero.

        Args:
            counts: [T, 360] raw readings of the glove.
            dead: bool [320], taxels to set to zero.

        Raises:
            ShapeError: not [T, 360].
        """
        pressures = (_checked(counts, self.side) - self.tare_counts) / self.gain_counts_per_kpa
        taxels = np.maximum(select_taxels(pressures, side=self.side), 0.0)
        if dead is not None:
            taxels[:, dead] = 0.0
        return taxels.astype(np.float32)


def _checked(counts: np.ndarray, side: Side) -> Float64[np.ndarray, "time 360"]:
    raw = np.asarray(counts)
    if raw.ndim != 2 or raw.shape[1] != NUM_RAW_TAXELS:
        raise ShapeError(f"counts of the {side} glove: got {raw.shape}, expected [T, 360]")
    return raw.astype(np.float64)
