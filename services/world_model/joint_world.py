"""World of a joint model: predicts observations chunk by chunk, by flow matching."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float16, Float32, Float64, UInt8

from dextouch.errors import InvalidInputError
from dextouch.geometry import apply
from dextouch.hands.actions import AnchorPoses, check_actions, poses_from_actions, reanchor
from dextouch.schemas import ActionKind, Observation, ReturnSelector, RolloutStart, WorldDescription
from dextouch.streams import HEAD_CAMERA, pack
from dextouch.tactile.layout import described
from dextouch.worlds import StartedRollout, SteppedRollout, asked_cameras
from services.world_model import checkpoints, predicted_world
from services.world_model.dynamics.features import FREE_KPA, NUM_POINTS, hand_motion
from services.world_model.dynamics.model import REST_LATENTS, stillness
from services.world_model.network.attention import split_axis
from services.world_model.network.codecs import to_uint8, to_unit
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig
from services.world_model.network.inputs import (
    ACTION_KINDS,
    MAX_KEPT,
    PastImages,
    PastRule,
    PredictionRequest,
    build_inputs,
    kept_bytes,
)
from services.world_model.network.model import Sampling, stack_noise

_IMAGE = "image/"
_SNAPSHOT_ARRAYS = ("image", "tactile_kpa", "reached", "anchor", "K_head", "still_m")
_SNAPSHOT_FIELDS = ("instruction", "action_kind", "step", "task", "num_still", "num_moving")
# Points on the axes of the head camera, so that it counts as still only if it does not turn either.
_CAMERA_POINTS_M = np.concatenate([np.zeros((1, 3)), np.eye(3)])
_NUM_WATCHED_POINTS = NUM_POINTS + len(_CAMERA_POINTS_M)


@dataclass(frozen=True)
class KeptImages:
    """Images that a rollout remembers, the oldest first: steps, poses then, and latents."""

    steps: tuple[int, ...]
    reached: Float64[np.ndarray, "kept 67"]
    latents: Float16[np.ndarray, "kept tokens channels"]

    @classmethod
    def none(cls, config: NetworkConfig) -> "KeptImages":
        """Those of a rollout that begins."""
        shape = 0, config.tokens_per_frame, config.video_channels
        return cls((), np.zeros((0, 67)), np.zeros(shape, np.float16))

    def with_first(
        self, state: "JointWorldState", latents: np.ndarray, config: NetworkConfig
    ) -> "KeptImages":
        """These and the first image of a chunk, if it is a stride after the last of them."""
        rule = PastRule.of(config)
        if rule is None or (self.steps and state.step - self.steps[-1] < rule.stride):
            return self
        last = slice(-MAX_KEPT, None)
        return KeptImages(
            (*self.steps, state.step)[last],
            np.concatenate([self.reached, state.reached[None]])[last],
            np.concatenate([self.latents, latents[None].astype(np.float16)])[last],
        )

    def before(
        self, state: "JointWorldState", actions: np.ndarray, config: NetworkConfig
    ) -> PastImages | None:
        """Those that a chunk of these re-anchored actions is predicted from."""
        rule = PastRule.of(config)
        if rule is None or not self.steps:
            return None
        poses = reanchor(self.reached, 0, anchor_action=state.reached)
        rows = rule.chosen(poses, actions)
        ages = state.step - np.array(self.steps)[rows]
        return PastImages(poses[rows], ages, latents=self.latents[rows].astype(np.float32))


@dataclass(frozen=True)
class JointWorldState(predicted_world.ObservedStart):
    """State of a rollout: its last step; `reached` is relative to `anchor`, the poses of step 0.

    `still_m` are points of hands and camera when they last moved, `num_still` latent steps ago;
    `num_moving` counts those with motion. `further` has the last images of further views.
    """

    instruction: str
    action_kind: ActionKind
    step: int
    task: str
    still_m: Float32[np.ndarray, "2 points 3"]
    num_still: int
    kept: KeptImages
    num_moving: int = 0
    further: dict[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)


class JointWorld(predicted_world.PredictedWorld[JointWorldState]):
    """A flow-matching model as a world.

    With contact geometry, `reader` finds objects at a chunk's start. A scene is at rest, bit for
    bit and without the network, in chunks without motion that follow two seconds without motion, or
    a start at which the hands touch nothing.

    Raises:
        InvalidInputError: a model with contact geometry, and no reader of all its tasks and of the
            layout of its glove.
    """

    def __init__(
        self,
        checkpoint: checkpoints.Checkpoint,
        *,
        sampling: Sampling | None = None,
        reader: predicted_world.SceneReader | None = None,
    ) -> None:
        self._model = checkpoint.model
        self._digest = checkpoint.digest
        self._sampling = sampling
        config, metadata = checkpoint.metadata.network, checkpoint.metadata
        self._horizon_latents = metadata.horizon_latents
        self._needs_views = not metadata.view_dropout
        self._reader = reader if config.use_contact_geometry else None
        if config.use_contact_geometry:
            _check_reader(reader, checkpoint.metadata)
        self._description = WorldDescription(
            name=metadata.name,
            kind="model",
            digest=checkpoint.digest,
            tasks=metadata.tasks,
            cameras=(HEAD_CAMERA,),
            optional_cameras=config.further_views,
            image_height_px=config.image_px,
            image_width_px=config.image_px,
            model_rate_hz=config.model_rate_hz,
            action_kinds=ACTION_KINDS,
            starts_from=("observation",),
            max_chunk_steps=config.max_steps - 1,
            predicts_touch=config.use_touch,
            tactile_layout=None if config.layout is None else config.tactile_layout,
        )

    def reset(self, start: RolloutStart) -> StartedRollout[JointWorldState]:
        """Start a rollout; raises as `observed_start`, `build_inputs` and `TextFeatures.of`."""
        first = predicted_world.observed_start(
            start, tasks=self._description.tasks, layout=self._model.config.tactile_layout
        )
        config = self._model.config
        seen = {} if start.observation is None else start.observation.images
        further: dict[str, np.ndarray] = {
            name: seen[name][-1].copy() for name in config.further_views if name in seen
        }
        if self._needs_views and len(further) < len(config.further_views):
            raise InvalidInputError(
                f"start: got images of {', '.join(seen)}, expected those of "
                f"{', '.join(config.further_views)}, too: this model was trained with all its "
                "views; send them, or train with --windows.view-dropout"
            )
        state = JointWorldState(
            **vars(first),
            instruction=start.instruction,
            action_kind=start.action_kind,
            step=0,
            task=start.task,
            still_m=_watched_points(first.reached[None], first.anchor)[0],
            num_still=REST_LATENTS * int(first.tactile_kpa.max() < FREE_KPA),
            kept=KeptImages.none(config),
            further=further,
        )
        if self._model.text_features is not None:
            self._model.text_features.of(start.instruction)
        self._check_chunk(state)
        observation = first.observation()
        observation.images.update({name: image[None] for name, image in further.items()})
        return StartedRollout(state, observation, first.anchor, first.K_head)

    def _stepped(
        self,
        states: Sequence[JointWorldState],
        chunks: list[np.ndarray],
        seeds: Sequence[int],
        requested: list[ReturnSelector],
    ) -> list[SteppedRollout[JointWorldState]]:
        for state, selector in zip(states, requested, strict=True):
            if absent := {*(selector.cameras or ())} - {HEAD_CAMERA, *state.further}:
                raise InvalidInputError(
                    f"chunk: got a request for {', '.join(sorted(absent))}, expected views that "
                    "the rollout began with; send their images with its start"
                )
        pairs = zip(states, chunks, strict=True)
        commanded_m = np.stack([_watched_points(chunk, state.anchor) for state, chunk in pairs])
        still = stillness(
            torch.from_numpy(np.stack([state.still_m for state in states])),
            torch.tensor([state.num_still for state in states]),
            split_axis(torch.from_numpy(commanded_m), 1, (-1, FRAMES_PER_LATENT)),
        )
        rests = still.at_rest.all(dim=1).tolist()
        each = zip(states, chunks, seeds, requested, strict=True)
        futures = iter(
            self._futures([one for one, is_still in zip(each, rests, strict=True) if not is_still])
        )
        stepped = []
        for index, (state, chunk) in enumerate(zip(states, chunks, strict=True)):
            following = replace(
                state,
                still_m=still.points_m[index].numpy(),
                num_still=int(still.num_still[index]),
                num_moving=state.num_moving + int(still.moves[index].sum()),
            )
            if rests[index]:
                views = {HEAD_CAMERA: state.image, **state.further}
                images = {name: np.stack([one] * len(chunk)) for name, one in views.items()}
                future = images, np.stack([state.tactile_kpa] * len(chunk))
            else:
                shown, touch, latents = next(futures)
                future = shown, touch
                kept = state.kept.with_first(state, latents, self._model.config)
                following = replace(following, kept=kept)
            stepped.append(_advance(following, chunk, future, requested[index]))
        return stepped

    def _futures(
        self, batch: Sequence[tuple[JointWorldState, np.ndarray, int, ReturnSelector]]
    ) -> list[tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]]:
        """Predicted images by view, maybe the last only, touch, and latents of the first images."""
        if not batch:
            return []
        states, chunks, seeds, requested = zip(*batch, strict=True)
        inputs = build_inputs(self._requests(states, chunks), self._model.config)
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        noise = stack_noise([self._model.noise(inputs.num_steps, each) for each in generators])
        needs_all = any(
            one.steps == "all" and (one.wants(HEAD_CAMERA) or one.cameras) for one in requested
        )
        future = self._model.predict(inputs, noise, sampling=self._sampling, all_images=needs_all)
        predicted_world.refuse_non_finite(
            "world model",
            {"image": future.images, "touch": future.tactile_kpa, "view": future.further},
        )
        shown = torch.cat([future.images[:, None], future.further], dim=1)
        images, touches = to_uint8(shown).cpu().numpy(), future.tactile_kpa.cpu().numpy()
        names = HEAD_CAMERA, *self._model.config.further_views
        views = [
            {name: one for name, one in zip(names, row, strict=True) if name in known}
            for row, known in zip(images, [{HEAD_CAMERA, *s.further} for s in states], strict=True)
        ]
        return list(zip(views, touches, future.first.cpu().numpy(), strict=True))

    def _requests(
        self, states: Sequence[JointWorldState], chunks: Sequence[np.ndarray]
    ) -> list[PredictionRequest]:
        """Requests for the chunks, with the objects as they are seen at the first step."""
        each = zip(states, chunks, strict=True)
        requests = [_request(state, chunk, self._model.config) for state, chunk in each]
        if self._reader is None:
            return requests
        objects = self._reader.objects(requests, [state.task for state in states])
        return [replace(one, objects=seen) for one, seen in zip(requests, objects, strict=True)]

    @torch.no_grad()
    def reconstruct(
        self,
        images: UInt8[np.ndarray, "steps h w 3"],
        tactile_kpa: Float32[np.ndarray, "steps 2 taxels"],
    ) -> tuple[UInt8[np.ndarray, "later h w 3"], Float32[np.ndarray, "later 2 taxels"]]:
        """Encode and decode images and touch of 1 + 4k steps; gives those after the first."""
        codec, tokenizer, device = self._model.codec, self._model.tokenizer, self._model.device
        seen = codec.decode_future(
            codec.encode(to_unit(torch.from_numpy(images.copy())[None].to(device))), all_images=True
        )
        touch = torch.from_numpy(tactile_kpa[1:].copy()).to(device)
        felt = tokenizer.decode(tokenizer.encode(touch))
        return to_uint8(seen[0]).cpu().numpy(), felt.cpu().numpy()

    def snapshot(self, state: JointWorldState) -> bytes:
        """Serialize the state for `restore` with the same checkpoint."""
        fields = {name: getattr(state, name) for name in _SNAPSHOT_FIELDS}
        fields |= {"digest": self._digest}
        arrays = {name: getattr(state, name) for name in _SNAPSHOT_ARRAYS}
        arrays |= {_IMAGE + name: image for name, image in state.further.items()}
        if self._model.config.past_images:
            # The codec of snapshots has no half floats.
            latents = state.kept.latents.view(np.uint16)
            arrays |= {"kept/latents": latents, "kept/reached": state.kept.reached}
            arrays |= {"kept/steps": np.array(state.kept.steps, dtype=np.int64)}
        return pack(fields, {**arrays, "anchor": np.stack(state.anchor.as_tuple())})

    def restore(self, data: bytes) -> JointWorldState:
        """Restore a snapshot; raises InvalidInputError for one of another checkpoint."""
        config = self._model.config
        max_bytes = config.num_views * predicted_world.MAX_SNAPSHOT_BYTES + kept_bytes(config)
        fields, arrays = predicted_world.opened_snapshot(data, self._digest, max_bytes=max_bytes)
        words, task = fields.get("instruction"), fields.get("task")
        counts: dict[str, Any] = {
            name: fields.get(name) for name in ("step", "num_still", "num_moving")
        }
        further: dict[str, np.ndarray] = {
            name: arrays.pop(_IMAGE + name)
            for name in config.further_views
            if _IMAGE + name in arrays
        }
        kept = _kept_of(arrays, config)
        if (
            kept is None
            or set(arrays) != set(_SNAPSHOT_ARRAYS)
            or not all(isinstance(one, int) and one >= 0 for one in counts.values())
            or not isinstance(words, str)
            or task not in self._description.tasks
            or fields.get("action_kind") not in ACTION_KINDS
            or arrays["anchor"].shape != (3, 4, 4)
            or arrays["still_m"].shape != (2, _NUM_WATCHED_POINTS, 3)
            or not np.isfinite(arrays["still_m"]).all()
        ):
            raise predicted_world.foreign_snapshot(fields, arrays)
        state = JointWorldState(
            image=arrays["image"],
            tactile_kpa=arrays["tactile_kpa"],
            reached=check_actions(arrays["reached"][None], where="snapshot")[0],
            anchor=AnchorPoses(*arrays["anchor"]),
            K_head=arrays["K_head"],
            instruction=words,
            action_kind=fields["action_kind"],
            task=str(task),
            still_m=arrays["still_m"],
            kept=kept,
            further=further,
            **counts,
        )
        self._check_chunk(state)
        return state

    def _check_chunk(self, state: JointWorldState) -> None:
        """The checks of a chunk, so that they fail before the first one."""
        holding = np.repeat(state.reached[None], self._description.chunk_multiple, axis=0)
        build_inputs(self._requests([state], [holding]), self._model.config)


def _check_reader(
    reader: predicted_world.SceneReader | None, metadata: checkpoints.CheckpointMetadata
) -> None:
    """Raise unless the reader knows the tasks and the glove of a model with contact geometry."""
    where = f"world model {metadata.name}: is conditioned on objects"
    known = () if reader is None else reader.tasks
    if reader is None or not set(metadata.tasks) <= set(known):
        raise InvalidInputError(
            f"{where}, got start readers for {sorted(known)}, expected a state model of "
            f"{sorted(metadata.tasks)}; name one by --objects"
        )
    got, expected = reader.tactile_layout, metadata.network.tactile_layout
    if got.fingerprint != expected.fingerprint:
        raise InvalidInputError(
            f"{where}, got start readers for the glove {described([got])}, expected those of "
            f"{described([expected])}; name a state model of this glove by --objects"
        )


def _watched_points(
    actions: np.ndarray, anchor: AnchorPoses
) -> Float32[np.ndarray, "steps 2 points 3"]:
    """Points of each hand, then of the head camera, in the world: none moves while all is still."""
    # Poses beyond single precision are infinite, which is refused elsewhere.
    with np.errstate(over="ignore"):
        motion = hand_motion(actions, anchor)
        camera_m = apply(motion.Ts_world_camera, _CAMERA_POINTS_M).astype(np.float32)
    return np.concatenate([motion.points_m, np.stack([camera_m, camera_m], axis=1)], axis=2)


def _kept_of(arrays: dict[str, np.ndarray], config: NetworkConfig) -> KeptImages | None:
    """Images kept in a snapshot, whose arrays are taken out; None if they are not as expected."""
    kept = KeptImages.none(config)
    if not config.past_images:
        return kept
    found = [arrays.pop(f"kept/{name}", None) for name in ("steps", "reached", "latents")]
    expected = [(np.dtype(np.int64), ()), (kept.reached.dtype, (67,))]
    expected.append((np.dtype(np.uint16), kept.latents.shape[1:]))
    num = 0 if found[0] is None else len(found[0])
    if num > MAX_KEPT or any(
        one is None or (one.dtype, one.shape) != (dtype, (num, *shape))
        for one, (dtype, shape) in zip(found, expected, strict=True)
    ):
        return None
    steps, reached, latents = (np.array(one) for one in found)
    return KeptImages(tuple(steps.tolist()), reached, latents.view(np.float16))


def _request(state: JointWorldState, chunk: np.ndarray, config: NetworkConfig) -> PredictionRequest:
    """Request for a chunk, re-anchored to the rollout's current poses."""
    actions = reanchor(np.concatenate([state.reached[None], chunk]), 0)
    return PredictionRequest(
        first_image=state.image,
        first_tactile_kpa=state.tactile_kpa,
        actions=actions,
        action_kind=state.action_kind,
        instruction=state.instruction,
        anchor=poses_from_actions(state.reached[None], state.anchor).anchor(0),
        K_head=state.K_head,
        further_images=tuple(state.further.get(name) for name in config.further_views),
        past=state.kept.before(state, actions, config),
    )


def _advance(
    state: JointWorldState,
    chunk: np.ndarray,
    imagined: tuple[dict[str, np.ndarray], np.ndarray],
    selector: ReturnSelector,
) -> SteppedRollout[JointWorldState]:
    """New state and requested outputs; the next chunk starts from the last commanded action."""
    images, tactile_kpa = imagined
    first = 0 if selector.steps == "all" else len(chunk) - 1
    observation = Observation(
        first_step=state.step + 1 + first,
        images={
            name: images[name][first - len(chunk) :]
            for name in asked_cameras(selector, (HEAD_CAMERA,))
        },
        tactile_kpa=tactile_kpa[first:],
        action_reached=chunk[first:],
        reached_is_measured=False,
    )
    following = replace(
        state,
        image=images[HEAD_CAMERA][-1],
        further={name: images[name][-1] for name in state.further},
        tactile_kpa=tactile_kpa[-1],
        reached=chunk[-1],
        step=state.step + len(chunk),
    )
    return SteppedRollout(following, observation)
