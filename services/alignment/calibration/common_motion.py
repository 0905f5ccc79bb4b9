"""Path delays of all streams that were shaken together: trackers, cameras, hands in the world."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.interpolate import CubicSpline
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.geometry import Distortion
from services.alignment.calibration.motion import DegenerateMotionError, hat
from services.alignment.calibration.time_offset import (
    CUTOFF_HZ,
    SIGMA_FACTOR,
    TimeOffset,
    checked_signal,
    estimate_time_offset,
    low_passed,
    usual_period_s,
)
from services.alignment.markers import gray_image

# A loop of three offsets that misses zero by more standard deviations has a wrong one among them;
# so has a pair whose offset in a part of the take is as far off.
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
# Of a take in which the offset must be the same; two seconds of ten show it.
_NUM_PARTS: Final = 5
_MAX_ITERATIONS: Final = 30
# Brisk irregular motion gives 0.1 … 0.4 ms. Where it is much more, offset and turn can hardly be
# told apart, and noise in the streams biases both: circling with 0.3° of noise was off by 9 ms.
_MAX_SIGMA_S: Final = 1.5e-3
# Splines through samples of exact streams are no better.
_LEAST_SIGMA_S: Final = 1e-4


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
    """Delays of streams after a reference, which has 0, and the pairs of streams they come from.

    `unusable` says why pairs are missing; `loop_sigmas` is the largest error of a loop of three.
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
    images: Iterable[UInt8[np.ndarray, "h w *c"]],
    K: Float64[np.ndarray, "3 3"],
    distortion: Distortion,
) -> Turning:
    """Angular velocity of a camera from the corners that consecutive images share, in its axes.

    What is near or moves by itself is left out as far as most corners agree; steps without enough
    corners (blur, a bare wall) have none. Raises DegenerateMotionError: fewer than half have
    enough.
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
    gray = gray_image(image)
    scale = min(1.0, _MAX_WIDTH_PX / gray.shape[1])
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return gray, scale


def _turn_between(
    before: np.ndarray, after: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> Float64[np.ndarray, "3"] | None:
    """Rotation vector of a camera between two gray images, in its axes; None if it is not seen."""
    corners = cv2.goodFeaturesToTrack(before, _NUM_CORNERS, _CORNER_QUALITY, _CORNER_PX)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.zeros_like(corners))
    returned, back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, np.zeros_like(corners))
    off_px = np.linalg.norm((returned - corners)[:, 0], axis=1)
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
    """Offset and turn between the axes of streams that turn together, to be added to b's times.

    Raises DegenerateMotionError, InvalidInputError: as `estimate_time_offset`, or it changes.
    """
    speeds = [np.linalg.norm(one.velocity_rad_s, axis=1) for one in (a, b)]
    rough = estimate_time_offset(a.t_ns, speeds[0], b.t_ns, speeds[1])
    first_ns = a.t_ns[:1]
    t_a, mine = checked_signal("times: stream a", a.t_ns, a.velocity_rad_s, first_ns)
    t_b, other = checked_signal("times: stream b", b.t_ns, b.velocity_rad_s, first_ns)
    step_s = 0.5 * min(usual_period_s(t_a), usual_period_s(t_b))
    grid, smooth_a = low_passed(t_a, mine, step_s)
    grid_b, smooth_b = low_passed(t_b, other, step_s)
    spline = CubicSpline(grid_b, smooth_b)
    slope, offset_s, turn = spline.derivative(), rough.offset_ns * 1e-9, None
    for _ in range(_MAX_ITERATIONS):
        inside = (grid - offset_s >= grid_b[0]) & (grid - offset_s <= grid_b[-1])
        at_s, seen = grid[inside] - offset_s, smooth_a[inside]
        if turn is None:
            turn, _ = Rotation.align_vectors(seen, spline(at_s))
        turned = turn.apply(spline(at_s))
        left = seen - turned
        # By the offset, and by a small turn w: w × turned.
        J = np.empty((*turned.shape, 4))
        J[..., 0] = -turn.apply(slope(at_s))
        J[..., 1:] = -hat(turned)
        normal = np.einsum("nij,nik->jk", J, J)
        change = np.linalg.lstsq(normal, np.einsum("nij,ni->j", J, left), rcond=None)[0]
        offset_s, turn = offset_s + float(change[0]), Rotation.from_rotvec(change[1:]) * turn
        if abs(change[0]) < 1e-7:
            break
    # As many numbers as `estimate_time_offset` counts as independent, and its factor.
    per_number = max(1.0, 1 / (2 * CUTOFF_HZ * step_s))
    _check_constant(J[..., 0], left, per_number)
    variance = float(np.square(left).mean()) * per_number * SIGMA_FACTOR**2
    sigma_s = float(np.sqrt(variance * np.linalg.pinv(normal)[0, 0]))
    if not sigma_s <= _MAX_SIGMA_S:
        raise DegenerateMotionError(
            f"times: the offset is known only to {sigma_s * 1e3:.1f} ms, expected at most "
            f"{_MAX_SIGMA_S * 1e3:g}; shake more briskly and irregularly, about all axes"
        )
    return TimeOffset(round(offset_s * 1e9), max(1, round(sigma_s * 1e9)))


def _check_constant(
    by_offset: Float64[np.ndarray, "n 3"], left: Float64[np.ndarray, "n 3"], per_number: float
) -> None:
    energies, offs_s, noise = np.empty((3, _NUM_PARTS))
    parts = (np.array_split(one, _NUM_PARTS) for one in (by_offset, left))
    for part, (moved, rest) in enumerate(zip(*parts, strict=True)):
        energies[part] = np.square(moved).sum()
        offs_s[part] = (moved * rest).sum() / energies[part]
        noise[part] = np.square(rest - offs_s[part] * moved).mean()
    # Where an offset has changed, a line no longer describes it, and its part has larger errors.
    sigmas_s = SIGMA_FACTOR * np.sqrt(np.median(noise) * per_number / energies)
    sigmas_s = np.maximum(sigmas_s, _LEAST_SIGMA_S)
    worst = int(np.argmax(np.abs(offs_s) / sigmas_s))
    if abs(offs_s[worst]) > MAX_SIGMAS * sigmas_s[worst]:
        raise DegenerateMotionError(
            f"times: in part {worst + 1} of {_NUM_PARTS} of the take the offset is another one, by "
            f"about {abs(offs_s[worst]) * 1e3:.1f} ms; a clock stopped or was set, or something "
            "slipped: record the take again"
        )


def shared_times(turnings: Mapping[str, Turning], reference: str) -> SharedTimes:
    """Delays of streams after the reference, from the offsets of all pairs.

    A delay's sigma is that of the best chain of pairs to the reference (more pairs of the same
    streams share their noise), and what loops miss zero by. Raises DegenerateMotionError: a stream
    that agrees with no other one, or loops that do not close; InvalidInputError: fewer than two
    streams, or the reference is none of them.
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
    isolated = [name for name in names if not np.isfinite(sigmas_ns[name])]
    if isolated:
        reasons = [text for pair, text in unusable.items() if isolated[0] in pair]
        raise DegenerateMotionError(
            f"times: {', '.join(isolated)} turned like no stream that leads to {reference!r} "
            f"({reasons[0]}); hold everything together rigidly and shake it briskly about all axes "
            "for ten seconds, or leave the stream out with --streams",
            streams=isolated,
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
    free = [name for name in names if name != reference]
    # b is later than a by as much as must be subtracted from its times.
    signs = [[float(name == pair.b) - (name == pair.a) for name in free] for pair in pairs]
    design = np.array(signs)
    offsets_ns = -np.array([pair.offset.offset_ns for pair in pairs], dtype=np.float64)
    scale = 1.0 / np.array([pair.offset.sigma_ns for pair in pairs])
    found, *_ = np.linalg.lstsq(design * scale[:, None], offsets_ns * scale, rcond=None)
    delays_ns = {reference: 0.0, **dict(zip(free, found.tolist(), strict=True))}
    if len(pairs) == len(free):
        return delays_ns, 0.0
    return delays_ns, float(np.sqrt(np.square(design @ found - offsets_ns).mean()))


def _chain_sigmas_ns(
    names: Sequence[str], pairs: Sequence[PairOffset], reference: str
) -> dict[str, float]:
    steps = np.zeros((len(names), len(names)))
    for pair in pairs:
        steps[names.index(pair.a), names.index(pair.b)] = float(pair.offset.sigma_ns) ** 2
    (variances,) = dijkstra(steps, directed=False, indices=[names.index(reference)])
    return dict(zip(names, np.sqrt(variances).tolist(), strict=True))


def _check_loops(names: Sequence[str], pairs: Sequence[PairOffset]) -> float:
    """The largest error of a loop of three offsets in standard deviations, unless too large."""
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
