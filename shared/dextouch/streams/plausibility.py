"""Checks whether values of a stream can be true: units, speeds, limits, frozen and repeated values.

Stations apply them to what devices send now, alignment to whole recordings. What is wrong with
single samples is located, so that they can be left out; what is wrong with all of them (another
unit, for example) is named with the values that were found.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.streams.samples import StreamDescriptor
from dextouch.tactile.layout import SIDES

ImplausibleCause = Literal["unit", "norm", "speed", "limits", "jump", "frozen", "repeated"]
# World records of throwing reach 8 m/s at the wrist; what people do with objects stays below 3.
MAX_SPEED_M_S: Final = 10.0
MAX_TURN_RAD_S: Final = 60.0
# Noise of fast trackers exceeds these between two samples, not over 5 ms.
MIN_STEP_NS: Final = 5_000_000
# A wrist of a fast movement accelerates by some 100 m/s². A single pose that needs more is none.
MAX_ACCELERATION_M_S2: Final = 300.0
# Maps of mobile robots are as large.
MAX_DISTANCE_M: Final = 100.0
# Above this share of wrong steps nothing can be left out: the whole stream is wrong.
MAX_WRONG_SHARE: Final = 0.05
# A pose that is elsewhere for longer is no outlier: the tracker has moved its world. It comes back
# to where a hand (of 3 m/s at most) is meanwhile, and is off the way there by more than noise.
MAX_OUTLIER_NS: Final = 300_000_000
MAX_RETURN_M_S: Final = 3.0
MIN_AWAY_M: Final = 0.05
MIN_OUTLIER_M: Final = 0.005
OUTLIER_SIGMAS: Final = 12.0
MAX_NORM_ERROR: Final = 0.1
# As many equal steps may be a frozen stream.
MIN_FROZEN_STEPS: Final = 5
MAX_EQUAL_SHARE: Final = 0.01
MIN_STEPS: Final = 60
# A held value: so many of the intervals between changes are as long as the mean, up or down.
MIN_REGULAR_SHARE: Final = 0.85
MAX_HELD: Final = 20
MIN_HELD: Final = 1.2
MIN_CHANGES: Final = 20
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
# Focal lengths in widths of the image: fisheyes have 0.2, telephoto lenses 10.
FOCAL_WIDTHS: Final = (0.1, 20.0)
# How far joints of a real hand are beyond the limits of its model.
LIMIT_SLACK_RAD: Final = 0.35
# Inches are too near to centimetres to be known by their size.
_UNITS: Final = {"millimetres": 1e3, "centimetres": 1e2}
# Of tracked hands and heads: distance from the world's origin, 95 % of the speeds, and how many
# times more or less they may be.
_USUAL_DISTANCE_M: Final = 0.7
_USUAL_SPEED_M_S: Final = 0.4
_USUAL_RATIO: Final = 50.0
_NS_PER_S: Final = 1e9


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
    """

    cause: ImplausibleCause
    message: str
    samples: Bool[np.ndarray, " n"]
    whole: bool = False
    factor: float = 1.0
    harmless: bool = False


def implausible_values(
    descriptor: StreamDescriptor,
    t_ns: Int64[np.ndarray, " n"],
    values: np.ndarray,
    *,
    of_robot: bool = False,
) -> list[Implausible]:
    """What is implausible in samples [n, …] of a stream of poses, joints or keypoints.

    What is commanded may leap, may be kept, and may lie beyond limits to press: only its unit is
    checked. What is `of_robot` may rest exactly; joints and poses in a robot's base always may.
    Times increase.
    """
    if descriptor.kind == "pose":
        can_rest = of_robot or descriptor.frame == "base"
        period_ns = descriptor.period_ns()
        found = implausible_poses(t_ns, values, period_ns=period_ns, can_rest=can_rest)
    elif descriptor.kind == "keypoints":
        # Gloves whose sensors are coarse rest, too.
        found = list(implausible_repeats(values, what="keypoints", may_lock=True))
    elif descriptor.kind == "robot_state" and descriptor.unit == "rad":
        lower_rad, upper_rad = _limits_rad()
        if values.shape[1:] != lower_rad.shape:
            return []
        found = implausible_joints(values, lower_rad, upper_rad)
    else:
        return []
    is_commanded = descriptor.name.endswith("_commanded")
    return [one for one in found if not is_commanded or (one.whole and one.cause != "limits")]


@cache
def _limits_rad() -> tuple[Float64[np.ndarray, "40"], Float64[np.ndarray, "40"]]:
    """Joint limits of both robot hands, left before right."""
    from dextouch.hands.robot_hand import RobotHand

    hands = [RobotHand(side) for side in SIDES]
    return (
        np.concatenate([hand.lower_rad for hand in hands]),
        np.concatenate([hand.upper_rad for hand in hands]),
    )


def implausible_poses(
    t_ns: Int64[np.ndarray, " n"], poses: np.ndarray, *, period_ns: int, can_rest: bool = False
) -> list[Implausible]:
    """What is implausible in poses [n, 7] of a tracked hand or head, at increasing times.

    Poses are position (m) and quaternion (w, x, y, z); samples with NaN or a quaternion of zeros
    are lost, not implausible. `period_ns` is nominal; `can_rest` as in `implausible_repeats`.
    """
    values = np.asarray(poses, dtype=np.float64)
    norms = np.linalg.norm(values[:, 3:], axis=1)
    is_seen = np.isfinite(values).all(axis=1) & (norms > 0)
    if not is_seen.any():
        return []
    everything = np.ones(len(values), dtype=bool)
    is_wrong = is_seen & (np.abs(norms - 1) > MAX_NORM_ERROR)
    found: list[Implausible] = []
    if is_wrong.any():
        norm = float(np.median(norms[is_wrong]))
        whole = bool(is_wrong.sum() > MAX_WRONG_SHARE * len(norms))
        message = (
            f"quaternions have a norm of {norm:.3g}, expected 1: are these other angles, or other "
            "columns?"
        )
        found.append(Implausible("norm", message, everything if whole else is_wrong, whole=whole))
        if whole:
            return found
    known = np.flatnonzero(is_seen & ~is_wrong)
    seen, seen_ns = values[known], np.asarray(t_ns)[known]
    speeds_m_s, turns_rad_s = _speeds(seen_ns, seen, period_ns)
    fast = _is_fast(speeds_m_s, turns_rad_s)
    distance_m = float(np.median(np.linalg.norm(seen[:, :3], axis=1)))
    is_often = len(fast) >= 1 / MAX_WRONG_SHARE and fast.mean() > MAX_WRONG_SHARE
    if distance_m > MAX_DISTANCE_M or is_often:
        # Drivers drop what is too fast: there may be a single pose.
        speed_m_s = float(np.percentile(speeds_m_s, 95)) if len(speeds_m_s) else None
        got = f"a distance of {distance_m:.3g} m"
        if speed_m_s is not None:
            turn_rad_s = float(np.percentile(turns_rad_s, 95))
            got += f" and speeds (95 %) of {speed_m_s:.3g} m/s and {turn_rad_s:.3g} rad/s"
        unit = _unit(distance_m, speed_m_s)
        expected = (
            f"expected below {MAX_DISTANCE_M:g} m, {MAX_SPEED_M_S:g} m/s, {MAX_TURN_RAD_S:g} rad/s"
        )
        hint = f": these look like {unit}, send metres" if unit else ""
        cause: ImplausibleCause = "unit" if unit else "speed"
        return [Implausible(cause, f"{got}, {expected}{hint}", everything, whole=True)]
    # Only a leap between samples that follow each other shows that one was frozen before.
    follows = np.diff(seen_ns) < 1.5 * period_ns
    repeats = implausible_repeats(seen, can_rest=can_rest, follows=follows)
    found += [replace(one, samples=_spread(one.samples, known, len(values))) for one in repeats]
    new = known[~np.any([one.samples[known] for one in found], axis=0)] if found else known
    jumps = _spread(_outliers(np.asarray(t_ns)[new], values[new], period_ns), new, len(values))
    if jumps.any():
        num, more = int(jumps.sum()), ("" if jumps.sum() == 1 else "s")
        message = f"{num} pose{more} away from those before and after, as nothing can move"
        found.append(Implausible("jump", message, jumps))
    return found


def _spread(marked: np.ndarray, at: np.ndarray, count: int) -> Bool[np.ndarray, " n"]:
    """Marks of some samples among all of them."""
    everywhere = np.zeros(count, dtype=bool)
    everywhere[at[marked]] = True
    return everywhere


def lasting_jumps(
    t_ns: Int64[np.ndarray, " n"], poses: np.ndarray, *, period_ns: int
) -> Int64[np.ndarray, " jumps"]:
    """Numbers of the samples from which on a tracker's world is another: it found itself anew.

    Poses [n, 7] were all seen, at increasing times, and are without outliers.
    """
    if len(poses) < 2:
        return np.zeros(0, dtype=np.int64)
    fast = _is_fast(*_speeds(t_ns, np.asarray(poses, dtype=np.float64), period_ns))
    return np.flatnonzero(fast) + 1


def implausible_joints(
    joints_rad: np.ndarray, lower_rad: np.ndarray, upper_rad: np.ndarray
) -> list[Implausible]:
    """What is implausible in joint angles [n, joints] of a hand with these limits."""
    values = np.asarray(joints_rad, dtype=np.float64)
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        return []
    beyond = _beyond(values, lower_rad, upper_rad)
    found = list(implausible_repeats(values, can_rest=True))
    if beyond.any():
        joint = int(np.argmax((_excess(values[finite], lower_rad, upper_rad)).max(axis=0)))
        angles_rad = values[finite, joint]
        most_rad = angles_rad[np.argmax(np.abs(angles_rad))]
        limits = f"{lower_rad[joint]:.2f} … {upper_rad[joint]:.2f} rad"
        message = f"joint {joint} is at {most_rad:.3g} rad, expected {limits}"
        whole = float(beyond[finite].mean()) > MAX_WRONG_SHARE
        excess_rad = _excess(np.radians(values[finite]), lower_rad, upper_rad)
        in_degrees = (excess_rad > LIMIT_SLACK_RAD).mean() <= MAX_WRONG_SHARE
        usual_rad = float(np.percentile(np.abs(values[finite]), 90))
        is_unit = whole and in_degrees and usual_rad > np.abs([lower_rad, upper_rad]).max()
        hint = ": these look like degrees, send radians" if is_unit else ""
        cause: ImplausibleCause = "unit" if is_unit else "limits"
        found.append(Implausible(cause, message + hint, beyond, whole=whole))
    return found


def implausible_repeats(
    values: np.ndarray,
    *,
    what: str = "values",
    can_rest: bool = False,
    may_lock: bool = False,
    follows: Bool[np.ndarray, " steps"] | None = None,
) -> Iterator[Implausible]:
    """Values [n, …] that a device repeats: every one several times, or the last one for a while.

    Equal values of a device whose values are not noisy are frozen only if it leaps afterwards.
    Samples are consecutive: `follows` says whether each but the first came right after the one
    before, None if all did. What is missing (NaN) in a tenth of them or more is left aside, and the
    samples that miss anything else are none. Robots `can_rest`: they keep values exactly, though
    they are noisy in motion. Gloves with coarse sensors `may_lock`: what they keep without a leap
    is harmless.
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
    if len(equal) < MIN_STEPS or not equal.any() or not columns.any():
        return
    held, times = _held(equal)
    if times > 1:
        message = f"{what} come {times:.3g} times each: the device repeats what it has"
        yield Implausible("repeated", message, _spread(held, at, len(values)), factor=times)
    new = np.flatnonzero(~held)
    rows, is_next = (
        rows[new],
        np.logical_and.reduceat(np.append(is_next, [True]), new)[: len(new) - 1],
    )
    frozen, harmless = _frozen(rows, is_next, can_rest=can_rest, may_lock=may_lock)
    if frozen.any():
        message = f"{what} are frozen in {frozen.sum()} samples, though they move before or after"
        yield Implausible("frozen", message, _spread(frozen, at[new], len(values)))
    if harmless.any():
        message = (
            f"{what} are the same in {harmless.sum()} samples, though they are noisy otherwise"
        )
        same = _spread(harmless, at[new], len(values))
        yield Implausible("frozen", message, same, harmless=True)


def _held(equal: np.ndarray) -> tuple[Bool[np.ndarray, " n"], float]:
    """Samples that only repeat a value which is held for a number of samples, and this number.

    A device that is at rest as well repeats its value for longer: of that, samples at that distance
    remain.
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


def _frozen(
    rows: np.ndarray, is_next: np.ndarray, *, can_rest: bool, may_lock: bool
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Rows that repeat the one before for long: where the device moved, and where it rested.

    At rest, only devices that are noisy otherwise are meant.
    """
    frozen, harmless = np.zeros((2, len(rows)), dtype=bool)
    equal = (rows[1:] == rows[:-1]).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    long = runs[runs[:, 1] - runs[:, 0] >= MIN_FROZEN_STEPS].tolist()
    for start, stop in long:
        frozen[start + 1 : stop + 1] = True
    is_noisy = not can_rest and _is_noisy(rows[~frozen], equal[~frozen[1:]])
    for start, stop in long:
        kept = slice(start + 1, stop + 1)
        # What goes on where it was has lost nothing; of what ends so, nobody knows.
        is_off = stop + 1 == len(rows) or _apart(rows[stop], rows[stop + 1]) > MIN_CATCH_UP
        is_lost = is_noisy and is_off and not may_lock
        frozen[kept] = is_lost or _catches_up(rows, is_next, start, stop)
        harmless[kept] = is_noisy and not frozen[stop]
    return frozen, harmless


def _is_noisy(rows: np.ndarray, equal: np.ndarray) -> bool:
    """Whether values are noisy: what hardly ever keeps a value keeps none for long."""
    if len(equal) < MIN_STEPS or equal.mean() > MAX_EQUAL_SHARE:
        return False
    some = rows[:NOISE_ROWS].astype(np.float64)
    num_distinct = np.array([len(np.unique(column)) for column in some.T])
    # Half of the columns: a number near one, as of a small rotation, has few digits left.
    if np.median(num_distinct[num_distinct > 1]) < MIN_DISTINCT_SHARE * len(some):
        return False
    steps = np.diff(some, axis=0)
    bends = np.diff(steps, axis=0)
    lengths = np.linalg.norm(bends, axis=1)
    scale = lengths[1:] * lengths[:-1]
    # A third of the steps, the smallest: noise shows where movement is slow.
    slow = np.linalg.norm(steps[1:-1], axis=1)
    known = (scale > 0) & (slow <= np.quantile(slow, 1 / 3))
    cosines = (bends[1:] * bends[:-1]).sum(axis=1)[known] / scale[known]
    return len(cosines) >= MIN_STEPS / 3 and bool(np.median(cosines) < MAX_NOISE_COSINE)


def _apart(some: np.ndarray, other: np.ndarray) -> float:
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


def check_camera_matrix(
    K: Float64[np.ndarray, "3 3"], size_px: tuple[int, int], *, where: str
) -> None:
    """Refuse a camera matrix (px) that no lens before images of width and height `size_px` has.

    Raises:
        InvalidInputError: not finite, not of this form, a principal point outside the image, or
            focal lengths below 0.1 or above 20 of its width, or unlike each other.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    width, height = size_px
    has_form = np.isfinite(K).all() and (K[[1, 2, 2, 2], [0, 0, 1, 2]] == [0, 0, 0, 1]).all()
    is_inside = has_form and 0 < cx < width and 0 < cy < height
    low, high = (width * factor for factor in FOCAL_WIDTHS)
    if not (is_inside and low <= fx <= high and 0.5 <= fy / fx <= 2):
        raise InvalidInputError(
            f"{where}: got focal lengths {fx:.4g}, {fy:.4g} and the principal point {cx:.4g}, "
            f"{cy:.4g} px for images of {width} by {height} px, expected {low:g} … {high:g} and a "
            "point inside the image (rows fx 0 cx, 0 fy cy, 0 0 1); calibrate the camera again",
            fault="camera_matrix",
        )


def _speeds(
    t_ns: np.ndarray, poses: np.ndarray, period_ns: int
) -> tuple[Float64[np.ndarray, " steps"], Float64[np.ndarray, " steps"]]:
    # Times of bursts are closer than the samples were.
    steps_s = np.maximum(np.diff(t_ns), max(period_ns / 2, MIN_STEP_NS)) / _NS_PER_S
    speeds_m_s = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / steps_s
    quaternions = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    cosines = np.abs((quaternions[1:] * quaternions[:-1]).sum(axis=1)).clip(max=1.0)
    return speeds_m_s, np.asarray(2 * np.arccos(cosines) / steps_s)


def _is_fast(speeds_m_s: np.ndarray, turns_rad_s: np.ndarray) -> Bool[np.ndarray, " steps"]:
    return np.asarray((speeds_m_s > MAX_SPEED_M_S) | (turns_rad_s > MAX_TURN_RAD_S))


def _unit(distance_m: float, speed_m_s: float | None) -> str | None:
    """The unit in which distance and speed are most like those of hands and heads."""
    ratios = [distance_m / _USUAL_DISTANCE_M]
    ratios += [] if speed_m_s is None else [speed_m_s / _USUAL_SPEED_M_S]
    found = np.maximum(ratios, 1e-9)
    off = {name: np.abs(np.log(found / factor)) for name, factor in _UNITS.items()}
    name = min(off, key=lambda unit: float(off[unit].sum()))
    return name if off[name].max() <= np.log(_USUAL_RATIO) else None


def _outliers(t_ns: np.ndarray, poses: np.ndarray, period_ns: int) -> Bool[np.ndarray, " n"]:
    """Poses between a way there and a way back that nothing can move."""
    outliers = np.zeros(len(poses), dtype=bool)
    if len(poses) < 2:
        return outliers
    fast = _is_fast(*_speeds(t_ns, poses, period_ns))
    steps = np.flatnonzero(fast)
    at = 0
    while at + 1 < len(steps):
        first, last = int(steps[at]), int(steps[at + 1])
        if t_ns[last] - t_ns[first] <= MAX_OUTLIER_NS and _is_away(t_ns, poses, first, last + 1):
            outliers[first + 1 : last + 1] = True
            at += 1
        at += 1
    if len(poses) < MIN_STEPS:
        return outliers
    # Samples of one delivery may have arrived at the same time.
    weight = ((t_ns[1:-1] - t_ns[:-2]) / np.maximum(t_ns[2:] - t_ns[:-2], 1))[:, None]
    between = poses[:-2, :3] * (1 - weight) + poses[2:, :3] * weight
    off = np.pad(poses[1:-1, :3] - between, ((1, 1), (0, 0)))
    off_m = np.linalg.norm(off, axis=1)
    step_s = np.maximum(np.maximum(np.diff(t_ns)[1:], np.diff(t_ns)[:-1]), period_ns) / _NS_PER_S
    needed_m = np.maximum(
        0.5 * MAX_ACCELERATION_M_S2 * step_s**2,
        max(MIN_OUTLIER_M, OUTLIER_SIGMAS * float(np.median(off_m[1:-1]))),
    )
    # The neighbours of an outlier are off the other way, by half as much. Those of a hand that hits
    # something are not.
    turns_back = [
        (off[1:-1] * other).sum(axis=1) < -0.2 * off_m[1:-1] ** 2 for other in (off[:-2], off[2:])
    ]
    # Beside the first and the last pose there is no such neighbour.
    turns_back[0][:1] = turns_back[1][-1:] = True
    outliers[1:-1] |= (off_m[1:-1] > needed_m) & turns_back[0] & turns_back[1]
    return outliers


def _is_away(t_ns: np.ndarray, poses: np.ndarray, before: int, after: int) -> bool:
    """Whether poses between two are elsewhere, while the hand came from one to the other."""
    span_s = (t_ns[after] - t_ns[before]) / _NS_PER_S
    ends = poses[[before, after]]
    way_m = float(np.linalg.norm(ends[1, :3] - ends[0, :3]))
    if way_m > MAX_RETURN_M_S * span_s + MIN_AWAY_M:
        return False
    amid = poses[before + 1 : after]
    middle = ends[:, :3].mean(axis=0)
    away_m = np.linalg.norm(amid[:, :3] - middle, axis=1) - way_m / 2
    units = poses[before : after + 1, 3:]
    units = units / np.linalg.norm(units, axis=1, keepdims=True)
    cosines = np.abs(units[1:-1] @ units[[0, -1]].T).min(axis=1).clip(max=1.0)
    turned = 2 * np.arccos(cosines) > MAX_TURN_RAD_S * MIN_STEP_NS / _NS_PER_S
    return bool(((away_m > MIN_AWAY_M) | turned).all())


def _excess(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    return np.maximum(lower - values, values - upper)


def _beyond(
    values: np.ndarray, lower_rad: np.ndarray, upper_rad: np.ndarray
) -> Bool[np.ndarray, " n"]:
    return np.asarray((_excess(values, lower_rad, upper_rad) > LIMIT_SLACK_RAD).any(axis=1))
