"""Rigid transforms as 4×4 matrices, interpolation in time, and cameras with lens distortion.

Points of a camera are in its optical frame (x right, y down, z forward). `K` and `distortion`
(k1 k2 p1 p2 k3) are those of OpenCV's model; the first pixel spans 0 … 1.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)

# The lens model of all images: another one, or more coefficients, is defined here, in `_distorted`,
# and fitted in `services.alignment.calibration.lens_fit`. Its name is that of ROS and Foxglove.
DISTORTION_MODEL: Final = "plumb_bob"
NUM_DISTORTION: Final = 5
Distortion = Float64[np.ndarray, f"{NUM_DISTORTION}"]
# Newton's method doubles the digits each time; far from the middle of a strong lens it needs more.
_MAX_ITERATIONS: Final = 50
_TOLERANCE: Final = 1e-11
# What is farther off after all of them is an image of no point; far below a hundredth of a pixel.
_WRONG: Final = 1e-6
# Points nearer to the camera are not in front of it.
_LEAST_DEPTH_M: Final = 0.01


def transform(R_a_b: np.ndarray, t_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T_a_b from a rotation [..., 3, 3] and a translation [..., 3] in metres."""
    R = np.asarray(R_a_b, dtype=np.float64)
    t = np.asarray(t_a_b, dtype=np.float64)
    if R.shape[-2:] != (3, 3) or t.shape[-1:] != (3,):
        raise ShapeError(
            f"transform: got R {R.shape} and t {t.shape}, expected [..., 3, 3] and [..., 3]"
        )
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def invert(T_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T_b_a, by transposing the rotation (exact for rigid transforms)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    R_b_a = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_b_a, -(R_b_a @ T[..., :3, 3:])[..., 0])


def rigid_error(T: np.ndarray) -> float:
    """How far transforms [..., 4, 4] are from rigid ones: 0 for rotations with the row 0 0 0 1.

    The largest difference of RᵀR from the identity and of the last row; infinite for reflections
    and where a value is not finite, 0 for no transforms.
    """
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    if not np.isfinite(T).all() or (np.linalg.det(R) < 0).any():
        return math.inf
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(initial=0.0)
    return float(np.abs(T[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=off))


def apply(T_a_b: np.ndarray, points_b: np.ndarray) -> Float64[np.ndarray, "*batch 3"]:
    """Points [..., n, 3] of frame b in frame a, for T_a_b [..., 4, 4]."""
    T = np.asarray(T_a_b, dtype=np.float64)
    points = np.asarray(points_b, dtype=np.float64)
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def transform_from_pose(pose: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T from tracker poses [..., 7]: x y z (m), then quaternion w x y z."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape[-1:] != (7,):
        raise ShapeError(f"pose: got shape {pose.shape}, expected [..., 7] (x y z w qx qy qz)")
    return transform(rotation_from_quaternion(pose[..., 3:]), pose[..., :3])


def pose_from_transform(T: np.ndarray) -> Float64[np.ndarray, "*batch 7"]:
    """Tracker poses [..., 7] (x y z in metres, quaternion w x y z) from transforms."""
    T = np.asarray(T, dtype=np.float64)
    return np.concatenate([T[..., :3, 3], quaternion_from_rotation(T[..., :3, :3])], axis=-1)


def pinhole_matrix(*, width_px: int, height_px: int, fovy_rad: float) -> Float64[np.ndarray, "3 3"]:
    """K of an ideal camera with square pixels; the first one spans 0 … 1, so cx = width / 2."""
    focal_px = 0.5 * height_px / np.tan(0.5 * fovy_rad)
    return np.array(
        [[focal_px, 0.0, 0.5 * width_px], [0.0, focal_px, 0.5 * height_px], [0.0, 0.0, 1.0]]
    )


def distortion_of(calibration: Mapping[str, object], camera: str) -> Distortion:
    """Coefficients of a camera's lens in a calibration; zeros for those that it lacks."""
    known = np.array(calibration.get(f"distortion_{camera}", ()), dtype=np.float64).ravel()
    return np.pad(known, (0, NUM_DISTORTION - len(known)))


def project(
    K: np.ndarray, points_camera: np.ndarray, distortion: np.ndarray | None = None
) -> tuple[Float64[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
    """Pixels [..., 2] of points [..., 3] in metres, and whether each lies in front of the camera.

    Points nearer than 1 cm are projected as if at that depth and marked False. `K` is in pixels,
    `distortion` k1 k2 p1 p2 k3, None for a pinhole, as for undistorted images.
    """
    points = np.asarray(points_camera, dtype=np.float64)
    flat = points[..., :2] / np.maximum(points[..., 2:], _LEAST_DEPTH_M)
    seen = flat if distortion is None else _distorted(flat, distortion)[0]
    return seen * K[[0, 1], [0, 1]] + K[:2, 2], points[..., 2] >= _LEAST_DEPTH_M


def bracket(
    t_ns: np.ndarray, at_ns: np.ndarray, *, max_gap_ns: int
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Bracket each query time by two sample times (int64 ns, at least two, strictly increasing).

    There is no interpolation between neighbours further apart than `max_gap_ns`.

    Returns:
        Left index [n] (0 … m-2), weight of the right neighbour [n] in [0, 1], and whether the query
        lies within the samples and not in a gap.

    Raises:
        InvalidInputError: fewer than two samples, or times that do not increase.
    """
    t = np.asarray(t_ns, dtype=np.int64)
    at = np.asarray(at_ns, dtype=np.int64)
    if t.size < 2 or (np.diff(t) <= 0).any():
        raise InvalidInputError(
            f"interpolation: got {t.size} sample times, expected at least 2, strictly increasing"
        )
    left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 2)
    span = t[left + 1] - t[left]
    weight = (at - t[left]) / span
    valid = (at >= t[0]) & (at <= t[-1]) & ((span <= max_gap_ns) | (at == t[left]))
    return left, np.clip(weight, 0.0, 1.0), valid


def interpolate_linear(
    values: np.ndarray, left: np.ndarray, weight: np.ndarray
) -> Float64[np.ndarray, "..."]:
    """Interpolate values [m, ...] linearly at brackets from `bracket`."""
    values = np.asarray(values, dtype=np.float64)
    w = weight.reshape(-1, *([1] * (values.ndim - 1)))
    return (1 - w) * values[left] + w * values[left + 1]


def interpolate_poses(
    Ts: np.ndarray, left: np.ndarray, weight: np.ndarray
) -> Float64[np.ndarray, "n 4 4"]:
    """Linear translation and geodesic rotation (SLERP) of Ts [m, 4, 4] at brackets."""
    Ts = np.asarray(Ts, dtype=np.float64)
    R0, R1 = Ts[left, :3, :3], Ts[left + 1, :3, :3]
    step = vector_from_rotation(np.swapaxes(R0, -1, -2) @ R1)
    R = R0 @ rotation_from_vector(step * weight[:, None])
    w = weight[:, None]
    return transform(R, (1 - w) * Ts[left, :3, 3] + w * Ts[left + 1, :3, 3])


def nearest_index(t_ns: np.ndarray, at_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
    """Index of the sample nearest in time to each query; ties take the earlier sample."""
    t = np.asarray(t_ns, dtype=np.int64)
    at = np.asarray(at_ns, dtype=np.int64)
    right = np.clip(np.searchsorted(t, at), 0, t.size - 1)
    left = np.clip(right - 1, 0, t.size - 1)
    return np.where(at - t[left] <= t[right] - at, left, right).astype(np.int64)


def undistorted(
    images: UInt8[np.ndarray, "n h w 3"], K: np.ndarray, distortion: np.ndarray
) -> UInt8[np.ndarray, "n h w 3"]:
    """Images as a pinhole camera of the same matrix K (px) would have taken them.

    `distortion` is k1 k2 p1 p2 k3; images of a lens without it are returned as they are. Pixels are
    interpolated bilinearly. What the camera did not see has the colour of the nearest border.
    """
    lens = tuple(np.asarray(distortion, dtype=np.float64).ravel().tolist())
    if not images.size or not any(lens):
        return images
    # Needed for the images of such lenses alone, so that other episodes are read without OpenCV.
    import cv2

    matrix = tuple(np.asarray(K, dtype=np.float64).ravel().tolist())
    x, y = _sources(images.shape[1], images.shape[2], matrix, lens)
    return np.stack(
        [
            cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for image in images
        ]
    )


# The maps of the cameras in use; one of 640 x 480 px takes 2.5 MB.
@lru_cache(maxsize=8)
def _sources(
    height_px: int, width_px: int, matrix: tuple[float, ...], lens: tuple[float, ...]
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Where an image shows each undistorted pixel, counted as in OpenCV: the first centre is 0."""
    K = np.array(matrix).reshape(3, 3)
    rows, columns = np.mgrid[0:height_px, 0:width_px] + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    seen, _ = project(K, rays, np.array(lens))
    maps = (seen - 0.5).astype(np.float32).reshape(height_px, width_px, 2)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def points_on_level(
    pixels: np.ndarray,
    camera: tuple[np.ndarray, np.ndarray],
    T_world_camera: np.ndarray,
    z_m: float,
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Points [n, 3] of the plane at height z (m) in the world that a camera shows at pixels [n, 2].

    The camera is K [3, 3] in pixels, and the distortion [5]; its pose that of the optical frame (x
    right, y down, z forward).

    Returns:
        The points, and whether the ray of each pixel meets the plane in front of the camera; rays
        that do not, or that the lens maps nowhere, have NaN.
    """
    K, distortion = camera
    seen = (np.asarray(pixels, dtype=np.float64) - K[:2, 2]) / K[[0, 1], [0, 1]]
    flat, is_mapped = _undistorted(seen, distortion)
    rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1) @ T_world_camera[:3, :3].T
    centre = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = (z_m - centre[2]) / rays[..., 2]
        points = centre + depth_m[..., None] * rays
    hits = is_mapped & (depth_m >= _LEAST_DEPTH_M) & np.isfinite(depth_m)
    return np.where(hits[..., None], points, np.nan), hits


def box_pixels(
    box_m: np.ndarray,
    T_world_object: np.ndarray,
    camera: tuple[np.ndarray, np.ndarray],
    T_world_camera: np.ndarray,
) -> Float64[np.ndarray, "8 2"]:
    """Pixels of the corners of a box (centre, half sizes in its frame); NaN behind the camera.

    Corner number i has the upper x, y, z where bit 0, 1, 2 of i is set.
    """
    box = np.asarray(box_m, dtype=np.float64)
    signs = np.array([[1 if index >> axis & 1 else -1 for axis in range(3)] for index in range(8)])
    corners_m = apply(invert(T_world_camera) @ T_world_object, box[:3] + signs * box[3:])
    K, distortion = camera
    pixels, in_front = project(K, corners_m, distortion)
    return np.where(in_front[:, None], pixels, np.nan)


def _distorted(
    flat: Float64[np.ndarray, "*batch 2"], distortion: np.ndarray
) -> tuple[Float64[np.ndarray, "*batch 2"], Float64[np.ndarray, "*batch 2 2"]]:
    """Where a lens shows points at depth 1, and the derivatives of that."""
    k1, k2, p1, p2, k3 = np.asarray(distortion, dtype=np.float64).ravel()
    x, y = flat[..., 0], flat[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    seen = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        axis=-1,
    )
    mixed = x * y * slope + 2 * p1 * x + 2 * p2 * y
    rows = [
        np.stack([radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed], axis=-1),
        np.stack([mixed, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x], axis=-1),
    ]
    return seen, np.stack(rows, axis=-2)


def _undistorted(
    seen: Float64[np.ndarray, "n 2"], distortion: np.ndarray
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Inverse of `_distorted` by Newton's method, and where there is one."""
    flat = seen
    with np.errstate(all="ignore"):
        for _ in range(_MAX_ITERATIONS):
            projected, slopes = _distorted(flat, distortion)
            off = projected - seen
            if np.abs(off).max(initial=0.0) < _TOLERANCE:
                break
            (a, b), (_, d) = np.moveaxis(slopes, (-2, -1), (0, 1))
            step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - b * off[..., 0]])
            flat = flat - np.moveaxis(step / (a * d - b * b), 0, -1)
        projected, slopes = _distorted(flat, distortion)
        # Beyond the angle at which the lens turns back, other points have the same image.
        is_first = (slopes[..., 0, 0] > 0) & (np.linalg.det(slopes) > 0)
        return flat, is_first & (np.abs(projected - seen).max(axis=-1) < _WRONG)
