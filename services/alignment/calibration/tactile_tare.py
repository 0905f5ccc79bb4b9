"""Tare of a glove, and detection of dead, stuck and saturated taxels in takes with contact.

The tare is the reading and noise of each cell without contact. A taxel is only called faulty on
evidence: its neighbours (or the others under the same known pressure) moved, and it did not. Where
nothing around it moved it stays `unproven`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.tactile.layout import (
    NUM_FINGERTIPS,
    NUM_RAW_TAXELS,
    NUM_TAXELS,
    PALM_SHAPE,
    TIP_SHAPE,
    Side,
    select_taxels,
)

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


@dataclass(frozen=True)
class Level:
    """Constant level of each cell over a take: mean of the readings without accidental contact.

    `sigma_counts` is of that mean: noise, slow noise and the rounding to whole counts;
    `noise_counts` the standard deviation of one reading; `clipped` the share of excluded readings.
    """

    mean_counts: Float64[np.ndarray, "360"]
    sigma_counts: Float64[np.ndarray, "360"]
    noise_counts: Float64[np.ndarray, "360"]
    clipped: Float64[np.ndarray, "360"]


@dataclass(frozen=True)
class TaxelTare:
    """The zero of each of the 360 raw cells of one glove: their level without load.

    `restless` taxels (anatomical order) moved during the take of so many samples; few are
    tolerated.
    """

    side: Side
    level: Level
    restless: Bool[np.ndarray, "320"]
    num_samples: int


def measure_tare(rest_counts: np.ndarray, *, side: Side) -> TaxelTare:
    """Zero of every cell from a take without contact.

    Args:
        rest_counts: [T ≥ 60, 360] raw counts in scan order.
        side: of the glove.

    Raises:
        InvalidInputError: too short, or the glove was touched or still settling.
        ShapeError, NonFiniteError: no [T, 360], or NaN.
    """
    counts = checked_counts(rest_counts, what=f"rest take of the {side} glove")
    level = steady_level(counts)
    restless = select_taxels(_restless(counts, level), side=side)
    if restless.mean() > MAX_RESTLESS:
        raise InvalidInputError(
            f"rest take of the {side} glove: {int(restless.sum())} of 320 taxels moved during the "
            f"take, expected at most {MAX_RESTLESS:.0%}; lay the glove down untouched, wait a "
            "minute and record again"
        )
    return TaxelTare(side, level, restless, len(counts))


def steady_level(counts: Float64[np.ndarray, "time 360"]) -> Level:
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
    """RMS error of the mean of rounded readings, over all true values.

    Noise of `noise_counts` (with the rounding's own 1/12) dithers the steps away: the bias of a
    rounded value x is Σ (−1)^k sin(2πkx) exp(−2π²k²σ²)/(πk) for Gaussian noise σ (Widrow and
    Kollár, Quantization Noise, 2008); 1/√12 without noise.
    """
    variance = np.maximum(np.asarray(noise_counts, dtype=np.float64) ** 2 - 1 / 12, 0.0)
    orders = np.arange(1, 40)
    terms = np.exp(-4 * np.pi**2 * orders**2 * variance[..., None]) / (2 * np.pi**2 * orders**2)
    return np.sqrt(terms.sum(axis=-1))


def checked_counts(counts: np.ndarray, *, what: str) -> Float64[np.ndarray, "time 360"]:
    """Counts as float64.

    Raises:
        ShapeError: not [T, 360].
        NonFiniteError: NaN or infinity.
        InvalidInputError: too few readings.
    """
    raw = np.asarray(counts, dtype=np.float64)
    if raw.ndim != 2 or raw.shape[1] != NUM_RAW_TAXELS:
        raise ShapeError(f"{what}: got {raw.shape}, expected [T, {NUM_RAW_TAXELS}]")
    if not np.isfinite(raw).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; record it again")
    if len(raw) < MIN_SAMPLES:
        raise InvalidInputError(
            f"{what}: got {len(raw)} readings, expected at least {MIN_SAMPLES}; hold still longer"
        )
    return raw


def classify_taxels(
    takes: Sequence[np.ndarray],
    tare: TaxelTare,
    *,
    full_scale_counts: float = FULL_SCALE_COUNTS,
) -> UInt8[np.ndarray, "320"]:
    """State of each taxel (index into `STATES`, anatomical order) from takes with contact.

    The takes are raw counts [T, 360] each; the rest take may be among them.
    """
    side, level = tare.side, tare.level
    evidence, silent, moves = (np.zeros(NUM_TAXELS, dtype=np.int64) for _ in range(3))
    zero = select_taxels(level.mean_counts, side=side)
    noise = select_taxels(level.noise_counts, side=side)
    needed = np.maximum(MIN_MOVE_SIGMAS * noise, MIN_MOVE_COUNTS)
    for take in takes:
        # In pieces, since eight neighbours of every reading would not fit in memory.
        for start in range(0, len(take), BLOCK):
            block = np.asarray(take[start : start + BLOCK], dtype=np.float64)
            moved = np.abs(select_taxels(block, side=side) - zero)
            around = _least_neighbour(moved)
            told = around >= needed
            evidence += told.sum(axis=0)
            silent += (told & (moved < SILENT_RATIO * around)).sum(axis=0)
            moves += (moved >= needed).sum(axis=0)
    is_silent = (evidence >= MIN_EVIDENCE) & (silent >= MIN_SILENT * evidence)
    is_silent &= moves < MIN_OWN_MOVES
    states = np.full(NUM_TAXELS, UNPROVEN, dtype=np.uint8)
    states[(moves >= MIN_OWN_MOVES) | ((evidence >= MIN_EVIDENCE) & ~is_silent)] = OK
    states[is_silent] = kind_of_silence(takes, side)[is_silent]
    usual = select_taxels(np.min([np.median(take, axis=0) for take in takes], axis=0), side=side)
    states[usual >= SATURATED_RATIO * full_scale_counts] = SATURATED
    return states


def kind_of_silence(takes: Sequence[np.ndarray], side: Side) -> UInt8[np.ndarray, "320"]:
    """`STUCK` for taxels that keep one value other than zero in all takes, else `DEAD`."""
    lowest, highest = (
        select_taxels(most([most(take, axis=0) for take in takes], axis=0), side=side)
        for most in (np.min, np.max)
    )
    return np.where((lowest == highest) & (lowest != 0), STUCK, DEAD).astype(np.uint8)


def _slow_noise_factor(counts: np.ndarray, noise: np.ndarray) -> float:
    """By how much means of blocks spread more than independent readings would; at least 1.

    One number for the whole glove: of a single cell's few blocks it would be a guess.
    """
    size = len(counts) // NUM_BLOCKS
    blocks = counts[: size * NUM_BLOCKS].reshape(NUM_BLOCKS, size, -1).mean(axis=1)
    noisy = noise > 0.5
    if not noisy.any():
        return 1.0
    ratio = blocks.var(axis=0, ddof=1)[noisy] * size / noise[noisy] ** 2
    return max(1.0, float(np.sqrt(np.median(ratio))))


def _restless(counts: Float64[np.ndarray, "time 360"], level: Level) -> Bool[np.ndarray, "360"]:
    half = len(counts) // 2
    shift = np.abs(np.median(counts[:half], axis=0) - np.median(counts[half:], axis=0))
    # Differences of neighbours in time: a step between the halves does not widen them.
    steps = np.abs(np.diff(counts, axis=0))
    fast_noise = np.sqrt(np.mean(np.minimum(steps, 5 * steps.mean(axis=0)) ** 2, axis=0) / 2)
    allowed = np.maximum(MAX_SHIFT_SIGMAS * fast_noise, MIN_SHIFT_COUNTS)
    return (shift > allowed) | (level.clipped > MAX_CLIPPED)


def _neighbours() -> Int64[np.ndarray, "320 8"]:
    """Taxels around each taxel on its own pad, anatomical order; −1 where there is none."""
    tables, first = [], 0
    for shape in [TIP_SHAPE] * NUM_FINGERTIPS + [PALM_SHAPE]:
        cells = first + np.arange(shape[0] * shape[1]).reshape(shape)
        around = sliding_window_view(np.pad(cells, 1, constant_values=-1), (3, 3)).reshape(-1, 9)
        tables.append(np.delete(around, 4, axis=1))
        first += cells.size
    return np.concatenate(tables)


_NEIGHBOURS = _neighbours()
_NUM_NEIGHBOURS = (_NEIGHBOURS >= 0).sum(axis=1)


def _least_neighbour(moved: Float64[np.ndarray, "time 320"]) -> Float64[np.ndarray, "time 320"]:
    """Smallest change of the neighbours, excluding the quarter that changed least."""
    around = np.where(_NEIGHBOURS >= 0, moved[:, _NEIGHBOURS], np.inf)
    around.sort(axis=2)
    rank = np.floor(STILL_NEIGHBOURS * _NUM_NEIGHBOURS).astype(np.int64)
    return np.take_along_axis(around, rank[None, :, None], axis=2)[..., 0]
