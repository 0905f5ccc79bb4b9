"""Drawing of both hands as coloured bones, by splatting points of the kinematic chains.

Each bone is a ribbon of points that faces the camera; a point keeps the colour of its position in
the start image. A soft depth test resolves occlusion.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from dextouch.geometry import apply, invert
from dextouch.hands.robot_hand import chain_points_of_both_m
from services.world_model.rendering.scene_states import SceneStates

MIN_DEPTH_M = 0.05
# Radii of drawn bones and forearms, and the length of the forearm drawn behind the wrist.
_BONE_RADIUS_M, _FOREARM_RADIUS_M, _FOREARM_M = 0.008, 0.024, 0.06
# Depth scale of the soft depth test.
_SOFT_DEPTH_M = 0.012
# A single centred splat covers 1 − exp(−this) of a pixel.
_OPACITY = 1.6
_PALM_ROWS, _PALM_COLUMNS = 7, 9
_WRIST, _FOREARM_END = 0, 21
_KNUCKLES = (5, 9, 13, 17)


@dataclass(frozen=True)
class _Ribbons:
    """Fixed weights of a hand's points over 22 base points, and their offsets across ribbons."""

    mixture: Float64[np.ndarray, "points 22"]
    direction: Float64[np.ndarray, "points 22"]
    lateral_m: Float64[np.ndarray, " points"]


@dataclass(frozen=True)
class HandPoints:
    """Points of both hands in an image: pixels, depths, and which are in front of the camera."""

    pixels: Float64[np.ndarray, "n 2 points 2"]
    depth_m: Float64[np.ndarray, "n 2 points"]
    in_front: Bool[np.ndarray, "n 2 points"]


@dataclass(frozen=True)
class HandRaster:
    """Both hands in images: coverage (0 … 1) of left and right, colour, inverse depth in 1/m."""

    coverage: Float32[np.ndarray, "n 2 h w"]
    colour: Float32[np.ndarray, "n 3 h w"]
    nearness: Float32[np.ndarray, "n 1 h w"]


@cache
def _ribbons() -> _Ribbons:
    bones = [(1 + 4 * f + j, 2 + 4 * f + j, _BONE_RADIUS_M, 5) for f in range(5) for j in range(3)]
    bones += [(_WRIST, 1, _BONE_RADIUS_M, 5), (_WRIST, _FOREARM_END, _FOREARM_RADIUS_M, 5)]
    mixture, direction, lateral = [], [], []
    for a, b, radius_m, count in bones:
        wide = 5 if radius_m == _FOREARM_RADIUS_M else 3
        for share in np.linspace(0.0, 1.0, count):
            for side in np.linspace(-0.8, 0.8, wide):
                row = np.zeros(22)
                row[a], row[b] = 1.0 - share, share
                along = np.zeros(22)
                along[a], along[b] = -1.0, 1.0
                mixture.append(row)
                direction.append(along)
                lateral.append(side * radius_m)
    for across in np.linspace(0.0, 3.0, _PALM_COLUMNS):
        left = min(int(across), 2)
        knuckle = np.zeros(22)
        knuckle[_KNUCKLES[left]], knuckle[_KNUCKLES[left + 1]] = left + 1 - across, across - left
        for share in np.linspace(0.15, 1.0, _PALM_ROWS):
            row = share * knuckle
            row[_WRIST] += 1.0 - share
            mixture.append(row)
            direction.append(np.zeros(22))
            lateral.append(0.0)
    return _Ribbons(np.array(mixture), np.array(direction), np.array(lateral))


def base_points_world(states: SceneStates) -> Float64[np.ndarray, "n 2 22 3"]:
    """Wrist, four points per finger and a point on the forearm, for both hands."""
    points = np.zeros((len(states), 2, 22, 3))
    points[:, :, 1:_FOREARM_END] = chain_points_of_both_m(states.joints_rad).reshape(-1, 2, 20, 3)
    points[:, :, _FOREARM_END, 2] = _FOREARM_M
    return apply(states.Ts_world_wrist, points)


def project_hands(
    base_world: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray, *, middle_only: bool = False
) -> HandPoints:
    """Project all points of both hands into a camera.

    Args:
        base_world: [n, 2, 22, 3] from `base_points_world`.
        K: [n, 3, 3] in pixels.
        T_world_camera: [n, 4, 4].
        middle_only: put every point on the centre line of its bone.
    """
    ribbons = _ribbons()
    base = apply(invert(T_world_camera)[:, None], base_world)
    # Vectors are [3, n, 2, points]: one block of numbers per axis is much faster to compute with.
    axes = np.ascontiguousarray(np.moveaxis(base, -1, 0))
    points = axes @ ribbons.mixture.T
    if not middle_only:
        (ax, ay, az), (x, y, z) = axes @ ribbons.direction.T, points
        sideways = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x])
        length = np.sqrt((sideways**2).sum(axis=0))
        points = points + sideways * (ribbons.lateral_m / np.maximum(length, 1e-9))
    depth = points[2]
    pixels = np.einsum("nij,jnsp->nspi", K[:, :2], points)
    pixels /= np.maximum(depth, MIN_DEPTH_M)[..., None]
    return HandPoints(pixels, depth, depth > MIN_DEPTH_M)


def colours_at(
    images: Float32[np.ndarray, "b 3 h w"], points: HandPoints
) -> Float32[np.ndarray, "b 2 points 3"]:
    """Colours of images in 0 … 1 at the pixel of each point; black for points outside."""
    _, _, height, width = images.shape
    u = np.floor(points.pixels[..., 0].clip(-1, width)).astype(np.int64)
    v = np.floor(points.pixels[..., 1].clip(-1, height)).astype(np.int64)
    seen = points.in_front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    rows = np.arange(len(images))[:, None, None]
    colours = images[rows, :, v.clip(0, height - 1), u.clip(0, width - 1)]
    return np.where(seen[..., None], colours, np.float32(0.0))


def splat_hands(points: HandPoints, colours: np.ndarray, shape_px: tuple[int, int]) -> HandRaster:
    """Splat points of both hands with their colours [n, 2, points, 3]; nearer points win."""
    height, width = shape_px
    num_images = len(points.pixels)
    place, weight, source = _taps(points, shape_px)
    # Hands cover few of the pixels: sums are of these alone, and the others stay zero.
    row = np.zeros(num_images * height * width, dtype=np.int64)
    row[place] = 1
    covered = np.flatnonzero(row)
    row[covered] = np.arange(len(covered))
    pixel = row[place]

    def total(values: np.ndarray) -> Float64[np.ndarray, " covered"]:
        return np.bincount(pixel, values, len(covered)).astype(np.float64)

    def plane(values: np.ndarray) -> Float32[np.ndarray, "n h w"]:
        filled = np.zeros(len(row), dtype=np.float32)
        filled[covered] = values
        return filled.reshape(num_images, height, width)

    depth = points.depth_m.reshape(-1)
    # Weights are about one at a metre: exp does not overflow for any depth above MIN_DEPTH_M.
    near = weight * np.exp(np.minimum((1.0 - depth) / _SOFT_DEPTH_M, 300.0))[source]
    normal = 1.0 / np.maximum(total(near), 1e-300)
    is_right = (source // points.depth_m.shape[2]) % 2
    sides = [total(weight * (1 - is_right)), total(weight * is_right)]
    cover = [plane(1.0 - np.exp(-_OPACITY * amount)) for amount in sides]
    values = [*np.moveaxis(colours, -1, 0), 1.0 / np.maximum(points.depth_m, MIN_DEPTH_M)]
    red, green, blue, nearness = [
        plane(total(near * value.reshape(-1)[source]) * normal) for value in values
    ]
    colour = np.stack([red, green, blue], axis=1)
    return HandRaster(np.stack(cover, axis=1), colour, nearness[:, None])


def _taps(
    points: HandPoints, shape_px: tuple[int, int]
) -> tuple[Int64[np.ndarray, " taps"], Float64[np.ndarray, " taps"], Int64[np.ndarray, " taps"]]:
    """Flat pixel, weight and point index of the four neighbours of each visible point."""
    height, width = shape_px
    flat = points.pixels.reshape(-1, 2) - 0.5
    shown = points.in_front.ravel() & (flat > -1).all(axis=1)
    shown &= (flat < [width, height]).all(axis=1)
    source = np.flatnonzero(shown)
    corner = np.floor(flat[source])
    share = flat[source] - corner
    image = source // (points.depth_m.shape[1] * points.depth_m.shape[2])
    # Columns and rows of the neighbours, and the weight of each: zero beyond the border.
    axes = []
    for axis, count in ((0, width), (1, height)):
        at = corner[:, axis].astype(np.int64)
        upper = share[:, axis]
        axes.append(
            [
                (at.clip(0), np.where(at >= 0, 1 - upper, 0.0)),
                ((at + 1).clip(max=count - 1), np.where(at < count - 1, upper, 0.0)),
            ]
        )
    first = image * (height * width)
    places, weights = [], []
    for row, down in axes[1]:
        begin = first + row * width
        for column, right in axes[0]:
            places.append(begin + column)
            weights.append(right * down)
    return np.concatenate(places), np.concatenate(weights), np.tile(source, 4)
