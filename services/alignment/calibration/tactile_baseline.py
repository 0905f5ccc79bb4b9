"""Conversion of a glove's raw counts to pressures in kPa, and detection of unusable taxels."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped, UInt8

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, Side, raw_indices
from services.alignment.calibration.tactile_tare import DEAD, OK, STATES, STUCK

# Why a taxel of a take is not measured: what the calibration says, or that it has no reading.
REASONS = (*STATES, "absent")
ABSENT = len(STATES)
# A cell that never moves is dead if it rests further than this from its tare.
DEAD_OFFSET_KPA = 1.0
MIN_SAMPLES_TO_JUDGE = 30
# A cell without a reading in more samples than this is refused; else those samples are left out.
MAX_MISSING = 0.1
NO_CELL = -1

Record = Mapping[str, Sequence[Sequence[float]]]


@dataclass(frozen=True)
class TactileCalibration:
    """counts = tare + gain · pressure for each taxel of one glove of any maker.

    Attributes:
        side: of the glove.
        num_cells: numbers that the glove sends in each sample.
        cells: raw cell of each taxel in anatomical order, −1 where the glove has none.
        tare_counts: of each taxel, in the unit in which the glove sends its readings.
        gain_counts_per_kpa: of each taxel, above 0; 1 where it is not measured.
        state: why a taxel is not measured, index into `REASONS`; 0 where it is.

    Raises:
        InvalidInputError: a gain that is not positive, or not one taxel that is measured.
    """

    side: Side
    num_cells: int
    cells: Int64[np.ndarray, "320"]
    tare_counts: Float64[np.ndarray, "320"]
    gain_counts_per_kpa: Float64[np.ndarray, "320"]
    state: UInt8[np.ndarray, "320"]

    def __post_init__(self) -> None:
        if not (self.state == OK).any():
            raise InvalidInputError(
                f"tactile calibration {self.side}: refuses all 320 taxels; calibrate the glove "
                "again, or leave its stream out"
            )
        if not (self.gain_counts_per_kpa > 0).all():
            raise InvalidInputError(
                f"tactile calibration {self.side}: got a gain of "
                f"{self.gain_counts_per_kpa.min():g} counts/kPa, expected all above 0"
            )

    @classmethod
    def from_record(
        cls,
        record: Record,
        side: Side,
        *,
        num_cells: int = NUM_RAW_TAXELS,
        stream: str | None = None,
    ) -> "TactileCalibration":
        """From a recording's calibration matrices.

        Args:
            record: `tactile_<side>_tare_counts` and `…_gain_counts_per_kpa` (1 × cells); if there
                are any `…_taxel_state` (1 × cells) and `…_cells` (1 × 320), which a glove of
                another number of cells must have.
            side: of the glove.
            num_cells: numbers that the glove sends in each sample.
            stream: of a further glove of this side, whose matrices begin with its name.

        Raises:
            InvalidInputError: a matrix of this side is missing, has the wrong shape or invalid
                values.
            NonFiniteError: NaN or infinity.
        """
        glove = stream or f"tactile_{side}"
        tare, gain = (
            _row(record, f"{glove}_{name}", num_cells)
            for name in ("tare_counts", "gain_counts_per_kpa")
        )
        cells = _cells(record, side, num_cells, glove)
        state = np.full(NUM_TAXELS, ABSENT, dtype=np.uint8)
        has_cell = cells != NO_CELL
        state[has_cell] = _states(record, f"{glove}_taxel_state", num_cells)[cells[has_cell]]
        gain = np.where(state == OK, gain[cells], 1.0)
        return cls(side, num_cells, cells, tare[cells], gain, state)

    def to_kpa(
        self, counts: np.ndarray, *, refused: np.ndarray | None = None
    ) -> Float32[np.ndarray, "time 320"]:
        """Pressures in anatomical order; zero below the tare, NaN where the reading is.

        Args:
            counts: [T, cells] raw readings of the glove.
            refused: uint8 [320] of `unusable_taxels`, taxels that are set to zero; by default those
                that the calibration refuses.

        Raises:
            ShapeError: not [T, cells].
        """
        offsets = self.taxels(counts).astype(np.float64) - self.tare_counts
        taxels = np.maximum(offsets / self.gain_counts_per_kpa, 0.0)
        taxels[:, (self.state if refused is None else refused) != OK] = 0.0
        return taxels.astype(np.float32)

    def taxels(self, counts: np.ndarray) -> Shaped[np.ndarray, "time 320"]:
        """Readings [T, cells] by taxel; where there is no cell, those of any other.

        Raises:
            ShapeError: not [T, cells].
        """
        raw = np.asarray(counts)
        if raw.ndim != 2 or raw.shape[1] != self.num_cells:
            raise ShapeError(
                f"counts of the {self.side} glove: got {raw.shape}, expected [T, {self.num_cells}]"
            )
        return raw[:, self.cells]


def unusable_taxels(
    calibration: TactileCalibration, pieces: Iterable[np.ndarray]
) -> UInt8[np.ndarray, "320"]:
    """Why each taxel of a take is unusable, index into `REASONS`; 0 if usable.

    In addition to those that the glove's calibration refuses: cells that are constant but not at
    their tare (dead at zero, stuck elsewhere), and cells that are NaN in more than a tenth of the
    samples.

    Args:
        calibration: of the glove.
        pieces: consecutive raw readings [T, cells] of the take.

    Raises:
        ShapeError: not [T, cells].
    """
    reasons, first, num_samples = calibration.state.copy(), None, 0
    low, high = np.full(NUM_TAXELS, np.inf), np.full(NUM_TAXELS, -np.inf)
    num_finite = np.zeros(NUM_TAXELS, dtype=np.int64)
    for counts in pieces:
        taxels = calibration.taxels(counts)
        if not len(taxels):
            continue
        if first is None:
            first = taxels[0].astype(np.float64)
        low, high = np.minimum(low, taxels.min(axis=0)), np.maximum(high, taxels.max(axis=0))
        num_finite += np.isfinite(taxels).sum(axis=0)
        num_samples += len(taxels)
    if first is None or num_samples < MIN_SAMPLES_TO_JUDGE:
        return reasons
    reasons[(reasons == OK) & (1.0 - num_finite / num_samples > MAX_MISSING)] = ABSENT
    offset_kpa = np.abs(first - calibration.tare_counts) / calibration.gain_counts_per_kpa
    silent = (reasons == OK) & (low == high) & (offset_kpa > DEAD_OFFSET_KPA)
    reasons[silent] = np.where(first[silent] == 0, DEAD, STUCK)
    return reasons


def _row(record: Record, name: str, size: int) -> Float64[np.ndarray, " size"]:
    if name not in record:
        raise InvalidInputError(
            f"calibration: {name!r} is missing, so counts of that glove cannot become kPa; "
            f"expected it beside: {', '.join(sorted(record)) or 'nothing'}"
        )
    matrix = np.array(record[name], dtype=np.float64)
    if matrix.shape != (1, size):
        raise InvalidInputError(f"calibration {name!r}: got {matrix.shape}, expected (1, {size})")
    if not np.isfinite(matrix).all():
        raise NonFiniteError(f"calibration {name!r}: holds NaN or infinity; calibrate again")
    return matrix[0]


def _cells(record: Record, side: Side, num_cells: int, glove: str) -> Int64[np.ndarray, "320"]:
    """The cell map of the calibration, or the default of our own gloves."""
    name = f"{glove}_cells"
    if name not in record:
        if num_cells == NUM_RAW_TAXELS:
            return raw_indices(side=side)
        raise InvalidInputError(
            f"calibration: the {side} glove sends {num_cells} numbers a sample, so it is not ours, "
            f"and {name!r} is missing: expected 1 x {NUM_TAXELS}, for each taxel in anatomical "
            f"order the raw cell 0 … {num_cells - 1} that measures it, -1 for none"
        )
    cells = _row(record, name, NUM_TAXELS)
    used = cells[cells != NO_CELL]
    wrong = (cells != np.rint(cells)) | (cells < NO_CELL) | (cells >= num_cells)
    if wrong.any():
        taxel = int(np.argmax(wrong))
        raise InvalidInputError(
            f"calibration {name!r}: got {cells[taxel]:g} for taxel {taxel}, expected a whole "
            f"number -1 … {num_cells - 1}"
        )
    found, counts = np.unique(used, return_counts=True)
    if (counts > 1).any():
        cell = found[np.argmax(counts)]
        raise InvalidInputError(
            f"calibration {name!r}: names cell {cell:g} {counts.max()} times (taxels "
            f"{np.flatnonzero(cells == cell).tolist()}), expected each cell at most once"
        )
    return cells.astype(np.int64)


def _states(record: Record, name: str, num_cells: int) -> UInt8[np.ndarray, " cells"]:
    """States of the raw cells; all OK in a calibration without them."""
    if name not in record:
        return np.full(num_cells, OK, dtype=np.uint8)
    states = _row(record, name, num_cells)
    unknown = ~np.isin(states, np.arange(len(STATES)))
    if unknown.any():
        raise InvalidInputError(
            f"calibration {name!r}: got {states[np.argmax(unknown)]:g} for raw cell "
            f"{int(np.argmax(unknown))}, expected 0 … {len(STATES) - 1} ({', '.join(STATES)})"
        )
    return states.astype(np.uint8)
