"""Path delays of all streams that were shaken together: trackers, cameras, hands in the world.

What is rigidly connected turns alike: each stream shows the same angular velocity, in axes of its
own. For every two of them the turn between their axes (Kabsch) and the offset in time are
estimated; the offsets of all pairs are adjusted together, and must agree around every loop.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.spatial.transform import Rotation

from dextouch.errors import DexTouchError, InvalidInputError
from services.alignment.calibration.motion import DegenerateMotionError
from services.alignment.calibration.time_offset import TimeOffset, estimate_time_offset

# A loop of three offsets that misses zero by more standard deviations has a wrong one among them;
# so has a pair whose offsets in either half are as far apart.
MAX_SIGMAS: Final = 4.0
# Chosen: corners that are followed from image to image, their least distance and quality, in images
# of at most this width; twice as many in larger ones gave no smaller error.
_NUM_CORNERS: Final = 200
_CORNER_PX: Final = 8
_CORNER_QUALITY: Final = 0.01
_MAX_WIDTH_PX: Final = 480
# Of fewer no rotation is fitted; two bearings would do, but some belong to what moves.
_LEAST_CORNERS: Final = 12
# A corner that does not come back to within so many pixels when it is followed backwards is lost.
_RETURN_PX: Final = 1.0
# Bearings that are off the fitted rotation by more than this many times the median are not counted.
_OUTLIER_RATIO: Final = 3.0
_FITS: Final = 4


@dataclass(frozen=True)
class Turning:
    """Angular velocity [n, 3] of a stream, rad/s, in any axes that turn with it, at times."""

    t_ns: Int64[np.ndarray, " n"]
    velocity_rad_s: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class PairOffset:
    """Offset to be added to the times of stream `b` so that it agrees with stream `a`."""

    a: str
    b: str
    offset: TimeOffset


@dataclass(frozen=True)
class SharedTimes:
    """Delays of streams after a reference, which has 0.

    `pairs` are the measured offsets, `unusable` says why others are not, and `loop_sigmas` is the
    largest error of a loop of three of them, in standard deviations; 0 without a loop.
    """

    reference: str
    delays: dict[str, TimeOffset]
    pairs: tuple[PairOffset, ...]
    unusable: dict[tuple[str, str], str]
    loop_sigmas: float


def turning_of_rotations(
    t_ns: Int64[np.ndarray, " n"], Rs: Float64[np.ndarray, "n 3 3"]
) -> Turning:
    """Angular velocity between samples of an orientation, in axes of the body."""
    turns = Rotation.from_matrix(np.swapaxes(Rs[:-1], -1, -2) @ Rs[1:])
    steps_ns = np.diff(t_ns)
    return Turning(t_ns[:-1] + steps_ns // 2, turns.as_rotvec() / (steps_ns[:, None] * 1e-9))


def turning_of_points(
    t_ns: Int64[np.ndarray, " n"], points_m: Float64[np.ndarray, "n points 3"]
) -> Turning:
    """Angular velocity of a rigid set of points in the world, such as a palm's nodes."""
    centred = points_m - points_m.mean(axis=1, keepdims=True)
    Rs = [Rotation.align_vectors(later, centred[0])[0].as_matrix() for later in centred]
    return turning_of_rotations(t_ns, np.stack(Rs))


def turning_of_images(
    t_ns: Int64[np.ndarray, " n"],
    images: Iterable[UInt8[np.ndarray, "h w 3"]],
    K: Float64[np.ndarray, "3 3"],
    distortion: Float64[np.ndarray, "5"],
) -> Turning:
    """Angular velocity of a camera from the corners that consecutive images share, in its axes.

    What is far away moves by the rotation alone; what is near or moves by itself is left out as far
    as most corners agree. Steps without enough corners (blur, a bare wall) have none.

    Raises:
        DegenerateMotionError: fewer than half of the steps show enough corners.
    """
    times_ns, turns = list[int](), list[np.ndarray]()
    steps_ns = np.diff(t_ns)
    grays = (_small_gray(image) for image in images)
    for index, ((before, scale), (after, _)) in enumerate(pairwise(grays)):
        K_small = np.diag([scale, scale, 1.0]) @ K
        turn_rad = _turn_between(before, after, K_small, distortion)
        if turn_rad is not None:
            times_ns.append(int(t_ns[index] + steps_ns[index] // 2))
            turns.append(turn_rad / (steps_ns[index] * 1e-9))
    if len(turns) < max(2, len(steps_ns) // 2):
        raise DegenerateMotionError(
            f"camera: {len(turns)} of {len(steps_ns)} steps between images show {_LEAST_CORNERS} "
            "corners or more; turn the camera towards a room with edges, in good light, or more "
            "slowly"
        )
    return Turning(np.array(times_ns, dtype=np.int64), np.stack(turns))


def _small_gray(image: np.ndarray) -> tuple[UInt8[np.ndarray, "h w"], float]:
    """A gray image of at most `_MAX_WIDTH_PX`, and its width over that of the image."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, _MAX_WIDTH_PX / gray.shape[1])
    if scale == 1.0:
        return gray, scale
    return cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale


def _turn_between(
    before: np.ndarray, after: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> Float64[np.ndarray, "3"] | None:
    """Rotation vector of a camera between two gray images, in its axes; None if it is not seen."""
    corners = cv2.goodFeaturesToTrack(before, _NUM_CORNERS, _CORNER_QUALITY, _CORNER_PX)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.zeros_like(corners))
    again, back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, np.zeros_like(corners))
    off_px = np.linalg.norm((again - corners)[:, 0], axis=1)
    kept = (found[:, 0] > 0) & (back[:, 0] > 0) & (off_px <= _RETURN_PX)
    if np.count_nonzero(kept) < _LEAST_CORNERS:
        return None
    rays = []
    for places in (corners[kept], moved[kept]):
        # The middle of OpenCV's first pixel is 0, that of ours 0.5.
        flat = cv2.undistortPoints(places.astype(np.float64) + 0.5, K, distortion)[:, 0]
        ray = np.column_stack([flat, np.ones(len(flat))])
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    usable = np.ones(len(rays[0]), dtype=bool)
    turn = Rotation.identity()
    for _ in range(_FITS):
        # Directions that stay turn the other way in the camera's axes.
        turn, _ = Rotation.align_vectors(rays[0][usable], rays[1][usable])
        off = np.linalg.norm(turn.apply(rays[1]) - rays[0], axis=1)
        usable = off <= _OUTLIER_RATIO * max(float(np.median(off)), 1e-6)
        if np.count_nonzero(usable) < _LEAST_CORNERS:
            return None
    return np.asarray(turn.as_rotvec())


def pair_offset(a: Turning, b: Turning) -> TimeOffset:
    """Offset to be added to b's times to align it with a, of streams that turn together.

    Raises:
        DegenerateMotionError, InvalidInputError: as `estimate_time_offset`, or it is another one in
            each half of the time.
    """
    speeds = [np.linalg.norm(one.velocity_rad_s, axis=1) for one in (a, b)]
    rough = estimate_time_offset(a.t_ns, speeds[0], b.t_ns, speeds[1])
    t_b_ns = b.t_ns + rough.offset_ns
    inside = (a.t_ns >= t_b_ns[0]) & (a.t_ns <= t_b_ns[-1])
    mine = a.velocity_rad_s[inside]
    other = np.stack(
        [np.interp(a.t_ns[inside], t_b_ns, column) for column in b.velocity_rad_s.T], axis=1
    )
    turn, _ = Rotation.align_vectors(mine, other)
    turned_rad_s = np.asarray(turn.apply(b.velocity_rad_s))
    middle_ns = int(a.t_ns[inside][len(mine) // 2])

    def offset(taken: slice | np.ndarray) -> TimeOffset:
        return estimate_time_offset(a.t_ns[taken], a.velocity_rad_s[taken], b.t_ns, turned_rad_s)

    halves = offset(a.t_ns < middle_ns), offset(a.t_ns >= middle_ns)
    apart_ns = abs(halves[0].offset_ns - halves[1].offset_ns)
    if apart_ns > MAX_SIGMAS * np.hypot(halves[0].sigma_ns, halves[1].sigma_ns):
        raise DegenerateMotionError(
            f"times: the offset is {halves[0].offset_ns * 1e-6:.1f} ms in the first half of the "
            f"take and {halves[1].offset_ns * 1e-6:.1f} ms in the second; a clock stopped or was "
            "set, or the path became slower: record the take again"
        )
    return offset(slice(None))


def shared_times(turnings: Mapping[str, Turning], reference: str) -> SharedTimes:
    """Delays of streams after the reference, from the offsets of all pairs.

    A delay's standard deviation is that of the best chain of pairs to the reference: more pairs of
    the same streams share their noise, and make it no smaller. What loops miss zero by is added.

    Raises:
        DegenerateMotionError: a stream that agrees with no other one, or loops that do not close:
            one of their streams moved by itself.
        InvalidInputError: fewer than two streams, or the reference is none of them.
    """
    if len(turnings) < 2 or reference not in turnings:
        raise InvalidInputError(
            f"times: got streams {sorted(turnings)} and reference {reference!r}; expected two "
            "streams at least, the reference among them"
        )
    pairs, unusable = list[PairOffset](), dict[tuple[str, str], str]()
    for a, b in combinations(turnings, 2):
        try:
            pairs.append(PairOffset(a, b, pair_offset(turnings[a], turnings[b])))
        except DexTouchError as error:
            unusable[a, b] = error.message
    names = list(turnings)
    sigmas_ns = _chain_sigmas_ns(names, pairs, reference)
    lone = [name for name in names if not np.isfinite(sigmas_ns[name])]
    if lone:
        reasons = [text for pair, text in unusable.items() if lone[0] in pair]
        raise DegenerateMotionError(
            f"times: {', '.join(lone)} turned like no stream that leads to {reference!r} "
            f"({reasons[0]}); hold everything together rigidly and shake it briskly about all axes "
            "for ten seconds, or leave the stream out with --streams",
            streams=lone,
        )
    loop_sigmas = _check_loops(names, pairs)
    delays_ns, misses_ns = _adjusted_ns(names, pairs, reference)
    delays = {
        name: TimeOffset(
            round(delays_ns[name]),
            0 if name == reference else max(1, round(np.hypot(sigmas_ns[name], misses_ns))),
        )
        for name in names
    }
    return SharedTimes(reference, delays, tuple(pairs), unusable, loop_sigmas)


def _adjusted_ns(
    names: Sequence[str], pairs: Sequence[PairOffset], reference: str
) -> tuple[dict[str, float], float]:
    """Delays that fit all offsets best, weighted by their sigmas, and what these miss by (RMS)."""
    design, offsets, weights = np.zeros((len(pairs), len(names))), [], []
    for row, pair in enumerate(pairs):
        # b is later than a by as much as must be subtracted from its times.
        design[row, names.index(pair.b)], design[row, names.index(pair.a)] = 1.0, -1.0
        offsets.append(-pair.offset.offset_ns)
        weights.append(1.0 / pair.offset.sigma_ns)
    free = [index for index, name in enumerate(names) if name != reference]
    scale = np.array(weights)
    found, *_ = np.linalg.lstsq(
        design[:, free] * scale[:, None], np.array(offsets, dtype=np.float64) * scale, rcond=None
    )
    delays = dict.fromkeys(names, 0.0) | {
        names[index]: float(value) for index, value in zip(free, found, strict=True)
    }
    spare = len(pairs) - len(free)
    if not spare:
        return delays, 0.0
    left_ns = design[:, free] @ found - np.array(offsets)
    return delays, float(np.sqrt(np.square(left_ns).sum() / len(pairs)))


def _chain_sigmas_ns(
    names: Sequence[str], pairs: Sequence[PairOffset], reference: str
) -> dict[str, float]:
    """Standard deviation of each delay by the chain of pairs with the smallest one."""
    variances = dict.fromkeys(names, np.inf) | {reference: 0.0}
    for _ in names:
        for pair in pairs:
            step = float(pair.offset.sigma_ns) ** 2
            for one, other in ((pair.a, pair.b), (pair.b, pair.a)):
                variances[one] = min(variances[one], variances[other] + step)
    return {name: float(np.sqrt(value)) for name, value in variances.items()}


def _check_loops(names: Sequence[str], pairs: Sequence[PairOffset]) -> float:
    """The largest error of a loop of three offsets in standard deviations.

    Raises:
        DegenerateMotionError: it is too large; names the stream that the wrong loops share.
    """
    of = {(pair.a, pair.b): pair.offset for pair in pairs}
    worst, wrong, wrong_ms = 0.0, list[tuple[str, str, str]](), 0.0
    for loop in combinations(names, 3):
        a, b, c = loop
        if not {(a, b), (b, c), (a, c)} <= set(of):
            continue
        sides = of[a, b], of[b, c], of[a, c]
        miss_ns = sides[0].offset_ns + sides[1].offset_ns - sides[2].offset_ns
        sigmas = abs(miss_ns) / float(np.sqrt(sum(float(one.sigma_ns) ** 2 for one in sides)))
        worst = max(worst, sigmas)
        if sigmas > MAX_SIGMAS:
            wrong.append(loop)
            wrong_ms = max(wrong_ms, abs(miss_ns) * 1e-6)
    if wrong:
        shared = set(wrong[0]).intersection(*wrong[1:]) if len(wrong) > 1 else set(wrong[0])
        blamed = ", ".join(sorted(shared or {name for loop in wrong for name in loop}))
        raise DegenerateMotionError(
            f"times: offsets around a loop miss zero by {wrong_ms:.1f} ms, {worst:.1f} standard "
            f"deviations, expected at most {MAX_SIGMAS:g}: {blamed} did not move with the "
            "others all the time, or lost samples; fix it more rigidly and repeat",
            streams=sorted(shared),
        )
    return worst
