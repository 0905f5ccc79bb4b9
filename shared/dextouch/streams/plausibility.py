"""Checks whether values of a stream can be true: units, speeds, limits, frozen and repeated values.

Stations apply them to what devices send now, alignment to whole recordings.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.hands import CHAINS, NUM_KEYPOINTS, chain_indices
from dextouch.streams.repeats import (
    MIN_STEPS,
    MIN_STILL_STEPS,
    Implausible,
    ImplausibleCause,
    implausible_repeats,
    spread,
    still_parts,
)
from dextouch.streams.samples import StreamDescriptor
from dextouch.tactile.layout import SIDES

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
MIN_AWAY_M: Final = 0.02
MIN_OUTLIER_M: Final = 0.005
OUTLIER_SIGMAS: Final = 12.0
# Of turns of the wrist, whose speeds reach 60 rad/s within 20 ms at most.
MIN_LEAP_RAD: Final = 0.05
MAX_ACCELERATION_RAD_S2: Final = 3000.0
# Across lost samples, mean speeds differ by less from those before and after.
MAX_CHANGE_M_S: Final = 2.0
MAX_CHANGE_RAD_S: Final = 15.0
MAX_NORM_ERROR: Final = 0.1
# Focal lengths in widths of the image: fisheyes have 0.2, telephoto lenses 10.
FOCAL_WIDTHS: Final = (0.1, 20.0)
# Lenses are centred to some percent of the image's size; the matrix of an image of half the size is
# off by a quarter.
MAX_OFF_CENTRE: Final = 0.2
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
# A tracker on a person is centimetres off the joints about which it turns.
MIN_LEVER_M: Final = 1e-3
MIN_LEVER_RAD: Final = 0.2


def implausible_values(
    descriptor: StreamDescriptor,
    t_ns: Int64[np.ndarray, " n"],
    values: np.ndarray,
    *,
    of_robot: bool = False,
) -> list[Implausible]:
    """What is implausible in samples [n, …] of a stream of poses, joints or keypoints.

    Times increase. Only the unit is checked of what is commanded. What is `of_robot` may rest
    exactly; joints and poses in a robot's base always may.
    """
    if descriptor.kind == "pose" and descriptor.shape == (7,):
        can_rest = of_robot or descriptor.frame == "base"
        period_ns = descriptor.period_ns()
        found = implausible_poses(t_ns, values, period_ns=period_ns, can_rest=can_rest)
    elif descriptor.kind == "keypoints":
        # Gloves whose sensors are coarse rest, too.
        found = list(implausible_repeats(values, what="keypoints", may_lock=True))
        if values.shape[1:] == (NUM_KEYPOINTS, 3):
            found += _frozen_nodes(values, found)
    elif descriptor.kind == "robot_state" and (
        descriptor.unit == "rad" or descriptor.name.startswith("joints_")
    ):
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
    if (wrong := _implausible_size(seen_ns, seen, period_ns)) is not None:
        cause, message = wrong
        return [Implausible(cause, message, everything, whole=True)]
    # Only a leap between samples that follow each other shows that one was frozen before.
    follows = np.diff(seen_ns) < 1.5 * period_ns
    repeats = list(implausible_repeats(seen, can_rest=can_rest, follows=follows))
    if not can_rest:
        repeats += _frozen_axes(seen, repeats)
    found += [replace(one, samples=spread(one.samples, known, len(values))) for one in repeats]
    new = known[~np.any([one.samples[known] for one in found], axis=0)] if found else known
    jumps = spread(_outliers(np.asarray(t_ns)[new], values[new], period_ns), new, len(values))
    if jumps.any():
        num, more = int(jumps.sum()), ("" if jumps.sum() == 1 else "s")
        message = f"{num} pose{more} away from those before and after, as nothing can move"
        found.append(Implausible("jump", message, jumps))
    return found


def _implausible_size(
    t_ns: np.ndarray, poses: np.ndarray, period_ns: int
) -> tuple[ImplausibleCause, str] | None:
    """Distances or speeds that no hand has: cause and message."""
    speeds_m_s, turns_rad_s = _speeds(t_ns, poses, period_ns)
    fast = _is_fast(speeds_m_s, turns_rad_s)
    distance_m = float(np.median(np.linalg.norm(poses[:, :3], axis=1)))
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
        return cause, f"{got}, {expected}{hint}"
    return None


def _frozen_nodes(keypoints: np.ndarray, repeats: list[Implausible]) -> Iterator[Implausible]:
    """Fingers that repeat what they were, and nodes that stand still though they are noisy."""
    moved, rested = np.zeros((2, *keypoints.shape[:2]), dtype=bool)
    for chain in CHAINS:
        nodes = np.array(chain_indices(chain))
        for one in implausible_repeats(keypoints[:, nodes], what=chain, may_lock=True):
            (rested if one.harmless else moved)[np.ix_(one.samples, nodes)] = True
    for node, gone, harmless in still_parts(keypoints.astype(np.float64)):
        moved[:, node] |= gone
        rested[:, node] |= harmless
    known = np.any([one.samples for one in repeats], axis=0) if repeats else False
    for found, is_harmless in ((moved, False), (rested & ~moved, True)):
        nodes = found & ~np.reshape(known, (-1, 1))
        if nodes.any():
            chains = [c for c in CHAINS if nodes[:, list(chain_indices(c))].any()]
            message = f"{', '.join(chains)} frozen in {nodes.any(axis=1).sum()} samples"
            yield Implausible(
                "frozen", message, nodes.any(axis=1), harmless=is_harmless, nodes=nodes
            )


def _frozen_axes(poses: np.ndarray, repeats: list[Implausible]) -> Iterator[Implausible]:
    """One axis or the rotation stands still while the others move, or all of it does nearly."""
    flips = (poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1) < 0
    turns = poses[:, 3:] * np.cumprod(np.append(1, 1 - 2 * flips))[:, None]
    moved, rested = np.zeros((2, len(poses)), dtype=bool)
    names = []
    for parts, of in ((poses[:, :3, None], "xyz"), (turns[:, None], ("rotation",))):
        for part, gone, harmless in still_parts(parts):
            moved, rested = moved | gone, rested | harmless
            names.append(of[part])
    known = np.any([one.samples for one in repeats], axis=0) if repeats else moved & False
    for samples, is_harmless in ((moved & ~known, False), (rested & ~moved & ~known, True)):
        if samples.sum() >= MIN_STILL_STEPS:
            message = f"{', '.join(names)} of poses stand still in {samples.sum()} samples"
            yield Implausible("frozen", message, samples, harmless=is_harmless)
    way_m, turned_rad = _extent(poses)
    if len(poses) >= MIN_STEPS and way_m < MIN_LEVER_M and turned_rad > MIN_LEVER_RAD:
        message = (
            f"poses turn by {np.degrees(turned_rad):.0f} degrees but stay within "
            f"{way_m * 1e3:.2g} mm: positions are not tracked, or are in another unit"
        )
        yield Implausible("frozen", message, np.ones(len(poses), dtype=bool), whole=True)


def _extent(poses: np.ndarray) -> tuple[float, float]:
    """How far 95 % of the poses are from the middle, in m and rad."""
    way_m = np.linalg.norm(poses[:, :3] - np.median(poses[:, :3], axis=0), axis=1)
    middle = poses[len(poses) // 2, 3:]
    lengths = np.linalg.norm(poses[:, 3:], axis=1) * np.linalg.norm(middle)
    turns_rad = 2 * np.arccos(np.abs(poses[:, 3:] @ middle / lengths).clip(max=1.0))
    return float(np.percentile(way_m, 95)), float(np.percentile(turns_rad, 95))


def lasting_jumps(
    t_ns: Int64[np.ndarray, " n"], poses: np.ndarray, *, period_ns: int
) -> Int64[np.ndarray, " jumps"]:
    """Samples from which on a tracker's world is another, of poses [n, 7] without outliers."""
    if len(poses) < 2:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(_leaps(t_ns, np.asarray(poses, dtype=np.float64), period_ns)) + 1


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


def check_camera_matrix(
    K: Float64[np.ndarray, "3 3"], size_px: tuple[int, int], *, where: str
) -> None:
    """Refuse a camera matrix (px) that no lens before images of width and height `size_px` has.

    Raises:
        InvalidInputError: not finite, not of this form, a principal point far from the middle, or
            focal lengths below 0.1 or above 20 of its width, or unlike each other.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    width, height = size_px
    has_form = np.isfinite(K).all() and (K[[1, 2, 2, 2], [0, 0, 1, 2]] == [0, 0, 0, 1]).all()
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5)) if has_form else np.inf
    low, high = (width * factor for factor in FOCAL_WIDTHS)
    if not (off <= MAX_OFF_CENTRE and low <= fx <= high and 0.5 <= fy / fx <= 2):
        raise InvalidInputError(
            f"{where}: got focal lengths {fx:.4g}, {fy:.4g} and the principal point {cx:.4g}, "
            f"{cy:.4g} px for images of {width} by {height} px, expected {low:g} … {high:g} and a "
            f"point within {MAX_OFF_CENTRE:g} of the image's size from its middle (rows fx 0 cx, "
            "0 fy cy, 0 0 1); is it of another resolution? calibrate the camera again",
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


def _leaps(t_ns: np.ndarray, poses: np.ndarray, period_ns: int) -> Bool[np.ndarray, " steps"]:
    """Steps that are too fast, or further than those beside lead at any acceleration."""
    leaps = _is_fast(*_speeds(t_ns, poses, period_ns))
    if len(poses) < MIN_STEPS:
        return leaps
    step_s = np.maximum(np.diff(t_ns), period_ns)[:, None] / _NS_PER_S
    q = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    cosines = (q[1:] * q[:-1]).sum(axis=1, keepdims=True)
    # Twice the part of a quaternion that is across the one before: its turn, up to its cube.
    turns_rad = 2 * (q[1:] * np.sign(cosines) - np.abs(cosines) * q[:-1])
    for moves, least, change, acceleration in (
        (np.diff(poses[:, :3], axis=0), MIN_OUTLIER_M, MAX_CHANGE_M_S, MAX_ACCELERATION_M_S2),
        (turns_rad, MIN_LEAP_RAD, MAX_CHANGE_RAD_S, MAX_ACCELERATION_RAD_S2),
    ):
        speeds = moves / step_s
        before, after = speeds[:-2] * step_s[1:-1], speeds[2:] * step_s[1:-1]
        way = after - before
        along = ((moves[1:-1] - before) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-18)
        nearest = before + along.clip(0, 1)[:, None] * way
        off = np.linalg.norm(moves[1:-1] - nearest, axis=1)
        span_s = step_s[1:-1, 0]
        possible = np.minimum(0.25 * acceleration * span_s, change) * span_s
        needed = np.maximum(possible, max(least, OUTLIER_SIGMAS * float(np.median(off))))
        leaps[1:-1] |= off > needed
    return leaps


def _outliers(t_ns: np.ndarray, poses: np.ndarray, period_ns: int) -> Bool[np.ndarray, " n"]:
    """Poses between a way there and a way back that nothing can move."""
    outliers = np.zeros(len(poses), dtype=bool)
    if len(poses) < 2:
        return outliers
    steps = np.flatnonzero(_leaps(t_ns, poses, period_ns))
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
