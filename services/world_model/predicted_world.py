"""Validated rollout starts, action chunks and snapshots, for both kinds of world model."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from torch import Tensor

from dextouch.errors import (
    EndedError,
    InvalidInputError,
    NonFiniteError,
    ShapeError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses, check_actions
from dextouch.images import scaled_square
from dextouch.schemas import EVERYTHING, Observation, ReturnSelector, RolloutStart, WorldDescription
from dextouch.streams import HEAD_CAMERA, unpack
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from dextouch.worlds import BatchWorld, SteppedRollout, check_chunk
from services.world_model.checkpoints import StateCheckpoint
from services.world_model.dynamics import features
from services.world_model.dynamics.model import first_steps, mean_poses
from services.world_model.dynamics.tensor_trees import stacked
from services.world_model.network.inputs import ObjectsAtStart, PredictionRequest

# Larger values are mistakes of units or frames.
MAX_ANCHOR_M, MAX_CAMERA_PX = 5.0, 1e5
# With one image, of 3 MB at the largest side of 1024 px; snapshots of several views are larger.
MAX_SNAPSHOT_BYTES = 4 * 2**20
# A rollout ends once its hands have moved four times the length of a training episode, since no
# longer ones were trained on, and errors of chunk after chunk add up.
LAST_HORIZONS = 4


@dataclass(frozen=True)
class ObservedStart:
    """The step that a rollout begins with, in copies; `reached` poses are the identity."""

    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: Float32[np.ndarray, "2 taxels"]
    reached: Float64[np.ndarray, "67"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]

    def observation(
        self, object_poses: Float32[np.ndarray, "1 objects 7"] | None = None
    ) -> Observation:
        """Observation of step 0, as returned to clients."""
        return Observation(
            first_step=0,
            images={HEAD_CAMERA: self.image[None].copy()},
            tactile_kpa=self.tactile_kpa[None].copy(),
            action_reached=self.reached[None].copy(),
            reached_is_measured=True,
            object_poses=object_poses,
        )


def observed_start(
    start: RolloutStart,
    *,
    tasks: Sequence[str],
    layout: TactileLayout = DEXTOUCH_V1,
    image_px: int | None = None,
) -> ObservedStart:
    """Validate the observed step of a start, and scale its image's middle square to `image_px`.

    Raises:
        InvalidInputError: missing observation, anchor or K_head.
        UnknownNameError: unknown task, or no head camera image.
        ShapeError: more than one observed step, or touch of another glove layout.
        NonFiniteError: NaN or infinity in touch.
    """
    if start.task not in tasks:
        raise UnknownNameError("task", start.task, list(tasks))
    observation = start.observation
    if observation is None or start.anchor is None or start.K_head is None:
        raise InvalidInputError(
            "start: this world begins from an observation; send one step of images, touch and "
            "reached action together with the anchor poses and K_head"
        )
    if HEAD_CAMERA not in observation.images:
        raise UnknownNameError("camera of the start", "none of them", [HEAD_CAMERA])
    if len(observation) != 1:
        raise ShapeError(f"start: got {len(observation)} observed steps, expected one")
    if observation.tactile_kpa.shape[-1] != layout.num_taxels:
        raise ShapeError(
            f"start: got touch of {observation.tactile_kpa.shape[-1]} taxels, expected "
            f"{layout.num_taxels} of the glove layout {layout.name!r}, which this world was "
            "trained with; start from an episode of that glove"
        )
    if not np.isfinite(observation.tactile_kpa).all():
        raise NonFiniteError("start: touch contains NaN or infinity; mask the faulty taxels first")
    reached = observation.action_reached[-1].copy()
    for part in POSE_SLICES:
        reached[part] = IDENTITY_POSE_9D
    image, K_head = observation.images[HEAD_CAMERA][-1:], np.array(start.K_head)
    if image_px is not None:
        image, K_head = scaled_square(image, K_head, image_px)
    return ObservedStart(
        image=image[0].copy(),
        tactile_kpa=np.maximum(observation.tactile_kpa[-1], 0.0),
        reached=reached,
        anchor=start.anchor,
        K_head=K_head,
    )


def check_geometry(anchor: AnchorPoses, K_head: Float64[np.ndarray, "3 3"]) -> None:
    """Reject anchors farther than 5 m and implausible focal lengths or principal points.

    Raises:
        InvalidInputError: these.
        NonFiniteError: NaN or infinity.
    """
    Ts = np.stack([np.asarray(T, dtype=np.float64) for T in anchor.as_tuple()])
    if not (np.isfinite(Ts).all() and np.isfinite(K_head).all()):
        raise NonFiniteError("start: anchor or K_head contain NaN or infinity")
    far_m = float(np.abs(Ts[:, :3, 3]).max())
    if far_m > MAX_ANCHOR_M:
        raise InvalidInputError(
            f"start: an anchor pose lies {far_m:.3g} m from the world's origin, expected at most "
            f"{MAX_ANCHOR_M} m; send poses in the frame of the table"
        )
    focal_px, centre_px = np.diag(K_head)[:2], np.abs(K_head[:2, 2])
    if focal_px.min() < 1.0 or max(focal_px.max(), centre_px.max()) > MAX_CAMERA_PX:
        raise InvalidInputError(
            f"start: K_head has focal lengths {focal_px.tolist()} and centre "
            f"{K_head[:2, 2].tolist()} px, expected 1 … {MAX_CAMERA_PX:.0f} px"
        )


@runtime_checkable
class Moving(Protocol):
    """State of a rollout that counts the latent steps in which its hands moved."""

    @property
    def num_moving(self) -> int:
        """The count."""


State = TypeVar("State", bound=Moving)


class PredictedWorld(BatchWorld[State]):
    """World of a checkpoint of either kind, with training episodes of `_horizon_latents`."""

    _description: WorldDescription
    _horizon_latents: int

    @property
    def description(self) -> WorldDescription:
        """Capabilities and limits of this world."""
        return self._description

    @abstractmethod
    def _stepped(
        self,
        states: Sequence[State],
        chunks: list[np.ndarray],
        seeds: Sequence[int],
        requested: list[ReturnSelector],
    ) -> list[SteppedRollout[State]]:
        """`step_batch` of checked arguments."""

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """Predict action chunks of 4k steps; others of the batch change results by rounding.

        Raises:
            ShapeError: not a chunk of 4k steps and a seed for each rollout.
            LimitExceededError: chunks of more than `max_chunk_steps`.
            InvalidInputError: physically impossible actions, or views without a start.
            EndedError: hands have moved four times as long as any episode of training.
            UnavailableError: the model predicts NaN or infinity.
        """
        requested = [EVERYTHING] * len(states) if selectors is None else list(selectors)
        counts = (len(states), len(actions), len(seeds), len(requested))
        if len(set(counts)) != 1 or len(states) == 0:
            raise ShapeError(
                f"chunks: got {counts[0]} states, {counts[1]} action chunks, {counts[2]} seeds and "
                f"{counts[3]} selectors, expected one of each for every rollout"
            )
        world, limit = self._description, LAST_HORIZONS * self._horizon_latents
        if any(state.num_moving >= limit for state in states):
            seconds = limit * features.STEPS_PER_LATENT / world.model_rate_hz
            reason = (
                f"hands moved for {seconds:.0f} s, four times as long as any episode this model "
                "was trained on"
            )
            raise EndedError(f"world {world.name}: {reason}", reason=reason)
        chunks = [check_actions(check_chunk(chunk, world), where="chunk") for chunk in actions]
        return self._stepped(states, chunks, seeds, requested)


def opened_snapshot(
    data: bytes, digest: str, *, max_bytes: int = MAX_SNAPSHOT_BYTES
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Fields and arrays of a snapshot; raises InvalidInputError for one of another digest."""
    fields, arrays = unpack(data, max_bytes=max_bytes)
    if fields.get("digest") != digest:
        raise InvalidInputError(
            f"snapshot: made by world {str(fields.get('digest'))[:12]!r}, expected "
            f"{digest[:12]!r}; restore it in the world that made it"
        )
    return fields, arrays


def foreign_snapshot(
    fields: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> InvalidInputError:
    """The error of a snapshot with other contents than the world writes."""
    return InvalidInputError(
        f"snapshot: got {sorted(fields)} and arrays {sorted(arrays)}, expected those that this "
        "world's own snapshot writes"
    )


def refuse_non_finite(model: str, predicted: Mapping[str, Tensor]) -> None:
    """Raise UnavailableError if a model predicted NaN or infinity."""
    for what, values in predicted.items():
        if not torch.isfinite(values).all():
            raise UnavailableError(
                f"{model}: its {what} contains NaN or infinity; the rollout did not advance"
            )


class SceneReader:
    """Finds objects for a model with contact geometry, by the mean of a state model's readers."""

    def __init__(self, checkpoint: StateCheckpoint) -> None:
        self._readers = checkpoint.dynamics.readers()
        self._metadata = checkpoint.metadata
        self.tasks = checkpoint.metadata.dynamics.tasks
        self.tactile_layout = checkpoint.metadata.dynamics.tactile_layout

    @torch.no_grad()
    def objects(
        self, requests: Sequence[PredictionRequest], tasks: Sequence[str]
    ) -> list[ObjectsAtStart]:
        """Objects at first steps; raises UnknownNameError for a task that is not known."""
        unknown = sorted(set(tasks) - set(self.tasks))
        if unknown:
            raise UnknownNameError("task of the start readers", unknown[0], list(self.tasks))
        hands = [features.hand_motion(request.actions[:1], request.anchor) for request in requests]
        first = first_steps(
            [request.first_image for request in requests],
            [request.K_head for request in requests],
            [request.first_tactile_kpa for request in requests],
            hands,
            [self.tasks.index(task) for task in tasks],
            self.tactile_layout,
        )
        readings = [reader(first) for reader in self._readers]
        poses = features.poses_from_objects(mean_poses(stacked([one.objects for one in readings])))
        size = stacked([one.size for one in readings]).mean(0).double().numpy()
        found = []
        for row, task in enumerate(tasks):
            boxes_m = np.array(self._metadata.object_boxes_m[task])
            here = row, slice(len(boxes_m))
            found.append(ObjectsAtStart(poses[here], boxes_m * size[here][:, features.BOX_AXES]))
        return found
