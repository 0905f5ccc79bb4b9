"""Scene states, and rasters of their objects and hands in an image.

Objects are boxes, by casting rays; hands are ribbons of coloured points along their bones.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, AnchorPoses, poses_from_actions
from dextouch.hands.robot_hand import chain_points_of_both_m
from services.world_model.dynamics.tensor_trees import mapped

# Slots of the renderer's inputs, which its weights are trained with; one more than tasks may have.
MAX_DRAWN_OBJECTS = 4
# Minimum half size of a box; thinner boxes are drawn this thick.
MIN_HALF_M = 1e-3
# Points nearer along the optical axis are neither hit nor visible.
NEAR_M = 0.02
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
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
_Mixture = Float64[np.ndarray, "points 22"]


@dataclass(frozen=True)
class SceneStates:
    """Scenes at several steps; poses are x y z (m), q_wxyz in the world, finite where absent."""

    Ts_world_camera: Float64[np.ndarray, "n 4 4"]
    Ts_world_wrist: Float64[np.ndarray, "n 2 4 4"]
    joints_rad: Float64[np.ndarray, "n 2 20"]
    object_poses: Float64[np.ndarray, "n k 7"]
    object_present: Bool[np.ndarray, "n k"]

    @classmethod
    def of_actions(
        cls,
        actions: Float64[np.ndarray, "n 67"],
        anchor: AnchorPoses,
        poses: np.ndarray,
        present: Bool[np.ndarray, "n k"],
        *,
        validated: bool = False,
    ) -> "SceneStates":
        """States with camera and hands where actions say, which may be validated already."""
        hands = poses_from_actions(actions, anchor, validated=validated)
        return cls(
            hands.Ts_world_camera_head,
            np.stack([hands.Ts_world_wrist_left, hands.Ts_world_wrist_right], axis=1),
            np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1),
            poses.astype(np.float64),
            present,
        )

    def __len__(self) -> int:
        return len(self.Ts_world_camera)

    def padded(self, num_slots: int) -> "SceneStates":
        """The same states with absent objects in further slots, `num_slots` in all."""
        count = self.object_present.shape[1]
        poses = np.zeros((len(self), num_slots, 7))
        poses[..., 3] = 1.0
        poses[:, :count] = self.object_poses
        present = np.zeros((len(self), num_slots), dtype=np.bool_)
        present[:, :count] = self.object_present
        return replace(self, object_poses=poses, object_present=present)

    def take(self, rows: Int64[np.ndarray, " m"] | slice) -> "SceneStates":
        """Select states, in the order of `rows`."""
        return mapped(self, lambda values: values[rows])


@dataclass(frozen=True)
class BoxHits:
    """Pixels that see a box, each with its nearest one; `place` is flat over all images.

    `local` is the entry point in half sizes, `thickness_m` the depth from entry to exit.
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
    """Intersect rays of pixel centres with boxes (slab method of Kay and Kajiya, 1986)."""
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
    """Start image pixels of the hit points, of boxes in the start camera; far outside behind it."""
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
def _ribbons() -> tuple[_Mixture, _Mixture, Float64[np.ndarray, " points"]]:
    """Weights of a hand's points over 22 base points, and their direction and offset (m)."""
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
    return np.array(mixture), np.array(direction), np.array(lateral)


def base_points_world(states: SceneStates) -> Float64[np.ndarray, "n 2 22 3"]:
    """Wrist, four points per finger and a point on the forearm, for both hands."""
    points = np.zeros((len(states), 2, 22, 3))
    points[:, :, 1:_FOREARM_END] = chain_points_of_both_m(states.joints_rad).reshape(-1, 2, 20, 3)
    points[:, :, _FOREARM_END, 2] = _FOREARM_M
    return apply(states.Ts_world_wrist, points)


def project_hands(
    base_world: Float64[np.ndarray, "n 2 22 3"],
    K: Float64[np.ndarray, "n 3 3"],
    T_world_camera: Float64[np.ndarray, "n 4 4"],
    *,
    middle_only: bool = False,
) -> HandPoints:
    """Project all points of both hands into a camera, with `middle_only` all on their bones."""
    mixture, direction, lateral_m = _ribbons()
    base = apply(invert(T_world_camera)[:, None], base_world)
    # Vectors are [3, n, 2, points]: one block of numbers per axis is much faster to compute with.
    axes = np.ascontiguousarray(np.moveaxis(base, -1, 0))
    points = axes @ mixture.T
    if not middle_only:
        (ax, ay, az), (x, y, z) = axes @ direction.T, points
        sideways = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x])
        length = np.sqrt((sideways**2).sum(axis=0))
        points = points + sideways * (lateral_m / np.maximum(length, 1e-9))
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
        below = (at.clip(0), np.where(at >= 0, 1 - upper, 0.0))
        above = ((at + 1).clip(max=count - 1), np.where(at < count - 1, upper, 0.0))
        axes.append((below, above))
    first = image * (height * width)
    places, weights = [], []
    for row, down in axes[1]:
        begin = first + row * width
        for column, right in axes[0]:
            places.append(begin + column)
            weights.append(right * down)
    return np.concatenate(places), np.concatenate(weights), np.tile(source, 4)
