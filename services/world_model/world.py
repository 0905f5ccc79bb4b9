"""World of a flow-matching checkpoint: predicts observations chunk by chunk."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from dextouch.errors import InvalidInputError
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
from services.world_model.network.configuration import GloveNetworkConfig, Precision, Sampler
from services.world_model.network.inputs import ACTION_KINDS, PredictionRequest, build_inputs
from services.world_model.network.model import Sampling, stack_noise
from services.world_model.network.video import WanVideoCodec, to_uint8, to_unit
from services.world_model.settings import Placement
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld

MAX_SNAPSHOT_BYTES = 4 * 2**20
_SNAPSHOT_ARRAYS = ("image", "tactile_kpa", "reached", "anchor", "K_head")


@dataclass(frozen=True)
class ModelState(starts.ObservedStart):
    """State of a rollout: its last step; `reached` is relative to `anchor`, the poses of step 0."""

    instruction: str
    action_kind: ActionKind
    step: int
    task: str


class ModelWorld(BatchWorld[ModelState]):
    """A flow-matching model as a world.

    Without `sampling`, the checkpoint's is used. `precision` is that of the experts' matrix
    products; codecs are float32. With contact geometry, `reader` finds objects at a chunk's start.

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
            UnavailableError: the model returned NaN or infinity.
        """
        requested = starts.checked_selectors(states, actions, seeds, selectors)
        chunks = [starts.checked_chunk(chunk, self._description) for chunk in actions]
        requests = self._requests(states, chunks)
        inputs = build_inputs(requests, self._model.config)
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
        futures = zip(images, touches, strict=True)
        each = zip(states, chunks, futures, requested, strict=True)
        return [_advance(*one) for one in each]

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
        names = ("instruction", "action_kind", "step", "task")
        fields = {"digest": self._digest, **{name: getattr(state, name) for name in names}}
        arrays = {name: getattr(state, name) for name in _SNAPSHOT_ARRAYS}
        return pack(fields, {**arrays, "anchor": np.stack(state.anchor.as_tuple())})

    def restore(self, data: bytes) -> ModelState:
        """Restore the state of a snapshot.

        Raises:
            InvalidInputError: not a snapshot of this checkpoint.
        """
        fields, arrays = starts.opened_snapshot(data, self._digest, max_bytes=MAX_SNAPSHOT_BYTES)
        step, words, task = fields.get("step"), fields.get("instruction"), fields.get("task")
        if (
            set(arrays) != set(_SNAPSHOT_ARRAYS)
            or not isinstance(step, int)
            or not isinstance(words, str)
            or task not in self._description.tasks
            or fields.get("action_kind") not in ACTION_KINDS
            or arrays["anchor"].shape != (3, 4, 4)
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
            step=step,
            task=str(task),
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
    sampling_steps: int | None = None,
    sampler: Sampler | None = None,
    needs_touch: bool = True,
    objects: Path | None = None,
    placement: Placement = Placement(),  # noqa: B008 - immutable
) -> ModelWorld | StateWorld:
    """Open the world of a checkpoint file of either kind; default: the package's own.

    Args:
        path: safetensors file; None for the one that ships with the package.
        sampling_steps: network calls per chunk of a flow-matching model; a state model has none.
        sampler: solver of a flow-matching model.
        objects: state model that reads objects for contact geometry; None for the package's own.
        needs_touch: refuse a model that does not predict touch, in which policies feel nothing.
        placement: device and precision of a flow-matching model.

    Raises:
        InvalidInputError: sampling steps or a sampler for a state model, or no touch where it is
            needed.
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
        return ModelWorld(checkpoint, sampling=Sampling(sampling_steps, sampler), reader=reader)
    if sampling_steps is not None or sampler is not None:
        raise InvalidInputError(
            f"state model {file.name}: got {sampling_steps} sampling steps and the sampler "
            f"{sampler}, expected none: it predicts without sampling"
        )
    return StateWorld(checkpoints.read_state_checkpoint(file))


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
    on_device(model, placement.device)
    if isinstance(model.codec, WanVideoCodec):
        model.codec.window, model.codec.tile_px = placement.decode_window, placement.decode_tile_px
    elif placement.decode_window or placement.decode_tile_px:
        raise InvalidInputError(
            f"world model {file.name}: got options of decoding (--placement.decode-window, "
            "--placement.decode-tile-px), expected none: only the full size has them"
        )
    if model.text_features is not None:
        model.text_features.use(placement.text.folder, placement.text.text_cache)
    return checkpoint


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
