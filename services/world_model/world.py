"""World of a flow-matching checkpoint: predicts observations chunk by chunk."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from dextouch.errors import InvalidInputError
from dextouch.geometry import apply
from dextouch.hands.actions import AnchorPoses, check_actions, poses_from_actions, reanchor
from dextouch.schemas import (
    ActionKind,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
)
from dextouch.streams import HEAD_CAMERA, pack
from dextouch.tactile.layout import described
from dextouch.worlds import BatchWorld, StartedRollout, SteppedRollout
from services.networks.weight_files import on_device
from services.world_model import checkpoints, starts
from services.world_model.devices import claimed_device
from services.world_model.dynamics.features import FREE_KPA, NUM_POINTS, hand_motion
from services.world_model.dynamics.model import REST_LATENTS, Stillness, stillness
from services.world_model.network.attention import split_axis
from services.world_model.network.configuration import (
    FRAMES_PER_LATENT,
    GloveNetworkConfig,
    Precision,
)
from services.world_model.network.inputs import ACTION_KINDS, PredictionRequest, build_inputs
from services.world_model.network.model import Sampling, stack_noise
from services.world_model.network.video import WanVideoCodec, to_uint8, to_unit
from services.world_model.settings import Placement
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld

MAX_SNAPSHOT_BYTES = 4 * 2**20
_SNAPSHOT_ARRAYS = ("image", "tactile_kpa", "reached", "anchor", "K_head", "still_m")
_SNAPSHOT_FIELDS = ("instruction", "action_kind", "step", "task", "num_still", "num_moving")
# Points on the axes of the head camera, so that it counts as still only if it does not turn either.
_CAMERA_POINTS_M = np.concatenate([np.zeros((1, 3)), np.eye(3)])
_NUM_WATCHED_POINTS = NUM_POINTS + len(_CAMERA_POINTS_M)


@dataclass(frozen=True)
class ModelState(starts.ObservedStart):
    """State of a rollout: its last step; `reached` is relative to `anchor`, the poses of step 0.

    `still_m` are points of hands and camera when they last moved, `num_still` the latent steps
    since then, and `num_moving` all those with motion.
    """

    instruction: str
    action_kind: ActionKind
    step: int
    task: str
    still_m: Float32[np.ndarray, "2 points 3"]
    num_still: int
    num_moving: int = 0


class ModelWorld(BatchWorld[ModelState]):
    """A flow-matching model as a world.

    Without `sampling`, the checkpoint's is used. `precision` is that of the experts' matrix
    products; codecs are float32. With contact geometry, `reader` finds objects at a chunk's start.

    A scene is at rest in chunks without motion that follow two seconds without motion, or a start
    at which the hands touch nothing: it stays as it is, bit for bit, without the network.

    Raises:
        InvalidInputError: a model with contact geometry, and no reader of all its tasks and of the
            layout of its glove.
    """

    def __init__(
        self,
        checkpoint: checkpoints.Checkpoint,
        *,
        sampling: Sampling | None = None,
        precision: Precision = "float32",
        reader: starts.SceneReader | None = None,
    ) -> None:
        self._model = checkpoint.model
        self._digest = checkpoint.digest
        self._sampling = sampling
        self._precision: Precision = precision
        config, metadata = checkpoint.metadata.network, checkpoint.metadata
        self._horizon_latents = metadata.horizon_latents
        self._reader = reader if config.use_contact_geometry else None
        if config.use_contact_geometry:
            _check_reader(reader, checkpoint.metadata)
        self._description = WorldDescription(
            name=metadata.name,
            kind="model",
            digest=checkpoint.digest,
            tasks=metadata.tasks,
            cameras=(HEAD_CAMERA,),
            image_height_px=config.image_px,
            image_width_px=config.image_px,
            model_rate_hz=config.model_rate_hz,
            action_kinds=ACTION_KINDS,
            starts_from=("observation",),
            max_chunk_steps=config.max_steps - 1,
            predicts_touch=config.use_touch,
            tactile_layout=(
                config.tactile_layout if isinstance(config, GloveNetworkConfig) else None
            ),
        )

    @property
    def description(self) -> WorldDescription:
        """Capabilities and limits of this world."""
        return self._description

    def reset(self, start: RolloutStart) -> StartedRollout[ModelState]:
        """Start a rollout from one observed step.

        Raises:
            UnknownNameError: a task or action kind that the model was not trained on.
            InvalidInputError: missing or invalid observation, anchor or K_head; an instruction that
                the full size neither knows nor can encode.
        """
        first = starts.observed_start(
            start, tasks=self._description.tasks, layout=self._model.config.tactile_layout
        )
        state = ModelState(
            **vars(first),
            instruction=start.instruction,
            action_kind=start.action_kind,
            step=0,
            task=start.task,
            still_m=_watched_points(first.reached[None], first.anchor)[0],
            num_still=REST_LATENTS * int(first.tactile_kpa.max() < FREE_KPA),
        )
        if self._model.text_features is not None:
            self._model.text_features.of(start.instruction)
        self._check_chunk(state)
        return StartedRollout(state, first.observation(), first.anchor, first.K_head)

    def step_batch(
        self,
        states: Sequence[ModelState],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[ModelState]]:
        """Predict action chunks of 4k ≤ 16 steps; others of the batch change results by rounding.

        The last image is always decoded, since the next chunk starts from it; the others only on
        request, which at full size may change the last one by rounding.

        Raises:
            ShapeError: a chunk of another length.
            InvalidInputError: physically impossible actions.
            EndedError: hands or camera have moved four times as long as any episode of training.
            UnavailableError: the model returned NaN or infinity.
        """
        requested = starts.checked_selectors(states, actions, seeds, selectors)
        for state in states:
            starts.refuse_ended(state.num_moving, self._horizon_latents, self._description)
        chunks = [starts.checked_chunk(chunk, self._description) for chunk in actions]
        still = _stillness(states, chunks)
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
                images, touch = (
                    np.stack([o] * len(chunk)) for o in (state.image, state.tactile_kpa)
                )
                future = images, touch
            else:
                future = next(futures)
            stepped.append(_advance(following, chunk, future, requested[index]))
        return stepped

    def _futures(
        self, asked: Sequence[tuple[ModelState, np.ndarray, int, ReturnSelector]]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Predicted images, maybe the last only, and touch of each chunk."""
        if not asked:
            return []
        states, chunks, seeds, requested = zip(*asked, strict=True)
        inputs = build_inputs(self._requests(states, chunks), self._model.config)
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        noise = stack_noise([self._model.noise(inputs.num_steps, each) for each in generators])
        wanted = any(one.steps == "all" and one.wants(HEAD_CAMERA) for one in requested)
        future = self._model.predict(
            inputs, noise, sampling=self._sampling, all_images=wanted, precision=self._precision
        )
        starts.refuse_non_finite(
            "world model", {"image": future.images, "touch": future.tactile_kpa}
        )
        images, touches = to_uint8(future.images).cpu().numpy(), future.tactile_kpa.cpu().numpy()
        return list(zip(images, touches, strict=True))

    def _requests(
        self, states: Sequence[ModelState], chunks: Sequence[np.ndarray]
    ) -> list[PredictionRequest]:
        """Requests for the chunks, with the objects as they are seen at the first step."""
        requests = [_request(state, chunk) for state, chunk in zip(states, chunks, strict=True)]
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

    def snapshot(self, state: ModelState) -> bytes:
        """Serialize the state for `restore` with the same checkpoint."""
        fields = {name: getattr(state, name) for name in _SNAPSHOT_FIELDS}
        fields |= {"digest": self._digest}
        arrays = {name: getattr(state, name) for name in _SNAPSHOT_ARRAYS}
        return pack(fields, {**arrays, "anchor": np.stack(state.anchor.as_tuple())})

    def restore(self, data: bytes) -> ModelState:
        """Restore the state of a snapshot.

        Raises:
            InvalidInputError: not a snapshot of this checkpoint.
        """
        fields, arrays = starts.opened_snapshot(data, self._digest, max_bytes=MAX_SNAPSHOT_BYTES)
        words, task = fields.get("instruction"), fields.get("task")
        counts: dict[str, Any] = {
            name: fields.get(name) for name in ("step", "num_still", "num_moving")
        }
        if (
            set(arrays) != set(_SNAPSHOT_ARRAYS)
            or not all(isinstance(one, int) and one >= 0 for one in counts.values())
            or not isinstance(words, str)
            or task not in self._description.tasks
            or fields.get("action_kind") not in ACTION_KINDS
            or arrays["anchor"].shape != (3, 4, 4)
            or arrays["still_m"].shape != (2, _NUM_WATCHED_POINTS, 3)
            or not np.isfinite(arrays["still_m"]).all()
        ):
            raise starts.foreign_snapshot(fields, arrays)
        state = ModelState(
            image=arrays["image"],
            tactile_kpa=arrays["tactile_kpa"],
            reached=check_actions(arrays["reached"][None], where="snapshot")[0],
            anchor=AnchorPoses(*arrays["anchor"]),
            K_head=arrays["K_head"],
            instruction=words,
            action_kind=fields["action_kind"],
            task=str(task),
            still_m=arrays["still_m"],
            **counts,
        )
        self._check_chunk(state)
        return state

    def _check_chunk(self, state: ModelState) -> None:
        """The checks of a chunk, so that they fail before the first one."""
        holding = np.repeat(state.reached[None], self._description.chunk_multiple, axis=0)
        build_inputs(self._requests([state], [holding]), self._model.config)


def open_world(
    path: Path | None = None,
    *,
    sampling: Sampling = Sampling(),  # noqa: B008 - immutable
    needs_touch: bool = True,
    objects: Path | None = None,
    placement: Placement = Placement(),  # noqa: B008 - immutable
) -> ModelWorld | StateWorld:
    """Open the world of a checkpoint file of either kind; default: the package's own.

    Args:
        path: safetensors file; None for the one that ships with the package.
        sampling: of a flow-matching model; a state model predicts without.
        objects: state model that reads objects for contact geometry; None for the package's own.
        needs_touch: refuse a model that does not predict touch, in which policies feel nothing.
        placement: device and precision of a flow-matching model.

    Raises:
        InvalidInputError: options of sampling for a state model, guidance for a model that was
            trained without dropout, or no touch where it is needed.
    """
    file = path if path is not None else default_checkpoint()
    if not checkpoints.is_state_checkpoint(file):
        checkpoint = _placed(file, placement)
        if needs_touch and not checkpoint.metadata.network.use_touch:
            raise InvalidInputError(
                f"world model {file.name}: got one that predicts images alone, expected touch, "
                "too; only `dextouch evaluate prediction` accepts it"
            )
        reader = None
        if checkpoint.metadata.network.use_contact_geometry:
            reader = starts.SceneReader(
                checkpoints.read_state_checkpoint(objects or default_checkpoint())
            )
        if sampling.guidance != 1.0:
            _check_guidance(checkpoint, sampling.guidance, file)
        return ModelWorld(checkpoint, sampling=sampling, reader=reader)
    if sampling != Sampling():
        raise InvalidInputError(
            f"state model {file.name}: got {sampling}, expected none: it predicts without sampling"
        )
    return StateWorld(checkpoints.read_state_checkpoint(file))


def _check_guidance(checkpoint: checkpoints.Checkpoint, guidance: float, file: Path) -> None:
    """Raise unless the model can predict without instruction and actions."""
    metadata, texts = checkpoint.metadata, checkpoint.model.text_features
    if not metadata.is_guidable:
        raise InvalidInputError(
            f"world model {file.name}: got a guidance of {guidance:g}, expected 1: it was trained "
            f"without instruction in {metadata.text_dropout:.0%} of windows and without actions in "
            f"{metadata.action_dropout:.0%}; train with both --windows.text-dropout and "
            "--windows.action-dropout"
        )
    if texts is not None:
        # Predictions without instruction need its features.
        texts.of("")


def _check_reader(
    reader: starts.SceneReader | None, metadata: checkpoints.CheckpointMetadata
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


def _placed(file: Path, placement: Placement) -> checkpoints.Checkpoint:
    """The checkpoint on its device and in its precision."""
    limit = placement.max_file_gb
    checkpoint = checkpoints.read_checkpoint(
        file, max_bytes=None if limit is None else int(limit * 1e9)
    )
    model = checkpoint.model
    if placement.precision == "bfloat16":
        model.to(torch.bfloat16)
    on_device(model, claimed_device(placement.device))
    if isinstance(model.codec, WanVideoCodec):
        model.codec.window, model.codec.tile_px = placement.decode_window, placement.decode_tile_px
    elif placement.decode_window or placement.decode_tile_px:
        raise InvalidInputError(
            f"world model {file.name}: got options of decoding (--placement.decode-window, "
            "--placement.decode-tile-px), expected none: only the full size has them"
        )
    if model.text_features is not None:
        model.text_features.use(placement.text.folder, placement.text.text_cache)
    if placement.kept_contexts:
        model.keep_contexts(placement.kept_contexts)
    return checkpoint


def _watched_points(
    actions: np.ndarray, anchor: AnchorPoses
) -> Float32[np.ndarray, "steps 2 points 3"]:
    """Points of each hand, then of the head camera, in the world: none moves while all is still."""
    # Poses beyond single precision are infinite, which is refused elsewhere.
    with np.errstate(over="ignore"):
        motion = hand_motion(actions, anchor)
        camera_m = apply(motion.Ts_world_camera, _CAMERA_POINTS_M).astype(np.float32)
    return np.concatenate([motion.points_m, np.stack([camera_m, camera_m], axis=1)], axis=2)


def _stillness(states: Sequence[ModelState], chunks: Sequence[np.ndarray]) -> Stillness:
    """Latent steps of the chunks in which hands or camera move, and which are at rest."""
    each = zip(states, chunks, strict=True)
    commanded_m = np.stack([_watched_points(chunk, state.anchor) for state, chunk in each])
    return stillness(
        torch.from_numpy(np.stack([state.still_m for state in states])),
        torch.tensor([state.num_still for state in states]),
        split_axis(torch.from_numpy(commanded_m), 1, (-1, FRAMES_PER_LATENT)),
    )


def _request(state: ModelState, chunk: np.ndarray) -> PredictionRequest:
    """Request for a chunk, re-anchored to the rollout's current poses."""
    rows = np.concatenate([state.reached[None], chunk])
    return PredictionRequest(
        first_image=state.image,
        first_tactile_kpa=state.tactile_kpa,
        actions=reanchor(rows, 0),
        action_kind=state.action_kind,
        instruction=state.instruction,
        anchor=poses_from_actions(state.reached[None], state.anchor).anchor(0),
        K_head=state.K_head,
    )


def _advance(
    state: ModelState,
    chunk: np.ndarray,
    imagined: tuple[np.ndarray, np.ndarray],
    selector: ReturnSelector,
) -> SteppedRollout[ModelState]:
    """New state and requested outputs, from predicted images (maybe the last only) and touch.

    The model predicts no poses: the next chunk starts from the last commanded action.
    """
    images, tactile_kpa = imagined
    first = 0 if selector.steps == "all" else len(chunk) - 1
    observation = Observation(
        first_step=state.step + 1 + first,
        images={HEAD_CAMERA: images[first - len(chunk) :]} if selector.wants(HEAD_CAMERA) else {},
        tactile_kpa=tactile_kpa[first:],
        action_reached=chunk[first:],
        reached_is_measured=False,
    )
    following = replace(
        state,
        image=images[-1],
        tactile_kpa=tactile_kpa[-1],
        reached=chunk[-1],
        step=state.step + len(chunk),
    )
    return SteppedRollout(following, observation)
