"""Rasters of boxes and hands in an image, and how its pixels move."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor
from torch.nn import functional

from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.hands.robot_hand import chain_points_of_both_m
from services.world_model.rendering.configuration import Interpolation
from services.world_model.rendering.scene_states import SceneStates

# Ray casting of objects as bounding boxes; the nearest box wins.
#
# Hits take their colour from the start image: the point moves with its object back to its pose at
# the start and is projected there.

# Minimum half size of a box; thinner boxes are drawn this thick.
MIN_HALF_M = 1e-3
# Points nearer along the optical axis are neither hit nor visible.
NEAR_M = 0.02
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


@dataclass(frozen=True)
class BoxHits:
    """Pixels that see a box, each with its nearest one.

    `place` is the flat pixel index over all images, row by row; `local` is the entry point in units
    of the half sizes, `thickness_m` the difference in depth between entry and exit.
    """

    place: Int64[np.ndarray, " hits"]
    image: Int64[np.ndarray, " hits"]
    slot: Int64[np.ndarray, " hits"]
    depth_m: Float64[np.ndarray, " hits"]
    thickness_m: Float64[np.ndarray, " hits"]
    local: Float64[np.ndarray, "hits 3"]


def object_transforms(poses: Float64[np.ndarray, "*n 7"]) -> Float64[np.ndarray, "*n 4 4"]:
    """T_world_object; a zero quaternion counts as the identity."""
    poses = np.array(poses, dtype=np.float64)
    lengths = np.linalg.norm(poses[..., 3:], axis=-1)
    poses[lengths < 1e-9, 3:] = [1.0, 0.0, 0.0, 0.0]
    poses[..., 3:] /= np.maximum(lengths, 1e-9)[..., None] ** (lengths >= 1e-9)[..., None]
    return transform_from_pose(poses)


def box_corners(
    Ts_camera_box: Float64[np.ndarray, "*n 4 4"], half_m: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 8 3"]:
    """Corners of boxes in camera coordinates."""
    corners = _CORNERS * half_m[..., None, :]
    R_box_camera = np.swapaxes(Ts_camera_box[..., :3, :3], -1, -2)
    return np.asarray(corners @ R_box_camera + Ts_camera_box[..., None, :3, 3])


def cast_boxes(
    Ts_camera_box: Float64[np.ndarray, "n k 4 4"],
    half_m: Float64[np.ndarray, "n k 3"],
    present: Bool[np.ndarray, "n k"],
    K: Float64[np.ndarray, "n 3 3"],
    shape_px: tuple[int, int],
) -> BoxHits:
    """Intersect the rays of pixel centres with boxes (slab method of Kay and Kajiya, 1986).

    Only pixels in the bounding rectangle of a box's corners are tested; a box with corners behind
    the camera is tested everywhere.
    """
    half_m = np.maximum(half_m, MIN_HALF_M)[present]
    Ts_box_camera = invert(Ts_camera_box[present])
    images, slots = np.nonzero(present)
    box, v, u = np.nonzero(_tried(Ts_camera_box[present], half_m, K[images], shape_px))
    image, slot = images[box], slots[box]
    # Vectors are columns [3, tried]: one row of numbers per axis is much faster to compute with.
    unprojected = Ts_box_camera[:, :3, :3] @ np.linalg.inv(K)[images]
    by_box = [unprojected.reshape(-1, 9), Ts_box_camera[:, :3, 3], half_m]
    columns = np.take(np.concatenate(by_box, axis=1).T.copy(), box, axis=1)
    across, down, forward = columns[0:9:3], columns[1:9:3], columns[2:9:3]
    directions = across * (u + 0.5) + down * (v + 0.5) + forward
    origins, half = columns[9:12], columns[12:]
    # Avoid division by zero for rays parallel to a face.
    inverse = 1.0 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    middle, reach = -origins * inverse, half * np.abs(inverse)
    enter, leave = (middle - reach).max(axis=0), (middle + reach).min(axis=0)
    height, width = shape_px
    place = (image * height + v) * width + u
    hit = (leave > enter) & (enter > NEAR_M)
    # Depth buffer, slot by slot, in which no pixel occurs twice.
    nearest_m = np.full(len(K) * height * width, np.inf)
    row = np.full(len(nearest_m), -1)
    for index in np.unique(slots):
        tested = np.flatnonzero(hit & (slot == index))
        tested = tested[enter[tested] < nearest_m[place[tested]]]
        nearest_m[place[tested]], row[place[tested]] = enter[tested], tested
    seen = row[row >= 0]
    entry = origins[:, seen] + directions[:, seen] * enter[seen]
    local = np.ascontiguousarray((entry / half[:, seen]).clip(-1.0, 1.0).T)
    return BoxHits(
        place[seen], image[seen], slot[seen], enter[seen], leave[seen] - enter[seen], local
    )


def _tried(
    Ts_camera_box: np.ndarray, half_m: np.ndarray, K: np.ndarray, shape_px: tuple[int, int]
) -> Bool[np.ndarray, "boxes h w"]:
    """Pixels in the bounding rectangle of each box."""
    corners = box_corners(Ts_camera_box, half_m)
    depth = corners[..., 2:]
    pixels = (corners @ np.swapaxes(K, -1, -2))[..., :2] / np.maximum(depth, NEAR_M)
    everywhere = depth.min(axis=(1, 2))[:, None] < NEAR_M
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    low, high = np.where(everywhere, -np.inf, low), np.where(everywhere, np.inf, high)
    inside = []
    for axis, count in ((0, shape_px[1]), (1, shape_px[0])):
        centres = np.arange(count) + 0.5
        inside.append((centres >= low[:, axis, None]) & (centres <= high[:, axis, None]))
    across, down = inside
    return np.asarray(down[..., None] & across[:, None, :])


def positions_at_start(
    hits: BoxHits,
    Ts_start_box: Float64[np.ndarray, "n k 4 4"],
    half_m: Float64[np.ndarray, "n k 3"],
    K: Float64[np.ndarray, "n 3 3"],
) -> Float64[np.ndarray, "hits 2"]:
    """Start image pixels of the hit points; far outside for points behind the start camera.

    Args:
        hits: from `cast_boxes`.
        Ts_start_box: pose of each box in the start camera, at the start.
        half_m: half sizes of the boxes.
        K: intrinsics of the start camera.
    """
    x, y, z = hits.local.T
    scaled = (K[:, None] @ Ts_start_box[..., :3, :]).transpose(2, 3, 0, 1)
    scaled[:, :3] *= np.maximum(half_m, MIN_HALF_M).transpose(2, 0, 1)
    projections = scaled[..., hits.image, hits.slot]
    homogeneous = projections[:, 0] * x + projections[:, 1] * y + projections[:, 2] * z
    homogeneous += projections[:, 3]
    depth = homogeneous[2]
    pixels = np.where(depth > NEAR_M, homogeneous[:2] / np.maximum(depth, NEAR_M), -1e3)
    return np.ascontiguousarray(pixels.T)


def colours_at_positions(
    layers: Float[np.ndarray, "b c h w"],
    owner: Int64[np.ndarray, " points"],
    positions: Float64[np.ndarray, "points 2"],
) -> Float64[np.ndarray, "points c"]:
    """Bilinear samples of images at positions in pixels; outside, the nearest border pixel."""
    _, _, height, width = layers.shape
    limits = np.array([width - 1, height - 1])
    at = (positions - 0.5).clip(0.0, limits)
    corner = np.minimum(at.astype(np.int64), np.maximum(limits - 1, 0))
    right, down = (at - corner).T
    beyond = np.minimum(corner + 1, limits)
    (u, v), (u_next, v_next) = corner.T, beyond.T
    upper = layers[owner, :, v, u] * (1 - right)[:, None]
    upper += layers[owner, :, v, u_next] * right[:, None]
    lower = layers[owner, :, v_next, u] * (1 - right)[:, None]
    lower += layers[owner, :, v_next, u_next] * right[:, None]
    return np.asarray(upper * (1 - down)[:, None] + lower * down[:, None])


# Drawing of both hands as coloured bones, by splatting points of the kinematic chains.
#
# Each bone is a ribbon of points that faces the camera; a point keeps the colour of its position in
# the start image. A soft depth test resolves occlusion.

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


# Image motion caused by a known motion of the head camera over the table.
#
# Pixels of the table plane (z = 0 in the world) move by a homography; rays that meet the plane
# beyond `FAR_M`, or never, move as if they came from infinity.

FAR_M = 20.0
# A camera nearer to the plane than this sees it edge-on.
MIN_HEIGHT_M = 1e-3
# Positions farther outside than this many image sides all sample the border.
_MAX_SIDES = 4.0
_MIN_DEPTH = 1e-9


def pixel_centres(height_px: int, width_px: int) -> Float64[np.ndarray, "pixels 2"]:
    """Positions of all pixel centres, row by row; the first is (0.5, 0.5)."""
    u, v = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


@dataclass(frozen=True)
class CameraMotion:
    """Maps from pixels of later images to pixels of start images.

    Attributes:
        table: homogeneous pixels of a later image to those of the start, on the table.
        infinity: the same for points at infinity.
        inverse_depth: row vectors whose product with a homogeneous pixel is 1 / (depth of the
            table there), in 1/m; zero for a camera that sees the table as a line.
    """

    table: Float64[np.ndarray, "n 3 3"]
    infinity: Float64[np.ndarray, "n 3 3"]
    inverse_depth: Float64[np.ndarray, "n 1 3"]

    @classmethod
    def between(
        cls, K: np.ndarray, T_world_start: np.ndarray, T_world_camera: np.ndarray
    ) -> "CameraMotion":
        """Motion between the start and later cameras [n, 4, 4], with equal K [n, 3, 3]."""
        R_start_camera = np.swapaxes(T_world_start[:, :3, :3], -1, -2) @ T_world_camera[:, :3, :3]
        infinity = K @ R_start_camera @ np.linalg.inv(K)
        is_above = (np.abs(T_world_camera[:, 2, 3]) > MIN_HEIGHT_M)[:, None, None]
        plane = np.where(is_above, _plane_projection(K, T_world_camera), np.eye(3))
        camera_to_table = np.linalg.inv(plane)
        table = _plane_projection(K, T_world_start) @ camera_to_table
        same = (T_world_start == T_world_camera).all(axis=(1, 2))[:, None, None]
        return cls(
            np.where(same, np.eye(3), table),
            np.where(same, np.eye(3), infinity),
            np.where(is_above, camera_to_table[:, 2:], 0.0),
        )

    def to_start(
        self, pixels: Float64[np.ndarray, "n points 2"]
    ) -> Float64[np.ndarray, "n points 2"]:
        """Start image positions of the table or the far background at these pixels."""
        homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
        return np.swapaxes(self._to_start(np.swapaxes(homogeneous, 1, 2)), 1, 2)

    def image_positions(self, shape_px: tuple[int, int]) -> Float32[np.ndarray, "n h w 2"]:
        """Start image position of each pixel of the later image, at most four sides away."""
        height, width = shape_px
        centres = pixel_centres(height, width)
        homogeneous = np.ones((3, height * width), dtype=np.float32)
        homogeneous[:2] = centres.T
        limit = _MAX_SIDES * max(shape_px)
        positions = self._to_start(homogeneous).clip(-limit, limit)
        return np.ascontiguousarray(np.swapaxes(positions, 1, 2)).reshape(-1, height, width, 2)

    def _to_start(self, homogeneous: np.ndarray) -> np.ndarray:
        """Positions [n, 2, points] of homogeneous pixels [3, points] or [n, 3, points]."""
        kind = homogeneous.dtype
        chosen = self.table.astype(kind) @ homogeneous
        is_near = self.inverse_depth.astype(kind) @ homogeneous > 1.0 / FAR_M
        is_near &= chosen[:, 2:] > _MIN_DEPTH
        if not is_near.all():
            chosen = np.where(is_near, chosen, self.infinity.astype(kind) @ homogeneous)
        # Points behind the start camera were not in its image: move them far to the left and top.
        seen = chosen[:, 2:] > _MIN_DEPTH
        positions = chosen[:, :2] / np.where(seen, chosen[:, 2:], 1.0)
        return positions if seen.all() else np.where(seen, positions, kind.type(-1e6))


def _plane_projection(K: np.ndarray, T_world_camera: np.ndarray) -> Float64[np.ndarray, "*b 3 3"]:
    """Matrices that project points (x, y, 1) of the table to pixels times depth."""
    return np.asarray(K @ invert(T_world_camera)[..., :3, [0, 1, 3]])


def sample_images(
    images: Float32[Tensor, "n c h w"],
    positions: Float32[Tensor, "n rows cols 2"],
    *,
    interpolation: Interpolation,
) -> Float32[Tensor, "n c rows cols"]:
    """Sample images at positions in pixels; outside, the nearest border pixel."""
    sides = torch.tensor([images.shape[3], images.shape[2]], dtype=torch.float32)
    return functional.grid_sample(
        images,
        positions * (2.0 / sides) - 1.0,
        mode=interpolation,
        padding_mode="border",
        align_corners=False,
    )


def is_inside(
    positions: Float[np.ndarray, "*b 2"], shape_px: tuple[int, int]
) -> Bool[np.ndarray, "*b"]:
    """Whether positions in pixels lie inside an image."""
    height, width = shape_px
    u, v = positions[..., 0], positions[..., 1]
    return np.asarray((u >= 0) & (u <= width) & (v >= 0) & (v <= height))


# Image motion of hands and objects relative to the start image warped by the camera motion.

# A body shifted less than the first against the warped image is still, one shifted more than the
# second has moved; in between its motion share is interpolated.
STILL_PX, MOVED_PX = 0.05, 0.3


@dataclass(frozen=True)
class Bodies:
    """Hands and object boxes in one camera per state.

    `pixels` and `in_front` cover 22 points of each hand, then the eight corners of each box.
    """

    Ts_camera_box: Float64[np.ndarray, "n k 4 4"]
    hands_world: Float64[np.ndarray, "n 2 22 3"]
    pixels: Float64[np.ndarray, "n points 2"]
    in_front: Bool[np.ndarray, "n points"]

    @classmethod
    def seen(cls, states: SceneStates, boxes_m: np.ndarray, K: np.ndarray) -> "Bodies":
        """Bodies of states with object boxes [n, k, 6], seen by cameras [n, 3, 3]."""
        T_camera_world = invert(states.Ts_world_camera)
        Ts_object_box = np.tile(np.eye(4), (*boxes_m.shape[:2], 1, 1))
        Ts_object_box[..., :3, 3] = boxes_m[..., :3]
        Ts_world_box = object_transforms(states.object_poses) @ Ts_object_box
        Ts_camera_box = T_camera_world[:, None] @ Ts_world_box
        hands_world = base_points_world(states)
        corners = box_corners(Ts_camera_box, boxes_m[..., 3:])
        points = np.concatenate(
            [
                apply(T_camera_world, hands_world.reshape(len(states), -1, 3)),
                corners.reshape(len(states), -1, 3),
            ],
            axis=1,
        )
        depth = points[..., 2:]
        pixels = (points @ np.swapaxes(K, -1, -2))[..., :2] / np.maximum(depth, MIN_DEPTH_M)
        return cls(Ts_camera_box, hands_world, pixels, depth[..., 0] > MIN_DEPTH_M)


def motion_shares(
    before: Bodies,
    now: Bodies,
    owner: Int64[np.ndarray, " n"],
    motion: CameraMotion,
) -> Float64[np.ndarray, "n bodies"]:
    """Motion share, from 0 (still) to 1 (moved), of left hand, right hand and each object.

    A body moves when any of its points leaves its position in the warped start image.
    """
    there = before.pixels[owner]
    shift = np.linalg.norm(motion.to_start(now.pixels) - there, axis=-1)
    both = before.in_front[owner] & now.in_front
    shift = np.where(both, shift, 0.0)
    # Points that crossed the camera plane have moved.
    shift[before.in_front[owner] != now.in_front] = np.inf
    hands, boxes = shift[:, :44].reshape(-1, 2, 22), shift[:, 44:].reshape(len(owner), -1, 8)
    largest = np.concatenate([hands.max(axis=-1), boxes.max(axis=-1)], axis=1)
    return np.asarray(((largest - STILL_PX) / (MOVED_PX - STILL_PX)).clip(0.0, 1.0))
