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
# A wrist of a fast movement accelerates by some 100 m/s². A single pose that needs more is none.
MAX_ACCELERATION_M_S2: Final = 300.0
# Rooms in which people are tracked are smaller.
MAX_DISTANCE_M: Final = 30.0
# Above this share of wrong steps nothing can be left out: the whole stream is wrong.
MAX_WRONG_SHARE: Final = 0.05
# A pose that is elsewhere for longer is no outlier: the tracker has moved its world.
MAX_OUTLIER_NS: Final = 300_000_000
MIN_OUTLIER_M: Final = 0.005
OUTLIER_SIGMAS: Final = 12.0
MAX_NORM_ERROR: Final = 0.1
# As many equal steps are a frozen stream, if steps are otherwise hardly ever equal.
MIN_FROZEN_STEPS: Final = 5
MAX_EQUAL_SHARE: Final = 0.01
MIN_STEPS: Final = 60
# A value that comes k times: so many of the intervals between changes are k samples.
MIN_REGULAR_SHARE: Final = 0.85
MIN_CHANGES: Final = 20
# Second differences of white noise turn back (a cosine of -2/3), those of a movement do not.
MAX_NOISE_COSINE: Final = -0.2
# The step at the end of a freeze, beside those that follow.
CATCH_UP_STEPS: Final = 4.0
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
_TO_M_S: Final = 1e9


@dataclass(frozen=True)
class Implausible:
    """One reason not to believe samples of a stream.

    Attributes:
        cause: what is wrong.
        message: what was found and what was expected.
        samples: those concerned; they can be left out unless `whole`.
        whole: the values mean something else throughout.
        factor: how many samples a repeated value has; 1 of all else.
    """

    cause: ImplausibleCause
    message: str
    samples: Bool[np.ndarray, " n"]
    whole: bool = False
    factor: int = 1


def implausible_values(
    descriptor: StreamDescriptor,
    t_ns: Int64[np.ndarray, " n"],
    values: np.ndarray,
    *,
    of_robot: bool = False,
) -> list[Implausible]:
    """What is implausible in samples of a stream of poses, joints or keypoints; of others nothing.

    What is commanded may leap and may be kept: only unit and limits of it are checked.

    Args:
        descriptor: of the stream.
        t_ns: increasing times.
        values: [n, …] as the device sends them.
        of_robot: whether what they show may rest exactly. Joints and poses in a robot's base do.
    """
    if descriptor.kind == "pose":
        can_rest = of_robot or descriptor.frame == "base"
        period_ns = descriptor.period_ns()
        found = implausible_poses(t_ns, values, period_ns=period_ns, can_rest=can_rest)
    elif descriptor.kind == "keypoints":
        found = list(implausible_repeats(values, what="keypoints"))
    elif descriptor.kind == "robot_state" and descriptor.unit == "rad":
        lower_rad, upper_rad = _limits_rad()
        if values.shape[1:] != lower_rad.shape:
            return []
        found = implausible_joints(values, lower_rad, upper_rad)
    else:
        return []
    is_commanded = descriptor.name.endswith("_commanded")
    return [one for one in found if one.whole or not is_commanded]


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
    """What is implausible in poses of a tracked hand or head.

    Args:
        t_ns: increasing times.
        poses: [n, 7] position (m) and quaternion (w, x, y, z); samples with NaN or a quaternion of
            zeros are lost, not implausible.
        period_ns: nominal period.
        can_rest: of a robot, see `implausible_repeats`.
    """
    values = np.asarray(poses, dtype=np.float64)
    norms = np.linalg.norm(values[:, 3:], axis=1)
    known = np.flatnonzero(np.isfinite(values).all(axis=1) & (norms > 0))
    if not len(known):
        return []
    everything = np.ones(len(values), dtype=bool)
    is_wrong = np.abs(norms[known] - 1) > MAX_NORM_ERROR
    if is_wrong.mean() > MAX_WRONG_SHARE:
        norm = float(np.median(norms[known][is_wrong]))
        return [
            Implausible(
                "norm",
                f"quaternions have a norm of {norm:.3g}, expected 1: are these other angles, or "
                "other columns?",
                everything,
                whole=True,
            )
        ]
    seen, seen_ns = values[known], np.asarray(t_ns)[known]
    speeds_m_s, fast = _speeds(seen_ns, seen, period_ns)
    distance_m = float(np.median(np.linalg.norm(seen[:, :3], axis=1)))
    is_fast = len(fast) >= 1 / MAX_WRONG_SHARE and fast.mean() > MAX_WRONG_SHARE
    if distance_m > MAX_DISTANCE_M or is_fast:
        # Drivers drop what is too fast: there may be a single pose.
        speed_m_s = float(np.percentile(speeds_m_s, 95)) if len(speeds_m_s) else None
        found = f"a distance of {distance_m:.3g} m"
        found += "" if speed_m_s is None else f" and a speed (95 %) of {speed_m_s:.3g} m/s"
        unit = _unit(distance_m, speed_m_s)
        expected = f"expected below {MAX_DISTANCE_M:g} m and {MAX_SPEED_M_S:g} m/s"
        told = f": these look like {unit}, send metres" if unit else ""
        cause: ImplausibleCause = "unit" if unit else "speed"
        return [Implausible(cause, f"{found}, {expected}{told}", everything, whole=True)]
    found_here = []
    new = known
    for one in implausible_repeats(seen, can_rest=can_rest):
        again = np.zeros(len(values), dtype=bool)
        again[known] = one.samples
        found_here.append(replace(one, samples=again))
        new = known[~one.samples]
    jumps = np.zeros(len(values), dtype=bool)
    jumps[new] = _outliers(np.asarray(t_ns)[new], values[new], period_ns)
    if jumps.any():
        num, more = int(jumps.sum()), ("" if jumps.sum() == 1 else "s")
        message = f"{num} pose{more} away from those before and after, as no hand can move"
        found_here.append(Implausible("jump", message, jumps))
    return found_here


def lasting_jumps(
    t_ns: Int64[np.ndarray, " n"], poses: np.ndarray, *, period_ns: int
) -> Int64[np.ndarray, " jumps"]:
    """Numbers of the samples from which on a tracker's world is another: it found itself anew.

    Args:
        t_ns: increasing times of poses that were all seen.
        poses: [n, 7], without outliers.
        period_ns: nominal period.
    """
    if len(poses) < 2:
        return np.zeros(0, dtype=np.int64)
    _, fast = _speeds(t_ns, np.asarray(poses, dtype=np.float64), period_ns)
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
        most_rad = float(np.abs(values[finite, joint]).max())
        limits = f"{lower_rad[joint]:.2f} … {upper_rad[joint]:.2f} rad"
        message = f"joint {joint} is at {most_rad:.3g} rad, expected {limits}"
        whole = float(beyond[finite].mean()) > MAX_WRONG_SHARE
        in_degrees = not _beyond(np.radians(values[finite]), lower_rad, upper_rad).any()
        usual_rad = float(np.percentile(np.abs(values[finite]), 90))
        is_unit = whole and in_degrees and usual_rad > np.abs([lower_rad, upper_rad]).max()
        told = ": these look like degrees, send radians" if is_unit else ""
        cause: ImplausibleCause = "unit" if is_unit else "limits"
        found.append(Implausible(cause, message + told, beyond, whole=whole))
    return found


def implausible_repeats(
    values: np.ndarray, *, what: str = "values", can_rest: bool = False
) -> Iterator[Implausible]:
    """Values [n, …] that a device repeats: every one several times, or the last one for a while.

    Equal values of a device whose values are not noisy are frozen only if it leaps afterwards.

    Args:
        values: consecutive samples; NaN equals nothing.
        what: of the stream, in words.
        can_rest: as robots do, which keep their values exactly though they are noisy in motion.
    """
    rows = np.asarray(values).reshape(len(values), -1)
    equal = (rows[1:] == rows[:-1]).all(axis=1)
    if len(equal) < MIN_STEPS or not equal.any():
        return
    again = np.concatenate([[False], equal])
    changes = np.flatnonzero(~equal) + 1
    intervals = np.diff(changes)
    if len(intervals) >= MIN_CHANGES:
        times = int(np.median(intervals))
        if 2 <= times <= MIN_FROZEN_STEPS and (intervals == times).mean() >= MIN_REGULAR_SHARE:
            message = f"{what} come {times} times each: the device repeats what it has"
            yield Implausible("repeated", message, again, factor=times)
            return
    edges = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    long = runs[runs[:, 1] - runs[:, 0] >= MIN_FROZEN_STEPS]
    frozen = np.zeros(len(rows), dtype=bool)
    for start, stop in long.tolist():
        frozen[start + 1 : stop + 1] = True
    is_noisy = not can_rest and _is_noisy(rows, equal[~frozen[1:]])
    for start, stop in long.tolist():
        frozen[start + 1 : stop + 1] = is_noisy or _catches_up(rows, stop)
    if frozen.any():
        message = f"{what} are frozen in {frozen.sum()} samples, though they move before or after"
        yield Implausible("frozen", message, frozen)


def _is_noisy(rows: np.ndarray, equal: np.ndarray) -> bool:
    """Whether values are noisy: what hardly ever keeps a value keeps none for long."""
    if len(equal) < MIN_STEPS or equal.mean() > MAX_EQUAL_SHARE:
        return False
    bends = np.diff(rows.astype(np.float64), n=2, axis=0)
    lengths = np.linalg.norm(bends, axis=1)
    scale = lengths[1:] * lengths[:-1]
    known = np.isfinite(scale) & (scale > 0)
    cosines = (bends[1:] * bends[:-1]).sum(axis=1)[known] / scale[known]
    return len(cosines) >= MIN_STEPS and bool(np.median(cosines) < MAX_NOISE_COSINE)


def _catches_up(rows: np.ndarray, stop: int) -> bool:
    """Whether a value that was kept until sample `stop` leaps to where the device was meanwhile."""
    steps = np.linalg.norm(np.diff(rows[stop : stop + 7].astype(np.float64), axis=0), axis=1)
    usual = float(np.median(steps[1:])) if len(steps) > 2 else 0.0
    return usual > 0 and bool(steps[0] > CATCH_UP_STEPS * usual)


def check_camera_matrix(
    K: Float64[np.ndarray, "3 3"], size_px: tuple[int, int], *, where: str
) -> None:
    """Refuse a camera matrix that no lens in front of these images has.

    Args:
        K: pinhole intrinsics in pixels.
        size_px: width and height of the images.
        where: names the matrix in the error.

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
) -> tuple[Float64[np.ndarray, " steps"], Bool[np.ndarray, " steps"]]:
    """Speed of each step, and whether the body cannot be as fast."""
    # Times of bursts are closer than the samples were.
    steps_s = np.maximum(np.diff(t_ns), period_ns / 2) / _TO_M_S
    speeds_m_s = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / steps_s
    quaternions = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    cosines = np.abs((quaternions[1:] * quaternions[:-1]).sum(axis=1)).clip(max=1.0)
    turns_rad_s = 2 * np.arccos(cosines) / steps_s
    return speeds_m_s, (speeds_m_s > MAX_SPEED_M_S) | (turns_rad_s > MAX_TURN_RAD_S)


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
    _, fast = _speeds(t_ns, poses, period_ns)
    steps = np.flatnonzero(fast)
    at = 0
    while at + 1 < len(steps):
        first, last = int(steps[at]), int(steps[at + 1])
        there = [first, last + 1]
        _, is_apart = _speeds(t_ns[there], poses[there], period_ns)
        if t_ns[last] - t_ns[first] <= MAX_OUTLIER_NS and not is_apart[0]:
            outliers[first + 1 : last + 1] = True
            at += 1
        at += 1
    if len(poses) < MIN_STEPS:
        return outliers
    # Samples of one delivery may have arrived at the same time.
    weight = ((t_ns[1:-1] - t_ns[:-2]) / np.maximum(t_ns[2:] - t_ns[:-2], 1))[:, None]
    between = poses[:-2, :3] * (1 - weight) + poses[2:, :3] * weight
    off_m = np.linalg.norm(poses[1:-1, :3] - between, axis=1)
    step_s = np.maximum(np.maximum(np.diff(t_ns)[1:], np.diff(t_ns)[:-1]), period_ns) / _TO_M_S
    needed_m = np.maximum(
        0.5 * MAX_ACCELERATION_M_S2 * step_s**2,
        max(MIN_OUTLIER_M, OUTLIER_SIGMAS * float(np.median(off_m))),
    )
    # The neighbours of an outlier are off, too, by half as much.
    around = np.concatenate([[0.0], off_m, [0.0]])
    largest = (off_m >= around[:-2]) & (off_m >= around[2:])
    outliers[1:-1] |= (off_m > needed_m) & largest & ~(fast[:-1] ^ fast[1:])
    return outliers


def _excess(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    return np.maximum(lower - values, values - upper)


def _beyond(
    values: np.ndarray, lower_rad: np.ndarray, upper_rad: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Samples in which a joint is far beyond its limits."""
    return np.asarray((_excess(values, lower_rad, upper_rad) > LIMIT_SLACK_RAD).any(axis=1))
