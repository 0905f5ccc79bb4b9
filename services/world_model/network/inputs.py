"""Input tensors of the joint model, which training and serving build alike: `build_inputs`."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from torch import Tensor

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, UnknownNameError
from dextouch.geometry import apply, invert, project, rigid_error, transform_from_pose
from dextouch.hands.actions import (
    ACTION_DIM,
    IDENTITY_POSE_9D,
    JOINTS_LEFT,
    JOINTS_RIGHT,
    POSE_SLICES,
    WRIST_LEFT,
    WRIST_RIGHT,
    AnchorPoses,
    check_actions,
    pose_from_9d,
    pose_to_9d,
)
from dextouch.hands.actions import CAMERA_HEAD as CAMERA
from dextouch.hands.robot_hand import chain_points_of_both_m
from dextouch.schemas import MAX_OBJECTS, ActionKind
from dextouch.tactile.layout import TactileLayout
from services.world_model.dynamics import features
from services.world_model.network.attention import (
    MIRROR_CAMERA,
    MIRROR_WRIST,
    camera_features,
    hand_features,
    mirror_pose_9d,
)
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig, PastChoice
from services.world_model.network.instruction import NO_WORD, instruction_ids

_PER_SLOT = features.SLOT_SIZE // len(features.SAMPLE_OFFSETS) + 6 + 1
# Of a hand: every slot's features, its box and whether it holds an object; and the side.
GEOMETRY_SIZE = MAX_OBJECTS * _PER_SLOT + 1
_PER_M = 10.0
# Standard deviation of a point's Gaussian blot, in raster cells.
BLOT_CELLS = 1.0
MAX_TRANSLATION_M = 2.0
MAX_JOINT_RAD = 2.0 * np.pi
MAX_PRESSURE_KPA = 1e5
# Poses and angles are rounded to 1e-9 m and 1e-9 rad: finer differences only depend on how often a
# pose was re-anchored.
DECIMALS = 9
ACTION_KINDS: tuple[ActionKind, ActionKind] = ("measured", "commanded")
# Images that a rollout keeps, the oldest dropped: 34 s at the usual stride.
MAX_KEPT: Final = 32
# Two poses are as far apart as their origins and points on their axes: at the length of a hand,
# and for the camera about where it looks, so that a turn counts by what it changes in the image.
_HAND_M, _HEAD_M = 0.1, 0.5


@dataclass(frozen=True)
class PastRule:
    """Which images before a window are chosen: `count` of the last `kept`, `stride` steps apart."""

    count: int
    choice: PastChoice
    stride: int
    kept: int = MAX_KEPT

    @classmethod
    def of(cls, config: NetworkConfig) -> "PastRule | None":
        """The rule of a network; None for one that remembers nothing."""
        if not config.past_images:
            return None
        return cls(config.past_images, config.past_choice, config.past_stride)

    def steps(self, start: int) -> Int64[np.ndarray, " kept"]:
        """Steps of an episode that a rollout would keep before `start`, the oldest first."""
        every = np.arange(start % self.stride, start, self.stride)
        return every[max(0, len(every) - self.kept) :]

    def chosen(
        self, kept: Float64[np.ndarray, "kept 67"], actions: Float64[np.ndarray, "time 67"]
    ) -> list[int]:
        """Indices of the chosen of the `kept` images, the oldest first, for a window's actions.

        With `nearest`, latent steps of the window take turns, the last one first, and each takes
        the image whose poses of hands and camera are nearest to its own. Both have one anchor.
        """
        if self.choice == "recent" or len(kept) <= self.count:
            return list(range(len(kept)))[-self.count :]
        ends = pose_points_m(actions[FRAMES_PER_LATENT::FRAMES_PER_LATENT])[::-1]
        away_m = np.linalg.norm(pose_points_m(kept)[None] - ends[:, None], axis=-1).mean(axis=-1)
        found: list[int] = []
        for turn in range(self.count):
            row = away_m[turn % len(ends)].copy()
            row[found] = np.inf
            # Of equally near ones the newest.
            found.append(len(row) - 1 - int(row[::-1].argmin()))
        return sorted(found)


def pose_points_m(actions: Float64[np.ndarray, "n 67"]) -> Float64[np.ndarray, "n 12 3"]:
    """Origin of wrists and head camera and points on their axes, relative to their anchors."""
    points = []
    for part in POSE_SLICES:
        T = pose_from_9d(actions[:, part])
        reach_m = _HAND_M if part in (WRIST_LEFT, WRIST_RIGHT) else _HEAD_M
        axes = np.swapaxes(T[:, :3, :3], 1, 2) * reach_m
        points.append(T[:, None, :3, 3] + np.concatenate([np.zeros_like(axes[:, :1]), axes], 1))
    return np.concatenate(points, axis=1)


def kept_bytes(config: NetworkConfig) -> int:
    """Most that a rollout keeps of the past: half-precision latents, and poses and step."""
    latents = config.tokens_per_frame * config.video_channels * 2
    return MAX_KEPT * (latents + 8 * (ACTION_DIM + 1)) if config.past_images else 0


@dataclass(frozen=True)
class PastImages:
    """Images before a window, the oldest first, as pixels or as their latents.

    `actions` [n, 67] are relative to the window's anchor, `ages` how many steps ago they were.
    `images` have the views of the network, black where one is missing; `latents` are the codec's.
    """

    actions: Float64[np.ndarray, "n 67"]
    ages: Int64[np.ndarray, " n"]
    images: UInt8[np.ndarray, "n views h w 3"] | None = None
    latents: Float32[np.ndarray, "n tokens channels"] | None = None


@dataclass(frozen=True)
class ObjectsAtStart:
    """Objects at a window's first step: x y z (m), qw qx qy qz; boxes as middle and half sizes."""

    poses: Float64[np.ndarray, "objects 7"]
    boxes_m: Float64[np.ndarray, "objects 6"]

    def __post_init__(self) -> None:
        count = len(self.poses)
        if count > MAX_OBJECTS or len(self.boxes_m) != count:
            raise InvalidInputError(
                f"objects: got {count} poses and {len(self.boxes_m)} boxes, expected one each of "
                f"at most {MAX_OBJECTS} objects"
            )


def contact_geometry(
    actions: Float64[np.ndarray, "time 67"], anchor: AnchorPoses, objects: ObjectsAtStart | None
) -> Float32[np.ndarray, "time 2 size"]:
    """Features of every step as of the state model's core, for objects as they first lie."""
    points_m = torch.from_numpy(features.hand_motion(actions, anchor).points_m)[:, None]
    steps = len(points_m)
    slots = torch.zeros(steps, 2, MAX_OBJECTS, _PER_SLOT)
    if objects is not None and len(objects.poses):
        T = torch.from_numpy(transform_from_pose(objects.poses)).float()
        boxes = torch.from_numpy(objects.boxes_m).float()
        count = len(boxes)
        each = features.slot_features(
            points_m,
            T[None, :, :3, 3].expand(steps, -1, -1),
            T[None, :, :3, :3].expand(steps, -1, -1, -1),
            boxes[None].expand(steps, -1, -1),
        )
        known = torch.cat([boxes * _PER_M, torch.ones(count, 1)], dim=-1)
        slots[:, :, :count] = torch.cat([each, known.expand(steps, 2, -1, -1)], dim=-1)
    side = torch.tensor([-1.0, 1.0])[None, :, None].expand(steps, -1, -1)
    return torch.cat([slots.flatten(2), side], dim=-1).numpy()


def blots(
    pixels: np.ndarray, visible: np.ndarray, *, image_px: int, cells: int
) -> Float32[np.ndarray, "*batch cells cells"]:
    """Gaussian blots of points [..., n, 2] on a cells × cells raster of the image, in 0 … 1."""
    position = pixels.astype(np.float32) * (cells / image_px)
    centres = np.arange(cells, dtype=np.float32) + 0.5
    across = np.exp(-0.5 * np.square((centres - position[..., :1]) / BLOT_CELLS))
    down = np.exp(-0.5 * np.square((centres - position[..., 1:]) / BLOT_CELLS))
    down = down * visible[..., None].astype(np.float32)
    # Overlapping blots saturate at one instead of adding up.
    return (1.0 - np.exp(-np.swapaxes(down, -1, -2) @ across)).astype(np.float32)


def pose_raster(
    actions: np.ndarray, anchors: np.ndarray, K_head: np.ndarray, *, image_px: int, cells: int
) -> Float32[np.ndarray, "batch time 2 cells cells"]:
    """Rasters of both hands, left first, at the poses of the actions, as the head camera sees them.

    The paper conditions by AdaLN alone; this is an addition. `anchors` are T_world of left wrist,
    right wrist and head camera at step 0; lens distortion is not applied, and points behind the
    camera leave no blot.
    """
    actions = np.asarray(actions, dtype=np.float64)
    Ts_world_camera = anchors[:, None, 2] @ pose_from_9d(actions[..., CAMERA])
    Ts_camera_world = invert(Ts_world_camera)
    joints_rad = np.stack([actions[..., JOINTS_LEFT], actions[..., JOINTS_RIGHT]], axis=-2)
    # The wrists, then four points per finger, in wrist coordinates.
    points_m = np.zeros((*joints_rad.shape[:-1], 21, 3))
    points_m[..., 1:, :] = chain_points_of_both_m(joints_rad).reshape(*joints_rad.shape, 3)
    rasters = []
    for index, wrist in enumerate((WRIST_LEFT, WRIST_RIGHT)):
        Ts_world_wrist = anchors[:, None, index] @ pose_from_9d(actions[..., wrist])
        points_camera = apply(Ts_camera_world @ Ts_world_wrist, points_m[:, :, index])
        each = zip(K_head, points_camera, strict=True)
        pixels, visible = map(np.stack, zip(*(project(K, one) for K, one in each), strict=True))
        # Far outside the image a blot is zero; clipping keeps float32 squares finite.
        pixels = np.clip(pixels, -10.0 * image_px, 10.0 * image_px)
        rasters.append(blots(pixels, visible, image_px=image_px, cells=cells))
    return np.stack(rasters, axis=2)


@dataclass(frozen=True)
class PredictionRequest:
    """One window to predict, of T = 1 + 4k actions.

    They are relative to `anchor`, which is row 0 by definition: its poses are ignored. `objects`
    are those of row 0, `further_images` those of the network's further views, None where one is
    missing; `past` is for networks with `past_images`.
    """

    first_image: UInt8[np.ndarray, "h w 3"]
    first_tactile_kpa: Float32[np.ndarray, "2 taxels"]
    actions: Float64[np.ndarray, "time 67"]
    action_kind: ActionKind
    instruction: str
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    objects: ObjectsAtStart | None = None
    further_images: tuple[UInt8[np.ndarray, "h w 3"] | None, ...] = ()
    past: PastImages | None = None


@dataclass(frozen=True)
class ModelInputs:
    """Batched tensors of requests in physical units; normalized inside the network.

    `acting` is 0 for windows without actions, otherwise 1. `missing` says which of the further
    views are. Past images come as pixels or as latents, and the other has none; where there are
    fewer than the network takes, the rest have age 0, and are the first image.
    """

    first_image: UInt8[Tensor, "batch px px 3"]
    first_tactile_kpa: Float32[Tensor, "batch 2 taxels"]
    hands: Float32[Tensor, "batch time 2 29"]
    camera: Float32[Tensor, "batch time 2 9"]
    layout: Float32[Tensor, "batch 2 9"]
    raster: Float32[Tensor, "batch time 2 cells cells"]
    geometry: Float32[Tensor, "batch time 2 features"]
    commanded: Float32[Tensor, " batch"]
    acting: Float32[Tensor, " batch"]
    words: Int64[Tensor, "batch ids"]
    instructions: tuple[str, ...]
    further_images: UInt8[Tensor, "batch further px px 3"]
    missing: Bool[Tensor, "batch further"]
    past_images: UInt8[Tensor, "batch seen views px px 3"]
    past_latents: Float32[Tensor, "batch encoded tokens channels"]
    past_hands: Float32[Tensor, "batch past 2 29"]
    past_camera: Float32[Tensor, "batch past 2 9"]
    past_raster: Float32[Tensor, "batch past 2 cells cells"]
    past_age: Float32[Tensor, "batch past"]

    @property
    def num_steps(self) -> int:
        """Steps of the window, including the first one."""
        return self.hands.shape[1]

    def __len__(self) -> int:
        return len(self.first_image)

    def to(self, device: torch.device) -> "ModelInputs":
        """Copy to a device."""
        return self._changed(lambda _, one: one.to(device), self.instructions)

    def first_step_keys(self) -> list[bytes]:
        """A digest of all of each window that is known at its first step, without later actions."""
        known = (self.first_image, self.first_tactile_kpa, self.layout, self.raster[:, 0])
        past = [one for name, one in vars(self).items() if name.startswith("past_")]
        further = (self.further_images, self.missing, *past)
        arrays = [one.cpu().numpy() for one in (*known, self.commanded, self.words, *further)]
        digests = []
        for index, text in enumerate(self.instructions):
            parts = [text.encode(), *(array[index].tobytes() for array in arrays)]
            digests.append(hashlib.sha256(b"".join(parts)).digest())
        return digests

    def rows(self, indices: Sequence[int]) -> "ModelInputs":
        """Some of the windows."""
        texts = tuple(self.instructions[index] for index in indices)
        return self._changed(lambda _, one: one[list(indices)], texts)

    def joined(self, others: "ModelInputs") -> "ModelInputs":
        """These windows, then others."""
        return self._changed(
            lambda name, one: torch.cat([one, getattr(others, name)]),
            (*self.instructions, *others.instructions),
        )

    def without(
        self, text: Bool[Tensor, " batch"], actions: Bool[Tensor, " batch"]
    ) -> "ModelInputs":
        """The windows without the instructions and the actions after the first step of some."""

        def kept(name: str, one: Tensor) -> Tensor:
            if name == "words":
                return one.where(~text[:, None], NO_WORD)
            if name == "acting":
                return one * ~actions
            if name not in {"raster", "geometry"}:
                return one
            later = torch.arange(one.shape[1], device=one.device) > 0
            dropped = actions[:, None] & later
            return one.where(~dropped.view(*dropped.shape, *[1] * (one.ndim - 2)), 0.0)

        texts = zip(self.instructions, text.tolist(), strict=True)
        return self._changed(kept, tuple("" if absent else known for known, absent in texts))

    def _changed(
        self, change: Callable[[str, Tensor], Tensor], instructions: tuple[str, ...]
    ) -> "ModelInputs":
        changed: dict[str, Any] = {
            name: change(name, one) for name, one in vars(self).items() if isinstance(one, Tensor)
        }
        return replace(self, **changed, instructions=instructions)


def build_inputs(requests: Sequence[PredictionRequest], config: NetworkConfig) -> ModelInputs:
    """Validate requests of one length and stack them into network tensors.

    Raises:
        ShapeError: wrong array shapes, or requests of different lengths.
        NonFiniteError: NaN or infinity.
        DegenerateRotationError: the actions contain a degenerate rotation.
        UnknownNameError: unknown action kind.
        InvalidInputError: poses or angles out of physical range, or no request.
    """
    if not requests:
        raise InvalidInputError("model input: got no request, expected at least one")
    checked = [_checked_actions(r, config) for r in requests]
    lengths = {len(rows) for rows in checked}
    if len(lengths) != 1:
        raise ShapeError(
            f"model input: got windows of {sorted(lengths)} steps in one batch, expected one length"
        )
    kinds = [r.action_kind for r in requests]
    if unknown := set(kinds) - set(ACTION_KINDS):
        raise UnknownNameError("action kind", unknown.pop(), list(ACTION_KINDS))
    actions = np.stack(checked)
    anchors = np.stack([_checked_anchor(r.anchor) for r in requests])
    K_head = np.stack([_checked_camera(r.K_head) for r in requests])
    raster = pose_raster(
        actions, anchors, K_head, image_px=config.image_px, cells=config.raster_cells
    )
    # A network that does not use contact geometry has no features of it.
    geometry = np.zeros((*actions.shape[:2], 2, 0), dtype=np.float32)
    if config.use_contact_geometry:
        each = zip(requests, actions, strict=True)
        geometry = np.stack([contact_geometry(row, r.anchor, r.objects) for r, row in each])
    return ModelInputs(
        first_image=torch.from_numpy(
            np.stack([_checked_image(r.first_image, config, "first") for r in requests])
        ),
        first_tactile_kpa=torch.from_numpy(
            np.stack([_checked_tactile(r, config.tactile_layout) for r in requests])
        ),
        hands=torch.from_numpy(hand_features(actions).astype(np.float32)),
        camera=torch.from_numpy(camera_features(actions).astype(np.float32)),
        layout=torch.from_numpy(_hand_layout(anchors).astype(np.float32)),
        raster=torch.from_numpy(raster),
        geometry=torch.from_numpy(geometry),
        commanded=torch.tensor([float(kind == "commanded") for kind in kinds]),
        acting=torch.ones(len(requests)),
        words=torch.stack([instruction_ids(r.instruction, config) for r in requests]),
        instructions=tuple(r.instruction for r in requests),
        **_further_views(requests, config),
        **_past_inputs(requests, actions, anchors, K_head, config),
    )


def _further_views(
    requests: Sequence[PredictionRequest], config: NetworkConfig
) -> dict[str, Tensor]:
    """First images of the further views, black where one is missing, and which are."""
    px, names = config.image_px, config.further_views
    images = np.zeros((len(requests), len(names), px, px, 3), dtype=np.uint8)
    missing = np.ones(images.shape[:2], dtype=np.bool_)
    for row, request in enumerate(requests):
        if len(request.further_images) not in {0, len(names)}:
            raise ShapeError(
                f"model input: got {len(request.further_images)} further views, expected those of "
                f"{', '.join(names) or 'none'}"
            )
        for view, image in enumerate(request.further_images):
            if image is not None:
                images[row, view] = _checked_image(image, config, names[view])
                missing[row, view] = False
    return {"further_images": torch.from_numpy(images), "missing": torch.from_numpy(missing)}


def _past_inputs(
    requests: Sequence[PredictionRequest],
    actions: np.ndarray,
    anchors: np.ndarray,
    K_head: np.ndarray,
    config: NetworkConfig,
) -> dict[str, Tensor]:
    """Images of the past, their poses and ages; the first image, of age 0, where there are less."""
    count, num = config.past_images, len(requests)
    pasts = [request.past for request in requests]
    rows, ages = np.repeat(actions[:, :1], count, axis=1), np.zeros((num, count))
    shape = num, count, config.num_views, config.image_px, config.image_px, 3
    images = np.zeros(shape, dtype=np.uint8)
    latents = np.zeros((num, count, config.tokens_per_frame, config.video_channels), np.float32)
    if is_encoded := any(past is not None and past.latents is not None for past in pasts):
        images = images[:, :0]
    else:
        latents = latents[:, :0]
    for row, past in enumerate(pasts):
        if past is None or not len(past.ages):
            continue
        values = past.latents if is_encoded else past.images
        whole = latents if is_encoded else images
        expected = (len(past.ages), *whole.shape[2:])
        if values is None or values.shape != expected or len(past.ages) > count:
            raise ShapeError(
                f"model input: got past images {None if values is None else values.shape}, expected"
                f" {expected} with at most {count} of them, all of a batch as pixels or as latents"
            )
        first = count - len(past.ages)
        rows[row, first:] = check_actions(past.actions, where="past actions").round(DECIMALS) + 0.0
        ages[row, first:], whole[row, first:] = past.ages, values
    raster = np.zeros((num, 0, 2, config.raster_cells, config.raster_cells), np.float32)
    if count:
        raster = pose_raster(
            rows, anchors, K_head, image_px=config.image_px, cells=config.raster_cells
        )
    return {
        "past_images": torch.from_numpy(images),
        "past_latents": torch.from_numpy(latents),
        "past_hands": torch.from_numpy(hand_features(rows).astype(np.float32)),
        "past_camera": torch.from_numpy(camera_features(rows).astype(np.float32)),
        "past_raster": torch.from_numpy(raster),
        "past_age": torch.from_numpy(ages.astype(np.float32)),
    }


def _hand_layout(anchors: np.ndarray) -> Float64[np.ndarray, "batch 2 9"]:
    """T_camera_wrist of both hands at the anchor, the left one mirrored."""
    Ts_camera_wrist = invert(anchors[:, 2])[:, None] @ anchors[:, :2]
    poses = pose_to_9d(Ts_camera_wrist)
    left = mirror_pose_9d(poses[:, 0], mirror_to=MIRROR_CAMERA, mirror_from=MIRROR_WRIST)
    return np.stack([left, poses[:, 1]], axis=1)


def _checked_actions(request: PredictionRequest, config: NetworkConfig) -> np.ndarray:
    actions = check_actions(request.actions, where="model actions").copy()
    num_future = len(actions) - 1
    if num_future < 1 or num_future % FRAMES_PER_LATENT or len(actions) > config.max_steps:
        raise ShapeError(
            f"model actions: got {len(actions)} rows, expected 1 + 4k, at most {config.max_steps}"
        )
    for part in POSE_SLICES:
        actions[0, part] = IDENTITY_POSE_9D
    check_reach(actions)
    return actions.round(DECIMALS) + 0.0


def check_reach(actions: Float64[np.ndarray, "time 67"]) -> None:
    """Raise InvalidInputError beyond 2 m from the anchor, or a full turn of a joint."""
    for part in POSE_SLICES:
        reach_m = float(np.abs(actions[:, part][:, :3]).max())
        if reach_m > MAX_TRANSLATION_M:
            raise InvalidInputError(
                f"model actions: a pose lies {reach_m:.3g} m from the anchor, expected at most "
                f"{MAX_TRANSLATION_M} m; translations are in metres, relative to row 0",
                got=reach_m,
            )
    for part in (JOINTS_LEFT, JOINTS_RIGHT):
        angle_rad = float(np.abs(actions[:, part]).max())
        if angle_rad > MAX_JOINT_RAD:
            raise InvalidInputError(
                f"model actions: a joint angle of {angle_rad:.3g} rad, expected at most "
                f"{MAX_JOINT_RAD:.3g}; angles are in radians",
                got=angle_rad,
            )


def _checked_anchor(anchor: AnchorPoses) -> np.ndarray:
    Ts = np.stack([np.asarray(T, dtype=np.float64) for T in anchor.as_tuple()])
    if Ts.shape != (3, 4, 4):
        raise ShapeError(f"anchor: got shape {Ts.shape}, expected three 4x4 transforms")
    if not np.isfinite(Ts).all():
        raise NonFiniteError("anchor: contains NaN or infinity, expected rigid transforms")
    if (error := rigid_error(Ts)) > 1e-3:
        raise InvalidInputError(
            f"anchor: not a rigid transform (RᵀR differs from the identity by {error:.2g}), "
            "expected T_world_wrist_left, T_world_wrist_right, T_world_camera_head"
        )
    return Ts.round(DECIMALS) + 0.0


def _checked_camera(K_head: np.ndarray) -> np.ndarray:
    K = np.asarray(K_head, dtype=np.float64)
    if K.shape != (3, 3):
        raise ShapeError(f"K_head: got shape {K.shape}, expected [3, 3]")
    if not np.isfinite(K).all():
        raise NonFiniteError("K_head: contains NaN or infinity")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InvalidInputError(
            f"K_head: got focal lengths {K[0, 0]:.3g} and {K[1, 1]:.3g} px, expected positive ones"
        )
    return K


def _checked_image(image: np.ndarray, config: NetworkConfig, which: str) -> np.ndarray:
    image = np.asarray(image)
    expected = (config.image_px, config.image_px, 3)
    if image.shape != expected or image.dtype != np.uint8:
        raise ShapeError(
            f"{which} image: got {image.dtype} {image.shape}, expected uint8 {expected}"
        )
    return image


def _checked_tactile(request: PredictionRequest, layout: TactileLayout) -> np.ndarray:
    tactile = np.asarray(request.first_tactile_kpa, dtype=np.float32)
    if tactile.shape != (2, layout.num_taxels):
        raise ShapeError(
            f"first touch: got shape {tactile.shape}, expected [2, {layout.num_taxels}] of the "
            f"glove layout {layout.name!r}, which the model was trained with"
        )
    if not np.isfinite(tactile).all():
        raise NonFiniteError("first touch: contains NaN or infinity; mask the faulty taxels first")
    if tactile.max() > MAX_PRESSURE_KPA:
        raise InvalidInputError(
            f"first touch: got {tactile.max():.3g} kPa, expected at most {MAX_PRESSURE_KPA:.0e}"
        )
    return tactile
