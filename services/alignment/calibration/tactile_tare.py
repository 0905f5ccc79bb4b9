"""Tare of a glove, detection of faulty taxels, and conversion of raw counts to pressures in kPa.

A taxel is only faulty if its neighbours, or others under the same pressure, moved, and it did not.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.streams import MIN_SAMPLES_TO_JUDGE, TaxelFaults, implausible_gain
from dextouch.tactile.layout import DEXTOUCH_V1, Side, TactileLayout

# One second of a 60 Hz glove; with less, drift cannot be separated from the zero.
MIN_SAMPLES = 60
NUM_BLOCKS = 10
# Readings further than this from the median (in robust standard deviations) are knocks.
CLIP_SIGMAS = 4.0
MIN_CLIP_COUNTS = 2.0
# What a cell may move between the halves of a rest take, in standard deviations of one reading.
MAX_SHIFT_SIGMAS = 4.0
MIN_SHIFT_COUNTS = 2.0
MAX_CLIPPED = 0.2
# More restless taxels than this, and the hand did not rest.
MAX_RESTLESS = 0.05
# The largest count that our gloves can send.
FULL_SCALE_COUNTS = 65535.0
SATURATED_RATIO = 0.995
STATES = ("ok", "dead", "stuck", "saturated", "unproven", "nonlinear", "imprecise")
OK, DEAD, STUCK, SATURATED, UNPROVEN, NONLINEAR, IMPRECISE = range(len(STATES))

# Neighbours must move by this much before their stillness means anything.
MIN_MOVE_COUNTS = 10.0
MIN_MOVE_SIGMAS = 10.0
# A taxel that shows less than this part of what its neighbours show does not answer.
SILENT_RATIO = 0.1
# This part of the neighbours may be still too: one dead row crosses two of eight.
STILL_NEIGHBOURS = 0.25
MIN_EVIDENCE = 30
MIN_SILENT = 0.95
MIN_OWN_MOVES = 10
BLOCK = 600

# Why a taxel of a take is not measured: what the calibration says, that it has no reading, that its
# readings have nothing to do with those before, lie below its tare, or are those of another one.
REASONS = (*STATES, "absent", "random", "below_tare", "copied", "drifting")
ABSENT, RANDOM, BELOW_TARE, COPIED, DRIFTING = range(len(STATES), len(REASONS))
NO_CELL = -1

Record = Mapping[str, Sequence[Sequence[float]]]
# More taxels than this that are random, or below their tare: the glove or its tare is wrong.
MAX_WRONG_TAXELS = 0.5
# Fingertips press with up to some 1000 kPa.
MAX_PRESSURE_KPA = 5000.0
# No hand is pressed by so much everywhere; less is reported.
MAX_ZERO_KPA = 100.0


@dataclass(frozen=True)
class Level:
    """Constant level of each cell over a take: mean of the readings without accidental contact.

    `sigma_counts` is of that mean, `noise_counts` of one reading, `clipped` the share left out.
    """

    mean_counts: Float64[np.ndarray, " cells"]
    sigma_counts: Float64[np.ndarray, " cells"]
    noise_counts: Float64[np.ndarray, " cells"]
    clipped: Float64[np.ndarray, " cells"]


@dataclass(frozen=True)
class TaxelTare:
    """The zero of the raw cells of a glove without load; few taxels may be `restless` meanwhile."""

    side: Side
    level: Level
    restless: Bool[np.ndarray, " taxels"]
    num_samples: int
    layout: TactileLayout = DEXTOUCH_V1

    def select(self, raw: np.ndarray) -> np.ndarray:
        """Taxels, in anatomical order, of raw readings [..., cells]."""
        return self.layout.select(raw, side=self.side)


def measure_tare(
    rest_counts: np.ndarray, *, side: Side, layout: TactileLayout = DEXTOUCH_V1
) -> TaxelTare:
    """Zero of every cell from raw counts [T ≥ 60, cells] without contact, in scan order.

    Raises InvalidInputError: too short, touched or settling; ShapeError; NonFiniteError.
    """
    counts = checked_counts(rest_counts, what=f"rest take of the {side} glove", layout=layout)
    level = steady_level(counts)
    restless = layout.select(_restless(counts, level), side=side)
    if restless.mean() > MAX_RESTLESS:
        raise InvalidInputError(
            f"rest take of the {side} glove: {int(restless.sum())} of {layout.num_taxels} taxels "
            f"moved during the take, expected at most {MAX_RESTLESS:.0%}; lay the glove down "
            "untouched, wait a minute and record again"
        )
    return TaxelTare(side, level, restless, len(counts), layout)


def steady_level(counts: Float64[np.ndarray, "time cells"]) -> Level:
    """Robust level, its sigma, and noise of each cell's readings; knocks are excluded."""
    median = np.median(counts, axis=0)
    spread = 1.4826 * np.median(np.abs(counts - median), axis=0)
    reach = np.maximum(CLIP_SIGMAS * spread, MIN_CLIP_COUNTS)
    kept = np.abs(counts - median) <= reach
    num_kept = kept.sum(axis=0)
    mean = np.where(kept, counts, 0.0).sum(axis=0) / num_kept
    squares = np.where(kept, (counts - mean) ** 2, 0.0).sum(axis=0)
    noise = np.sqrt(squares / np.maximum(num_kept - 1, 1))
    white = noise / np.sqrt(num_kept) * _slow_noise_factor(np.where(kept, counts, mean), noise)
    return Level(mean, np.hypot(white, rounding_rms_counts(noise)), noise, 1.0 - kept.mean(axis=0))


def rounding_rms_counts(noise_counts: np.ndarray) -> Float64[np.ndarray, "..."]:
    """RMS error of the mean of rounded readings, over all true values; 1/√12 without noise.

    Noise dithers the steps away: the bias of a rounded value x is Σ (−1)^k sin(2πkx)
    exp(−2π²k²σ²)/(πk) for Gaussian noise σ (Widrow and Kollár, Quantization Noise, 2008).
    """
    variance = np.maximum(np.asarray(noise_counts, dtype=np.float64) ** 2 - 1 / 12, 0.0)
    orders = np.arange(1, 40)
    terms = np.exp(-4 * np.pi**2 * orders**2 * variance[..., None]) / (2 * np.pi**2 * orders**2)
    return np.sqrt(terms.sum(axis=-1))


def checked_counts(
    counts: np.ndarray, *, what: str, layout: TactileLayout = DEXTOUCH_V1
) -> Float64[np.ndarray, "time cells"]:
    """Counts [T, cells] as float64; raises ShapeError, NonFiniteError or InvalidInputError."""
    raw = np.asarray(counts, dtype=np.float64)
    if raw.ndim != 2 or raw.shape[1] != layout.num_raw_cells:
        raise ShapeError(f"{what}: got {raw.shape}, expected [T, {layout.num_raw_cells}]")
    if not np.isfinite(raw).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; record it again")
    if len(raw) < MIN_SAMPLES:
        raise InvalidInputError(
            f"{what}: got {len(raw)} readings, expected at least {MIN_SAMPLES}; hold still longer"
        )
    return raw


def classify_taxels(
    takes: Sequence[np.ndarray], tare: TaxelTare, *, full_scale_counts: float = FULL_SCALE_COUNTS
) -> UInt8[np.ndarray, " taxels"]:
    """State of each taxel (index into `STATES`) from takes [T, cells] with contact."""
    level, num_taxels = tare.level, tare.layout.num_taxels
    evidence, silent, moves = (np.zeros(num_taxels, dtype=np.int64) for _ in range(3))
    zero, noise = tare.select(level.mean_counts), tare.select(level.noise_counts)
    needed = np.maximum(MIN_MOVE_SIGMAS * noise, MIN_MOVE_COUNTS)
    for take in takes:
        # In pieces, since eight neighbours of every reading would not fit in memory.
        for start in range(0, len(take), BLOCK):
            block = np.asarray(take[start : start + BLOCK], dtype=np.float64)
            moved = np.abs(tare.select(block) - zero)
            around = _least_neighbour(moved, tare.layout)
            is_informative = around >= needed
            evidence += is_informative.sum(axis=0)
            silent += (is_informative & (moved < SILENT_RATIO * around)).sum(axis=0)
            moves += (moved >= needed).sum(axis=0)
    is_silent = (evidence >= MIN_EVIDENCE) & (silent >= MIN_SILENT * evidence)
    is_silent &= moves < MIN_OWN_MOVES
    states = np.full(num_taxels, UNPROVEN, dtype=np.uint8)
    states[(moves >= MIN_OWN_MOVES) | ((evidence >= MIN_EVIDENCE) & ~is_silent)] = OK
    states[is_silent] = kind_of_silence(takes, tare)[is_silent]
    usual = tare.select(np.min([np.median(take, axis=0) for take in takes], axis=0))
    states[usual >= SATURATED_RATIO * full_scale_counts] = SATURATED
    return states


def kind_of_silence(takes: Sequence[np.ndarray], tare: TaxelTare) -> UInt8[np.ndarray, " taxels"]:
    """`STUCK` for taxels that keep one value other than zero in all takes, else `DEAD`."""
    lowest, highest = (
        tare.select(most([most(take, axis=0) for take in takes], axis=0))
        for most in (np.min, np.max)
    )
    return np.where((lowest == highest) & (lowest != 0), STUCK, DEAD).astype(np.uint8)


def _slow_noise_factor(counts: np.ndarray, noise: np.ndarray) -> float:
    """By how much means of blocks spread more than independent readings; one number a glove."""
    size = len(counts) // NUM_BLOCKS
    blocks = counts[: size * NUM_BLOCKS].reshape(NUM_BLOCKS, size, -1).mean(axis=1)
    noisy = noise > 0.5
    if not noisy.any():
        return 1.0
    ratio = blocks.var(axis=0, ddof=1)[noisy] * size / noise[noisy] ** 2
    return max(1.0, float(np.sqrt(np.median(ratio))))


def _restless(
    counts: Float64[np.ndarray, "time cells"], level: Level
) -> Bool[np.ndarray, " cells"]:
    half = len(counts) // 2
    shift = np.abs(np.median(counts[:half], axis=0) - np.median(counts[half:], axis=0))
    # Differences of neighbours in time: a step between the halves does not widen them.
    steps = np.abs(np.diff(counts, axis=0))
    fast_noise = np.sqrt(np.mean(np.minimum(steps, 5 * steps.mean(axis=0)) ** 2, axis=0) / 2)
    allowed = np.maximum(MAX_SHIFT_SIGMAS * fast_noise, MIN_SHIFT_COUNTS)
    return (shift > allowed) | (level.clipped > MAX_CLIPPED)


@lru_cache(maxsize=8)
def _neighbours(layout: TactileLayout) -> Int64[np.ndarray, "taxels 8"]:
    """Taxels around each taxel on its own pad, anatomical order; −1 where there is none."""
    tables, first = [], 0
    for pad in layout.pads:
        cells = first + np.arange(pad.num_taxels).reshape(pad.shape)
        around = sliding_window_view(np.pad(cells, 1, constant_values=-1), (3, 3)).reshape(-1, 9)
        tables.append(np.delete(around, 4, axis=1))
        first += cells.size
    return np.concatenate(tables)


def _least_neighbour(
    moved: Float64[np.ndarray, "time taxels"], layout: TactileLayout
) -> Float64[np.ndarray, "time taxels"]:
    """Smallest change of the neighbours, excluding the quarter that changed least."""
    neighbours = _neighbours(layout)
    around = np.where(neighbours >= 0, moved[:, neighbours], np.inf)
    around.sort(axis=2)
    rank = np.floor(STILL_NEIGHBOURS * (neighbours >= 0).sum(axis=1)).astype(np.int64)
    return np.take_along_axis(around, rank[None, :, None], axis=2)[..., 0]


@dataclass(frozen=True)
class TactileCalibration:
    """counts = tare + gain · pressure for each taxel, in anatomical order, of a glove.

    Attributes:
        cells: raw cell, of `num_cells` in a sample, of each taxel, −1 where the glove has none.
        tare_counts: in the unit of the readings, whose smallest difference is `step`.
        gain_counts_per_kpa: above 0; 1 where it is not measured.
        state: why a taxel is not measured, index into `REASONS`; 0 where it is.

    Raises:
        InvalidInputError: a gain that is not positive, or not one taxel that is measured.
    """

    side: Side
    num_cells: int
    cells: Int64[np.ndarray, " taxels"]
    tare_counts: Float64[np.ndarray, " taxels"]
    gain_counts_per_kpa: Float64[np.ndarray, " taxels"]
    state: UInt8[np.ndarray, " taxels"]
    step: float = 1.0

    def __post_init__(self) -> None:
        if not (self.state == OK).any():
            raise InvalidInputError(
                f"tactile calibration {self.side}: refuses all {len(self.state)} taxels; calibrate "
                "the glove again, or leave its stream out"
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
        num_cells: int | None = None,
        stream: str | None = None,
        layout: TactileLayout | None = None,
    ) -> "TactileCalibration":
        """From a recording's calibration matrices of one side.

        These are `tactile_<side>_tare_counts`, `…_gain_counts_per_kpa` (1 × cells; the unit of the
        layout may say it) and, if any, `…_taxel_state` (1 × cells) and `…_cells` (1 × taxels;
        needed by a glove without layout that sends other than 360 numbers). `num_cells` is that of
        a sample, None that of the `layout`, which is `dextouch_v1` if None; `stream` begins the
        names of a further glove. It raises InvalidInputError or NonFiniteError for a matrix that is
        missing or invalid.
        """
        glove, about = stream or f"tactile_{side}", layout or DEXTOUCH_V1
        num_cells = about.num_raw_cells if num_cells is None else num_cells
        tare = _row(record, f"{glove}_tare_counts", num_cells)
        cells = _cells(record, side, num_cells, glove, layout)
        gain = _gain(record, f"{glove}_gain_counts_per_kpa", num_cells, cells, layout)
        state = np.full(len(cells), ABSENT, dtype=np.uint8)
        has_cell = cells != NO_CELL
        state[has_cell] = _states(record, f"{glove}_taxel_state", num_cells)[cells[has_cell]]
        good = (state == OK) & (gain[cells] > 0)
        is_known = layout is None or layout.unit == "counts"
        if is_known and num_cells == about.num_raw_cells and good.any():
            why = implausible_gain(gain[cells[good]], about.areas_m2[good], about)
            if why is not None:
                text = f"calibration '{glove}_gain_counts_per_kpa': {why}"
                raise InvalidInputError(text, fault="unit")
        gain = np.where(state == OK, gain[cells], 1.0)
        return cls(side, num_cells, cells, tare[cells], gain, state, reading_step(about))

    def to_kpa(
        self, counts: np.ndarray, *, refused: np.ndarray | None = None
    ) -> Float32[np.ndarray, "time taxels"]:
        """Pressures of readings [T, cells] in anatomical order; zero below the tare, NaN as read.

        Taxels are zero that `refused` says (uint8 [taxels] of `unusable_taxels`), by default those
        that the calibration refuses. Raises ShapeError: not [T, cells].
        """
        offsets = self.taxels(counts).astype(np.float64) - self.tare_counts
        taxels = np.maximum(offsets / self.gain_counts_per_kpa, 0.0)
        taxels[:, (self.state if refused is None else refused) != OK] = 0.0
        return taxels.astype(np.float32)

    def taxels(self, counts: np.ndarray) -> Shaped[np.ndarray, "time taxels"]:
        """Readings [T, cells] by taxel; where there is no cell, those of any. Raises ShapeError."""
        raw = np.asarray(counts)
        if raw.ndim != 2 or raw.shape[1] != self.num_cells:
            raise ShapeError(
                f"counts of the {self.side} glove: got {raw.shape}, expected [T, {self.num_cells}]"
            )
        return raw[:, self.cells]


def reading_step(layout: TactileLayout) -> float:
    """Smallest difference of two readings: a count, or a part in 65535 of full scale."""
    return 1.0 if layout.unit == "counts" else layout.full_scale / FULL_SCALE_COUNTS


def _gain(
    record: Record, name: str, num_cells: int, cells: np.ndarray, layout: TactileLayout | None
) -> Float64[np.ndarray, " cells"]:
    """Gain of each cell: that of the calibration, or else the one that the layout's unit says."""
    kpa_per_unit = None if layout is None else layout.nominal_kpa_per_unit
    if name in record or kpa_per_unit is None:
        return _row(record, name, num_cells)
    gain = np.ones(num_cells)
    gain[cells[cells != NO_CELL]] = 1.0 / kpa_per_unit[cells != NO_CELL]
    return gain


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


def _cells(
    record: Record, side: Side, num_cells: int, glove: str, layout: TactileLayout | None
) -> Int64[np.ndarray, " taxels"]:
    """The cell map of the calibration, or that of the glove's layout."""
    name, about = f"{glove}_cells", layout or DEXTOUCH_V1
    if name not in record:
        if num_cells == about.num_raw_cells:
            return about.raw_indices(side)
        raise InvalidInputError(
            f"calibration: the {side} glove sends {num_cells} numbers a sample, so it is not ours, "
            f"and {name!r} is missing: expected 1 x {about.num_taxels}, for each taxel in "
            f"anatomical order the raw cell 0 … {num_cells - 1} that measures it, -1 for none; or "
            "name the layout of the glove in the settings of the station (layout)"
        )
    cells = _row(record, name, about.num_taxels)
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


def taxel_faults(
    calibration: TactileCalibration,
    pieces: Iterable[np.ndarray],
    layout: TactileLayout = DEXTOUCH_V1,
) -> TaxelFaults:
    """What consecutive raw readings [T, cells] of a take say of its taxels; raises ShapeError."""
    take = TaxelFaults(
        calibration.tare_counts,
        calibration.gain_counts_per_kpa,
        usable=calibration.state == OK,
        step=calibration.step,
        layout=layout,
    )
    for counts in pieces:
        take.add(calibration.taxels(counts).astype(np.float64))
    return take


def unusable_taxels(
    calibration: TactileCalibration, take: TaxelFaults
) -> UInt8[np.ndarray, " taxels"]:
    """Why each taxel of a take is unusable, index into `REASONS`; 0 if usable.

    Besides those that the calibration refuses: dead, stuck, random, a copy of another cell, mostly
    below the tare, still while those around them move, at a limit for long, on a pad that drifts,
    or NaN in more than a tenth of the samples.
    Raises InvalidInputError: more than half of the taxels are random, copied, dead, stuck, at a
    limit, drifting or below their tare, all are frozen, some read more than any finger presses, or
    all more than their tare.
    """
    reasons = calibration.state.copy()
    if take.num_samples < MIN_SAMPLES_TO_JUDGE:
        return reasons
    _check_pressures(calibration, take)
    for one in take.repeats():
        if one.whole:
            text = f"{calibration.side} glove: {one.message}: it is frozen; restart it"
            raise InvalidInputError(text, fault=one.cause)
    for fault, taxels in take.faults().items():
        reasons[(reasons == OK) & taxels] = REASONS.index(fault)
    for reason, what, advice in (
        (RANDOM, "have nothing to do with the ones before", "check cable, port and protocol"),
        (DEAD, "are zero throughout or from some moment on", "check cable and power"),
        (COPIED, "are those of others", "check cable and firmware"),
        (STUCK, "never change, or no more from some moment on", "restart the glove"),
        (SATURATED, "end at the highest reading", "press less, or check gain and range"),
        (DRIFTING, "drift with the zero of their pad", "wait until the glove is warm, and tare it"),
        (BELOW_TARE, "lie below their tare", "tare the glove again"),
    ):
        share = float((reasons == reason)[calibration.state == OK].mean())
        if share > MAX_WRONG_TAXELS:
            raise InvalidInputError(
                f"{calibration.side} glove: readings of {share:.0%} of its taxels {what}; {advice}",
                fault=REASONS[reason],
            )
    return reasons


def _check_pressures(glove: TactileCalibration, take: TaxelFaults) -> None:
    """Refuse readings that no finger gives, as a gain per Pa or another tare make them."""
    highest_kpa = float(np.sort(take.highest_kpa()[glove.state == OK])[-3:].min())
    if highest_kpa > MAX_PRESSURE_KPA:
        raise InvalidInputError(
            f"{glove.side} glove: three taxels read {highest_kpa:.3g} kPa or more, expected at "
            f"most {MAX_PRESSURE_KPA:g} kPa; its gain looks like counts/Pa: calibrate it again",
            fault="unit",
        )
    zero_kpa = float(np.median(take.zero_kpa))
    if zero_kpa > MAX_ZERO_KPA:
        raise InvalidInputError(
            f"{glove.side} glove: even its least pressed taxels read {zero_kpa:.3g} kPa for most "
            f"of the time, expected at most {MAX_ZERO_KPA:g} kPa; tare the glove again (are "
            "readings inverted?)",
            fault="baseline",
        )
