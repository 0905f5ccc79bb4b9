"""Ray casting of objects as bounding boxes; the nearest box wins.

Hits take their colour from the start image: the point moves with its object back to its pose at
the start and is projected there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from dextouch.geometry import invert, transform_from_pose

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
