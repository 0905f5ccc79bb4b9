"""Finds values that a device repeats: frozen, held for several samples, looped, or nearly so."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float64

ImageFault = Literal["black", "torn", "pumping"]
ImplausibleCause = (
    Literal["unit", "norm", "speed", "limits", "jump", "frozen", "repeated"] | ImageFault
)
# As many equal steps may be a frozen stream.
MIN_FROZEN_STEPS: Final = 5
MAX_EQUAL_SHARE: Final = 0.01
MIN_STEPS: Final = 60
# A held value: so many of the intervals between changes are as long as the mean, up or down.
MIN_REGULAR_SHARE: Final = 0.85
MAX_HELD: Final = 20
MIN_HELD: Final = 1.2
MIN_CHANGES: Final = 20
# Of rounded values, only what is held for about so many samples, and a whole number of them.
MIN_ROUNDED_HELD: Final = 1.9
MAX_UNEVEN: Final = 0.05
# Second differences of white noise turn back (a cosine of -2/3), those of a movement do not.
MAX_NOISE_COSINE: Final = -0.2
# Noise hardly ever gives a number twice; where numbers repeat they are rounded, and rounded values
# may rest.
MIN_DISTINCT_SHARE: Final = 0.9
NOISE_ROWS: Final = 20_000
# A device that was frozen leaps: its steps before were no less than so much of those after, and the
# leap is as many of these, and a centimetre (or a hundredth of a radian) at least, or very many.
STOP_SHARE: Final = 0.25
CATCH_UP_STEPS: Final = 4.0
MIN_CATCH_UP: Final = 0.01
SURE_CATCH_UP_STEPS: Final = 20.0
# Samples of a part in which a value may be held, and of a block whose noise is measured.
HELD_ROWS: Final = 100
NOISE_BLOCK: Final = 20
# A loop repeats up to so many samples, once at least.
MAX_LOOP: Final = 64
# A part of noisy values stands still where so many steps in turn are below this share of its noise.
# White noise has one step of twenty there. Noise below the second share of the largest is none.
STILL_SHARE: Final = 0.06
MIN_STILL_STEPS: Final = 12
MAX_SHORT_SHARE: Final = 0.001
DEAD_SHARE: Final = 0.004
# Smaller differences, as shares of the values (or of one), come from 32-bit floats.
ROUNDING: Final = 1e-6


@dataclass(frozen=True)
class Implausible:
    """One reason not to believe samples of a stream.

    Attributes:
        cause: what is wrong.
        message: what was found and what was expected.
        samples: those concerned; they can be left out unless `whole`.
        whole: the values mean something else throughout.
        factor: how many samples a held value has on average; 1 of all else.
        harmless: they may as well be kept, since the device went on where it was.
        nodes: which keypoints of the samples are concerned; None of all else, and of whole samples.
    """

    cause: ImplausibleCause
    message: str
    samples: Bool[np.ndarray, " n"]
    whole: bool = False
    factor: float = 1.0
    harmless: bool = False
    nodes: Bool[np.ndarray, "n nodes"] | None = None


def spread(marked: np.ndarray, at: np.ndarray, count: int) -> Bool[np.ndarray, " n"]:
    """Marks of some samples among all of them."""
    everywhere = np.zeros(count, dtype=bool)
    everywhere[at[marked]] = True
    return everywhere


def implausible_repeats(
    values: np.ndarray,
    *,
    what: str = "values",
    can_rest: bool = False,
    may_lock: bool = False,
    is_noisy: bool | None = None,
    follows: Bool[np.ndarray, " steps"] | None = None,
) -> Iterator[Implausible]:
    """Values [n, …] that a device repeats: every one several times, or the last one for a while.

    Equal values of a device whose values are not noisy are frozen only if it leaps afterwards.
    Samples are consecutive: `follows` says whether each but the first came right after the one
    before, None if all did. What is missing (NaN) in a tenth of them or more is left aside, and the
    samples that miss anything else are none. Robots `can_rest`: they keep values exactly, though
    they are noisy in motion. Gloves with coarse sensors `may_lock`: what they keep without a leap
    is harmless. `is_noisy` says what is known of the device; None to find it out.
    """
    rows = np.asarray(values).reshape(len(values), int(np.prod(np.shape(values)[1:])))
    finite = np.isfinite(rows)
    columns = finite.mean(axis=0) > 0.9 if len(rows) else finite.all(axis=0)
    at = np.flatnonzero(finite[:, columns].all(axis=1))
    rows = rows[np.ix_(at, columns)]
    is_next = np.diff(at) == 1
    if follows is not None:
        is_next &= follows[at[1:] - 1]
    equal = (rows[1:] == rows[:-1]).all(axis=1)
    if len(equal) < MIN_STEPS or not columns.any():
        return
    held, times = _held(equal)
    is_rounded = equal.any() and not is_noisy and _are_rounded(rows[~np.append(False, equal)])
    if is_rounded and (times < MIN_ROUNDED_HELD or abs(times - round(times)) > MAX_UNEVEN):
        # Rounded values of a slow movement come several times, too.
        held, times = held & False, 1.0
    if times > 1:
        message = f"{what} come {times:.3g} times each: the device repeats what it has"
        yield Implausible("repeated", message, spread(held, at, len(values)), factor=times)
    elif not is_rounded and (held := _held_in_parts(equal)).any():
        message = f"{what} come several times each for a while, {held.sum()} in all"
        yield Implausible("repeated", message, spread(held, at, len(values)))
    new = np.flatnonzero(~held)
    rows, is_next = (
        rows[new],
        np.logical_and.reduceat(np.append(is_next, [True]), new)[: len(new) - 1],
    )
    noisy = False if can_rest else is_noisy
    frozen, harmless = _frozen(rows, is_next, is_noisy=noisy, may_lock=may_lock)
    looped = _looped(rows, is_noisy=is_noisy) if not can_rest else frozen & False
    if looped.any():
        message = (
            f"{what} repeat those of up to {MAX_LOOP} samples before in {looped.sum()} samples"
        )
        frozen, harmless = frozen & ~looped, harmless & ~looped
        yield Implausible("frozen", message, spread(looped, at[new], len(values)))
    if frozen.any():
        message = f"{what} are frozen in {frozen.sum()} samples, though they move before or after"
        yield Implausible("frozen", message, spread(frozen, at[new], len(values)))
    if harmless.any():
        message = (
            f"{what} are the same in {harmless.sum()} samples, though they are noisy otherwise"
        )
        same = spread(harmless, at[new], len(values))
        yield Implausible("frozen", message, same, harmless=True)


def _held(equal: np.ndarray) -> tuple[Bool[np.ndarray, " n"], float]:
    """Samples that only repeat a value which is held for a number of samples, and this number.

    Of a longer rest, samples at that distance remain.
    """
    none = np.zeros(len(equal) + 1, dtype=bool)
    begins = np.concatenate([[0], np.flatnonzero(~equal) + 1])
    lengths = np.diff(np.append(begins, len(none)))
    usual = lengths[lengths <= 3 * np.median(lengths)]
    if len(usual) < MIN_CHANGES:
        return none, 1.0
    times = float(usual[1:-1].mean())
    is_regular = (usual == np.floor(times)) | (usual == np.ceil(times))
    if not (MIN_HELD <= times <= MAX_HELD and is_regular.mean() >= MIN_REGULAR_SHARE):
        return none, 1.0
    since = np.arange(len(none)) - np.repeat(begins, lengths)
    is_long = np.repeat(lengths > 3 * np.median(lengths), lengths)
    again = np.where(is_long, since % max(1, round(times)) != 0, since > 0)
    return np.asarray(again), times


def _held_in_parts(equal: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Samples that only repeat a value, where it is held for a part of the time."""
    found = np.zeros(len(equal) + 1, dtype=bool)
    for start in range(0, len(equal) - HELD_ROWS + 1, HELD_ROWS // 2):
        part = slice(start, start + HELD_ROWS)
        if equal[part].any() and (held := _held(equal[part]))[1] > 1:
            found[start : start + HELD_ROWS + 1] |= held[0]
    return found


def _looped(rows: np.ndarray, *, is_noisy: bool | None) -> Bool[np.ndarray, " n"]:
    """Rows of noisy values that come again and again in the same order, as from a buffer."""
    found = np.zeros(len(rows), dtype=bool)
    key = rows[:, int(np.argmax(np.ptp(rows, axis=0)))] if len(rows) else rows
    for lag in range(2, min(MAX_LOOP, len(rows) // 2) + 1):
        again = key[lag:] == key[:-lag]
        if not again.any():
            continue
        again &= (rows[lag:] == rows[:-lag]).all(axis=1) & (rows[lag:] != rows[lag - 1 : -1]).any(
            axis=1
        )
        least = max(lag, MIN_FROZEN_STEPS)
        if again.sum() < least:
            continue
        for start, stop in _runs(again, least):
            found[start + lag : stop + lag] = True
    if found.any() and is_noisy is None:
        others = rows[~found]
        is_noisy = _is_noisy(others, (others[1:] == others[:-1]).all(axis=1))
    return found if is_noisy else found & False


def _runs(marked: np.ndarray, least: int) -> list[tuple[int, int]]:
    """First and one past the last of at least so many in turn."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    return [(a, b) for a, b in runs[runs[:, 1] - runs[:, 0] >= least].tolist()]


def still_parts(
    parts: Float64[np.ndarray, "n parts size"],
) -> list[tuple[int, Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]]:
    """Parts of noisy consecutive values, such as one axis or finger, that stand still, or nearly.

    Returns:
        Part, samples in which it stands still though it moved (it ends elsewhere, or not at all),
        and those in which it goes on where it was.
    """
    if len(parts) <= max(MIN_STEPS, 3 * NOISE_BLOCK):
        return []
    steps = np.diff(parts, axis=0)
    known = np.abs(parts[np.isfinite(parts)])
    rounding = ROUNDING * max(1.0, float(np.quantile(known, 0.95)) if len(known) else 0.0)
    lengths, noise = np.linalg.norm(steps, axis=-1), _noise_of(steps, rounding)
    found = []
    for part in np.flatnonzero(noise > 0).tolist():
        still, harmless = np.zeros((2, len(parts)), dtype=bool)
        for start, stop in _runs(lengths[:, part] < STILL_SHARE * noise[part], MIN_STILL_STEPS):
            goes_on = stop + 1 < len(parts) and (
                _distance(parts[stop, part], parts[stop + 1, part]) <= MIN_CATCH_UP
            )
            # What is rounded rests exactly, and goes on where it was.
            if not goes_on or (lengths[start:stop, part] > rounding).any():
                (harmless if goes_on else still)[start + 1 : stop + 1] = True
        if still.any() or harmless.any():
            found.append((part, still, harmless))
    return found


def _noise_of(
    steps: Float64[np.ndarray, "n parts size"], rounding: float
) -> Float64[np.ndarray, " parts"]:
    """Usual length of second differences where a part is least noisy; 0 of rounded values."""
    bends = np.diff(steps, axis=0)
    lengths = np.linalg.norm(bends, axis=-1)
    num_blocks, num_parts = len(bends) // NOISE_BLOCK, steps.shape[1]
    rows = num_blocks * NOISE_BLOCK
    medians = np.sort(lengths[:rows].reshape(num_blocks, NOISE_BLOCK, num_parts), axis=1)
    medians = np.nan_to_num(medians[:, NOISE_BLOCK // 2])
    is_alive = medians > DEAD_SHARE * np.percentile(medians, 90, axis=0)
    noise = np.zeros(num_parts)
    for part in np.flatnonzero(is_alive.sum(axis=0) >= 3).tolist():
        alive = np.repeat(is_alive[:, part], NOISE_BLOCK)[:-1]
        scale = lengths[1:rows, part] * lengths[: rows - 1, part]
        alive &= scale > 0
        quiet = float(np.percentile(medians[is_alive[:, part], part], 10))
        if _rests(np.linalg.norm(steps[:, part], axis=1) <= rounding):
            continue
        # One column is enough: a small rotation has few digits left.
        gaps = np.diff(np.sort(np.abs(steps[1:rows, part][alive]), axis=0), axis=0)
        quantum = np.where(gaps > rounding, gaps, np.inf).min(initial=np.inf)
        ways = steps[: rows - 1, part] + steps[1:rows, part] + steps[2 : rows + 1, part]
        slow = np.linalg.norm(ways[alive], axis=1)
        dots = (bends[1:rows, part] * bends[: rows - 1, part]).sum(axis=1)[alive] / scale[alive]
        dots = dots[slow <= np.quantile(slow, 1 / 3)] if len(slow) else dots
        if len(dots) >= NOISE_BLOCK and dots.mean() < MAX_NOISE_COSINE:
            noise[part] = quiet if quantum < STILL_SHARE * quiet else 0.0
    return noise


def _rests(equal: Bool[np.ndarray, " n"]) -> bool:
    """Whether values are kept now and then, as rounded ones are, not only for long."""
    long = sum(stop - start for start, stop in _runs(equal, MIN_STILL_STEPS))
    return bool(equal.sum() - long > max(2, MAX_SHORT_SHARE * (len(equal) - long)))


def _frozen(
    rows: np.ndarray, is_next: np.ndarray, *, is_noisy: bool | None, may_lock: bool
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Rows that repeat the one before for long: where the device moved, and where noise rests."""
    frozen, harmless = np.zeros((2, len(rows)), dtype=bool)
    equal = (rows[1:] == rows[:-1]).all(axis=1)
    long = _runs(equal, MIN_FROZEN_STEPS)
    if not long:
        return frozen, harmless
    for start, stop in long:
        frozen[start + 1 : stop + 1] = True
    if is_noisy is None:
        is_noisy = _is_noisy(rows[~frozen], equal[~frozen[1:]])
    for start, stop in long:
        kept = slice(start + 1, stop + 1)
        # What goes on where it was has lost nothing; of what ends so, nobody knows.
        is_off = stop + 1 == len(rows) or _distance(rows[stop], rows[stop + 1]) > MIN_CATCH_UP
        is_lost = is_noisy and is_off and not may_lock
        frozen[kept] = is_lost or _catches_up(rows, is_next, start, stop)
        harmless[kept] = is_noisy and not frozen[stop]
    return frozen, harmless


def _are_rounded(rows: np.ndarray) -> bool:
    """Whether numbers come again in columns, as those of noise hardly do."""
    some = rows[:NOISE_ROWS]
    num_distinct = 1 + (np.diff(np.sort(some, axis=0), axis=0) != 0).sum(axis=0)
    if not (num_distinct > 1).any():
        return True
    # Of a quarter of the columns: a number near one, as of a small rotation, has few digits left.
    usual = np.percentile(num_distinct[num_distinct > 1], 25)
    return bool(usual < MIN_DISTINCT_SHARE * len(some))


def _is_noisy(rows: np.ndarray, equal: np.ndarray) -> bool:
    """Whether values are noisy: what hardly ever keeps a value keeps none for long."""
    if len(equal) < MIN_STEPS or equal.mean() > MAX_EQUAL_SHARE:
        return False
    if _are_rounded(rows):
        return False
    steps = np.diff(rows[:NOISE_ROWS].astype(np.float64), axis=0)
    bends = np.diff(steps, axis=0)
    lengths = np.linalg.norm(bends, axis=1)
    scale = lengths[1:] * lengths[:-1]
    # A third of the steps, the smallest: noise shows where movement is slow.
    slow = np.linalg.norm(steps[1:-1], axis=1)
    known = (scale > 0) & (slow <= np.quantile(slow, 1 / 3))
    cosines = (bends[1:] * bends[:-1]).sum(axis=1)[known] / scale[known]
    return len(cosines) >= MIN_STEPS / 3 and bool(np.median(cosines) < MAX_NOISE_COSINE)


def _distance(some: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(other.astype(np.float64) - some))


def _catches_up(rows: np.ndarray, is_next: np.ndarray, start: int, stop: int) -> bool:
    """Whether a value kept from `start` to `stop` was left at speed, and leaps to where that led.

    What comes to rest is slow before, and a step after lost samples is no leap.
    """
    if start < 1 or not is_next[start - 1 : stop + 1].all() or stop + 3 > len(rows):
        return False
    steps = np.linalg.norm(np.diff(rows[start - 1 : stop + 7].astype(np.float64), axis=0), axis=1)
    before, leap, after = steps[0], steps[stop - start + 1], steps[stop - start + 2 :]
    usual = float(np.median(after)) if len(after) else 0.0
    is_leap = leap > min(max(CATCH_UP_STEPS * usual, MIN_CATCH_UP), SURE_CATCH_UP_STEPS * usual)
    return usual > 0 and bool(is_leap and before > STOP_SHARE * after.max())
