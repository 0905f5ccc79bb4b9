"""Network inputs of the renderer: warped start image, drawn hands and drawn objects.

Pixels of the table plane (z = 0 in the world) move by a homography; rays that meet the plane beyond
`FAR_M`, or never, move as if they came from infinity.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from dextouch.geometry import apply, invert
from services.world_model.network.configuration import Interpolation, RendererConfig
from services.world_model.rendering import rasters

FAR_M = 20.0
# A camera nearer to the plane than this sees it edge-on.
MIN_HEIGHT_M = 1e-3
# Positions farther outside than this many image sides all sample the border.
_MAX_SIDES = 4.0
_MIN_DEPTH = 1e-9
# A body shifted less than the first against the warped image is still, one shifted more than the
# second has moved; in between its motion share is interpolated.
STILL_PX, MOVED_PX = 0.05, 0.3
FINE_CHANNELS: Final = 15
COARSE_CHANNELS: Final = 13
# Margin around a moved body in which the network may draw.
_REACH_PX = 4
_COVERED = 0.05
# The network may redraw the whole image once a corner of it moved this far.
_CAMERA_MOVED_PX = 0.25
# Scale lengths of held objects, and nearness at arm's length, to about one.
_PER_M, _NEARNESS_M = 10.0, 0.5


@dataclass(frozen=True)
class CameraMotion:
    """Maps from homogeneous pixels of later images to those of start images, near and far.

    The product of the row vectors `inverse_depth` with a homogeneous pixel is 1 / (depth of the
    table there), in 1/m; they are zero for a camera that sees the table as a line.
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


@dataclass(frozen=True)
class Bodies:
    """Hands and object boxes in one camera per state: 22 points of each hand, then box corners."""

    Ts_camera_box: Float64[np.ndarray, "n k 4 4"]
    hands_world: Float64[np.ndarray, "n 2 22 3"]
    pixels: Float64[np.ndarray, "n points 2"]
    in_front: Bool[np.ndarray, "n points"]

    @classmethod
    def seen(cls, states: rasters.SceneStates, boxes_m: np.ndarray, K: np.ndarray) -> "Bodies":
        """Bodies of states with object boxes [n, k, 6], seen by cameras [n, 3, 3]."""
        T_camera_world = invert(states.Ts_world_camera)
        Ts_object_box = np.tile(np.eye(4), (*boxes_m.shape[:2], 1, 1))
        Ts_object_box[..., :3, 3] = boxes_m[..., :3]
        Ts_world_box = rasters.object_transforms(states.object_poses) @ Ts_object_box
        Ts_camera_box = T_camera_world[:, None] @ Ts_world_box
        hands_world = rasters.base_points_world(states)
        corners = rasters.box_corners(Ts_camera_box, boxes_m[..., 3:])
        hands = apply(T_camera_world, hands_world.reshape(len(states), -1, 3))
        points = np.concatenate([hands, corners.reshape(len(states), -1, 3)], axis=1)
        depth = points[..., 2:]
        pixels = (points @ np.swapaxes(K, -1, -2))[..., :2] / np.maximum(depth, rasters.MIN_DEPTH_M)
        return cls(Ts_camera_box, hands_world, pixels, depth[..., 0] > rasters.MIN_DEPTH_M)


@dataclass(frozen=True)
class Scenes:
    """Start images with camera, states and boxes (centre, half sizes) in the objects' frames."""

    images: UInt8[np.ndarray, "b h w 3"]
    K_head: Float64[np.ndarray, "b 3 3"]
    states: rasters.SceneStates
    boxes_m: Float64[np.ndarray, "b k 6"]


@dataclass(frozen=True)
class DrawingInputs:
    """Channels at full and half size, and the mask in which the network may draw.

    The fine ones begin with the colours of the warped start image, of the objects and of the hands.
    """

    fine: Float32[Tensor, "n 15 h w"]
    coarse: Float32[Tensor, "n 13 rows cols"]
    change: Float32[Tensor, "n 1 h w"]


@dataclass(frozen=True)
class _Start:
    """Start images, their coverage by hands and objects, and 1 + the slot that a pixel shows."""

    layers: Float32[np.ndarray, "b 5 h w"]
    hands: Float32[np.ndarray, "b 2 h w"]
    shown: Int64[np.ndarray, "b h w"]
    hand_colours: Float32[np.ndarray, "b 2 points 3"]

    @property
    def rgb(self) -> Float32[np.ndarray, "b 3 h w"]:
        """The start images."""
        return self.layers[:, :3]


@dataclass(frozen=True)
class PreparedScenes:
    """Scenes with everything that does not depend on the states to draw, computed once."""

    scenes: Scenes
    before: Bodies
    start: _Start

    @classmethod
    def of(cls, scenes: Scenes) -> "PreparedScenes":
        """Bodies and planes of the start images."""
        before = Bodies.seen(scenes.states, scenes.boxes_m, scenes.K_head)
        return cls(scenes, before, _start(scenes, before))


@dataclass(frozen=True)
class _ObjectPixels:
    """Object pixels, the start of each image, and the matching start image positions."""

    hits: rasters.BoxHits
    owner: Int64[np.ndarray, " n"]
    at_start: Float64[np.ndarray, "hits 2"]


def drawing_inputs(
    prepared: PreparedScenes,
    states: rasters.SceneStates,
    owner: Int64[np.ndarray, " n"],
    config: RendererConfig,
) -> DrawingInputs:
    """Inputs for drawing each state from the scene with the index in `owner`."""
    scenes, before, start = prepared.scenes, prepared.before, prepared.start
    shape_px = scenes.images.shape[1], scenes.images.shape[2]
    K, boxes_m = scenes.K_head[owner], scenes.boxes_m[owner]
    now = Bodies.seen(states, boxes_m, K)
    motion = CameraMotion.between(K, scenes.states.Ts_world_camera[owner], states.Ts_world_camera)
    present = scenes.states.object_present[owner] & states.object_present
    points = rasters.project_hands(now.hands_world, K, states.Ts_world_camera)
    hands = rasters.splat_hands(points, start.hand_colours[owner], shape_px)
    hits = rasters.cast_boxes(now.Ts_camera_box, boxes_m[..., 3:], present, K, shape_px)

    positions = motion.image_positions(shape_px)
    warped, marks, outside = _warped(start, owner, positions, config)
    at_start = rasters.positions_at_start(hits, before.Ts_camera_box[owner], boxes_m[..., 3:], K)
    seen = _ObjectPixels(hits, owner, at_start)
    objects = _objects(seen, start)
    fine = [warped, objects[:, :3], hands.colour, hands.coverage, objects[:, 3:], marks, outside]
    change = np.tile(_camera_change(positions), (1, 1, *shape_px)).astype(np.float32)
    # A camera that moved far enough changes the whole image, whatever its bodies do.
    rows = np.flatnonzero((change[:, 0, 0, 0] < 1.0) | (not config.redraws_table))
    if len(rows):
        moved = motion_shares(before, now, owner, motion)
        moved[:, 2:] *= present
        shown = _plane(hits, moved[hits.image, 2 + hits.slot][:, None], (len(owner), *shape_px))
        covered = (hands.coverage[rows] > _COVERED) * moved[rows, :2, None, None]
        body = np.maximum(covered.max(axis=1, keepdims=True), shown[rows])
        at_first = _moved_at_start(start, owner[rows], positions[rows], moved[rows])
        body = np.maximum(body, np.maximum(at_first, outside[rows]))
        # Around moved bodies at the start and now, and pixels outside the view.
        body = grown(body.astype(np.float32), _REACH_PX)
        change[rows] = np.maximum(body, change[rows]) if config.redraws_table else body
    return DrawingInputs(
        torch.from_numpy(np.concatenate(fine, axis=1)),
        torch.from_numpy(_coarse(seen, start, states, boxes_m, hands.nearness)),
        torch.from_numpy(change),
    )


def _start(scenes: Scenes, before: Bodies) -> _Start:
    shape = len(scenes.images), *scenes.images.shape[1:3]
    rgb = np.ascontiguousarray(np.moveaxis(scenes.images, -1, 1), dtype=np.float32) / 255.0
    K, cameras = scenes.K_head, scenes.states.Ts_world_camera
    points = rasters.project_hands(before.hands_world, K, cameras)
    colours = rasters.colours_at(
        rgb, rasters.project_hands(before.hands_world, K, cameras, middle_only=True)
    )
    hands = rasters.splat_hands(points, colours, shape[1:]).coverage
    present = scenes.states.object_present
    hits = rasters.cast_boxes(before.Ts_camera_box, scenes.boxes_m[..., 3:], present, K, shape[1:])
    shown = np.zeros(shape, dtype=np.int64)
    shown.reshape(-1)[hits.place] = hits.slot + 1
    covered = [rgb, hands.max(axis=1, keepdims=True), (shown[:, None] > 0).astype(np.float32)]
    return _Start(np.concatenate(covered, axis=1), hands, shown, colours)


def _plane(hits: rasters.BoxHits, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Scatter values of hits [hits, c] into images [n, c, h, w]; zero elsewhere."""
    num_images, height, width = shape
    flat = np.zeros((num_images * height * width, values.shape[1]), dtype=np.float32)
    flat[hits.place] = values
    return np.moveaxis(flat.reshape(num_images, height, width, -1), -1, 1)


def _warped(
    start: _Start, owner: np.ndarray, positions: np.ndarray, config: RendererConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start image, hands and objects under the camera motion, and pixels outside the view."""
    # Outside the start image its border is repeated.
    sampled = sample_images(
        torch.from_numpy(start.layers)[torch.from_numpy(owner)],
        torch.from_numpy(positions),
        interpolation=config.interpolation,
    )
    planes: np.ndarray = sampled.clamp_(0.0, 1.0).numpy()
    outside = ~is_inside(positions, start.layers.shape[2:])
    return planes[:, :3], planes[:, 3:], outside[:, None].astype(np.float32)


def _objects(seen: _ObjectPixels, start: _Start) -> Float32[np.ndarray, "n 4 h w"]:
    """Objects in the start image's colours, and their mask."""
    texture = rasters.colours_at_positions(start.rgb, seen.owner[seen.hits.image], seen.at_start)
    values = np.concatenate([texture, np.ones((len(texture), 1))], axis=1)
    return _plane(seen.hits, values, (len(seen.owner), *start.rgb.shape[2:]))


def _coarse(
    seen: _ObjectPixels,
    start: _Start,
    states: rasters.SceneStates,
    boxes_m: np.ndarray,
    hands_nearness: np.ndarray,
) -> Float32[np.ndarray, "n 13 rows cols"]:
    """Half-size channels: nearness of hands, and features of the object at each pixel."""
    _, _, height, width = start.rgb.shape
    hits, owner = seen.hits, seen.owner
    v, u = np.divmod(hits.place % (height * width), width)
    kept = np.flatnonzero((u % 2 == 0) & (v % 2 == 0))
    image, slot = hits.image[kept], hits.slot[kept]
    hidden = start.layers[:, 3:4]
    upwards = rasters.object_transforms(states.object_poses[image, slot])[..., 2, :3]
    values = [
        rasters.colours_at_positions(hidden, owner[image], seen.at_start[kept]),
        hits.thickness_m[kept, None] * _PER_M,
        _NEARNESS_M / hits.depth_m[kept, None],
        hits.local[kept],
        boxes_m[image, slot, 3:] * _PER_M,
        upwards,
    ]
    planes = np.zeros((len(owner), COARSE_CHANNELS, height // 2, width // 2), dtype=np.float32)
    planes[:, :1] = hands_nearness[..., ::2, ::2] * _NEARNESS_M
    planes[image, 1:, v[kept] // 2, u[kept] // 2] = np.concatenate(values, axis=1)
    return planes


def _moved_at_start(
    start: _Start, owner: np.ndarray, positions: np.ndarray, moved: np.ndarray
) -> Float32[np.ndarray, "n 1 h w"]:
    """Motion share of the body shown at each pixel of the start, warped by the camera motion."""
    table = np.concatenate([np.zeros((len(owner), 1)), moved[:, 2:]], axis=1)
    boxes = table[np.arange(len(owner))[:, None, None], start.shown[owner]]
    hands = (start.hands[owner] > _COVERED) * moved[:, :2, None, None]
    shares = np.maximum(hands.max(axis=1), boxes).astype(np.float32)[:, None]
    moved_from = torch.from_numpy(positions)
    sampled = sample_images(torch.from_numpy(shares), moved_from, interpolation="bilinear")
    return np.asarray(sampled.numpy())


def grown(
    mask: Float32[np.ndarray, "*batch h w"], reach_px: int
) -> Float32[np.ndarray, "*batch h w"]:
    """Largest value of a mask (0 or more) within some pixels along both axes.

    A window doubles with each comparison: ten times faster than torch's `max_pool2d`.
    """
    for axis in (-2, -1):
        mask = np.swapaxes(mask, axis, -2)
        mask = np.pad(mask, [(0, 0)] * (mask.ndim - 2) + [(reach_px, reach_px), (0, 0)])
        window = 1
        while window < 2 * reach_px + 1:
            step = min(window, 2 * reach_px + 1 - window)
            mask = np.maximum(mask[..., :-step, :], mask[..., step:, :])
            window += step
        mask = np.swapaxes(mask, axis, -2)
    return np.ascontiguousarray(mask)


def _camera_change(positions: Float32[np.ndarray, "n h w 2"]) -> Float64[np.ndarray, "n 1 1 1"]:
    """Change from 0 to 1 by the motion of the image's corners."""
    height, width = positions.shape[1:3]
    home = pixel_centres(height, width).reshape(height, width, 2)
    corners = (positions - home)[:, :: height - 1, :: width - 1]
    farthest = np.abs(corners).max(axis=(1, 2, 3))
    return np.asarray((farthest / _CAMERA_MOVED_PX).clip(0, 1)[:, None, None, None])


def _plane_projection(K: np.ndarray, T_world_camera: np.ndarray) -> Float64[np.ndarray, "*b 3 3"]:
    """Matrices that project points (x, y, 1) of the table to pixels times depth."""
    return np.asarray(K @ invert(T_world_camera)[..., :3, [0, 1, 3]])


def pixel_centres(height_px: int, width_px: int) -> Float64[np.ndarray, "pixels 2"]:
    """Positions of all pixel centres, row by row; the first is (0.5, 0.5)."""
    u, v = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


def sample_images(
    images: Float32[Tensor, "n c h w"],
    positions: Float32[Tensor, "n rows cols 2"],
    *,
    interpolation: Interpolation,
) -> Float32[Tensor, "n c rows cols"]:
    """Sample images at positions in pixels; outside, the nearest border pixel."""
    sides = torch.tensor([images.shape[3], images.shape[2]], dtype=torch.float32)
    at = positions * (2.0 / sides) - 1.0
    return functional.grid_sample(
        images, at, mode=interpolation, padding_mode="border", align_corners=False
    )


def is_inside(
    positions: Float[np.ndarray, "*b 2"], shape_px: tuple[int, int]
) -> Bool[np.ndarray, "*b"]:
    """Whether positions in pixels lie inside an image."""
    height, width = shape_px
    u, v = positions[..., 0], positions[..., 1]
    return np.asarray((u >= 0) & (u <= width) & (v >= 0) & (v <= height))


def motion_shares(
    before: Bodies, now: Bodies, owner: Int64[np.ndarray, " n"], motion: CameraMotion
) -> Float64[np.ndarray, "n bodies"]:
    """Motion share, from 0 (still) to 1 (moved), of left hand, right hand and each object."""
    shift = np.linalg.norm(motion.to_start(now.pixels) - before.pixels[owner], axis=-1)
    shift = np.where(before.in_front[owner] & now.in_front, shift, 0.0)
    # Points that crossed the camera plane have moved.
    shift[before.in_front[owner] != now.in_front] = np.inf
    hands, boxes = shift[:, :44].reshape(-1, 2, 22), shift[:, 44:].reshape(len(owner), -1, 8)
    largest = np.concatenate([hands.max(axis=-1), boxes.max(axis=-1)], axis=1)
    return np.asarray(((largest - STILL_PX) / (MOVED_PX - STILL_PX)).clip(0.0, 1.0))
