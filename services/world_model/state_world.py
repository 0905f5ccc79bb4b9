"""World of a state model: rollouts with a scene memory that persists across chunks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from torch.nn import functional

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, check_actions
from dextouch.schemas import (
    BOUND_SHARE,
    ActionKind,
    Observation,
    ReturnSelector,
    RolloutStart,
    Uncertainty,
    WorldDescription,
)
from dextouch.streams import HEAD_CAMERA, pack
from dextouch.worlds import StartedRollout, SteppedRollout
from services.world_model import predicted_world
from services.world_model.checkpoints import StateCheckpoint
from services.world_model.dynamics import features, model
from services.world_model.network import inputs
from services.world_model.network.configuration import NetworkConfig
from services.world_model.rendering.rasters import SceneStates
from services.world_model.rendering.renderer import Drawing, Renderer

# Pose reported for objects believed absent: below the table, where no task places one.
ABSENT_POSE = np.array([0.0, 0.0, -1.0, 1.0, 0.0, 0.0, 0.0], dtype=np.float32)
# A rollout is flagged once its hands have moved 1.5 times the length of a training episode.
UNRELIABLE_HORIZONS = 1.5
# Cosine of the same words in another order or with other punctuation.
_SAME_INSTRUCTION = 0.999


@dataclass(frozen=True)
class StateRollout:
    """State of a rollout: its start and the memory of its scene.

    `first_reached` is relative to `anchor`; `num_moving` counts latent steps in which hands moved.
    """

    task: str
    action_kind: ActionKind
    image: UInt8[np.ndarray, "h w 3"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    first_reached: Float64[np.ndarray, "67"]
    memory: model.SceneMemory
    step: int = 0
    num_moving: int = 0


class StateWorld(predicted_world.PredictedWorld[StateRollout]):
    """A deterministic world of a state model; raises InvalidInputError unless it is in float32."""

    def __init__(self, checkpoint: StateCheckpoint) -> None:
        others = {weight.dtype for weight in checkpoint.dynamics.parameters()} - {torch.float32}
        if others:
            raise InvalidInputError(
                f"state model {checkpoint.metadata.name}: got weights of "
                f"{', '.join(sorted(map(str, others)))}, expected float32"
            )
        self._dynamics = checkpoint.dynamics
        self._dynamics.trace()
        self._renderer = Renderer(checkpoint.renderer)
        self._metadata, self._digest = checkpoint.metadata, checkpoint.digest
        self._horizon_latents = self._metadata.bounds.horizon_latents
        config = self._metadata.dynamics
        self._instructions = features.instruction_features(config.instructions, config)
        self._description = WorldDescription(
            name=self._metadata.name,
            kind="model",
            digest=checkpoint.digest,
            tasks=config.tasks,
            cameras=(HEAD_CAMERA,),
            image_height_px=config.image_px,
            image_width_px=config.image_px,
            model_rate_hz=self._metadata.model_rate_hz,
            action_kinds=inputs.ACTION_KINDS,
            starts_from=("observation",),
            chunk_multiple=features.STEPS_PER_LATENT,
            object_names=self._metadata.object_names,
            scales_images=True,
            tactile_layout=config.layout,
        )

    @torch.inference_mode()
    def reset(self, start: RolloutStart) -> StartedRollout[StateRollout]:
        """Find the objects of an observed step; raises as `observed_start`, `build_inputs`."""
        first = predicted_world.observed_start(
            start,
            tasks=self._description.tasks,
            layout=self._metadata.dynamics.tactile_layout,
            image_px=self._metadata.dynamics.image_px,
        )
        self._check_start(start, first)
        motion = features.hand_motion(first.reached[None], first.anchor)
        task = self._description.tasks.index(start.task)
        memory = self._dynamics.begin(
            model.first_steps(
                [first.image],
                [first.K_head],
                [first.tactile_kpa],
                [motion],
                [task],
                self._metadata.dynamics.tactile_layout,
            ),
            torch.from_numpy(first.tactile_kpa)[None],
            features.Commands.holding([motion]),
            torch.tensor([float(start.action_kind == "commanded")]),
            features.instruction_features([start.instruction], self._metadata.dynamics),
        )
        rollout = StateRollout(
            task=start.task,
            action_kind=start.action_kind,
            image=first.image,
            anchor=first.anchor,
            K_head=first.K_head,
            first_reached=first.reached,
            memory=memory,
        )
        seen = first.observation(self._poses(memory.poses, start.task))
        return StartedRollout(rollout, seen, first.anchor, first.K_head)

    def _check_start(self, start: RolloutStart, first: predicted_world.ObservedStart) -> None:
        """Checks of all world models: hands and camera must be within reach."""
        predicted_world.check_geometry(first.anchor, first.K_head)
        request = inputs.PredictionRequest(
            first_image=first.image,
            first_tactile_kpa=first.tactile_kpa,
            actions=np.repeat(first.reached[None], 1 + features.STEPS_PER_LATENT, axis=0),
            action_kind=start.action_kind,
            instruction=start.instruction,
            anchor=first.anchor,
            K_head=first.K_head,
        )
        config = self._metadata.dynamics
        limits = NetworkConfig(image_px=config.image_px).with_layout(config.tactile_layout)
        inputs.build_inputs([request], limits)

    @torch.inference_mode()
    def _stepped(
        self,
        states: Sequence[StateRollout],
        chunks: list[np.ndarray],
        _: Sequence[int],
        requested: list[ReturnSelector],
    ) -> list[SteppedRollout[StateRollout]]:
        for chunk in chunks:
            inputs.check_reach(chunk)
        motions = [
            features.hand_motion(chunk, state.anchor, validated=True)
            for chunk, state in zip(chunks, states, strict=True)
        ]
        memory = model.batched([state.memory for state in states])
        following, imagined = self._dynamics.advance(memory, features.Commands.of(motions))
        checked = {
            "touch": imagined.tactile_kpa,
            "objects' place": imagined.poses.position_m,
            "objects' direction": imagined.poses.axes,
        }
        predicted_world.refuse_non_finite("state model", checked)
        answers = [
            self._answer(
                replace(
                    state,
                    memory=model.memory_of(following, index),
                    step=state.step + len(chunks[index]),
                    num_moving=state.num_moving + int(imagined.moves[index].sum()),
                ),
                chunks[index],
                (imagined, index),
                requested[index],
            )
            for index, state in enumerate(states)
        ]
        images = iter(self._renderer.draw_all([drawing for _, drawing in answers if drawing]))
        return [
            stepped
            if drawing is None
            else replace(
                stepped,
                observation=replace(stepped.observation, images={HEAD_CAMERA: next(images)}),
            )
            for stepped, drawing in answers
        ]

    def _answer(
        self,
        state: StateRollout,
        chunk: np.ndarray,
        imagined: tuple[model.ImaginedSteps, int],
        selector: ReturnSelector,
    ) -> tuple[SteppedRollout[StateRollout], Drawing | None]:
        """The chunk's observation without images, and what to draw if images are requested."""
        steps, index = imagined
        poses, bounds = self._poses(steps.poses[index], state.task), self._metadata.bounds
        uncertainty = self._uncertainty(state, steps, index)
        # The largest figure as a share of its bound; above 1 it is outside.
        bound_share = max(
            state.num_moving / (UNRELIABLE_HORIZONS * bounds.horizon_latents),
            uncertainty.disagreement / max(bounds.disagreement_m, 1e-9),
            uncertainty.distance / bounds.latent_distance,
        )
        observation = Observation(
            first_step=state.step - len(chunk) + 1,
            images={},
            tactile_kpa=steps.tactile_kpa[index].numpy().copy(),
            action_reached=chunk,
            reached_is_measured=False,
            object_poses=poses,
            uncertainty=uncertainty,
        ).selected(selector)
        drawing = None
        if selector.wants(HEAD_CAMERA):
            shown = slice(len(chunk) - len(observation), None)
            drawing = self._drawing(state, chunk[shown], poses[shown])
        return SteppedRollout(state, observation, {BOUND_SHARE: bound_share}), drawing

    def _drawing(
        self, state: StateRollout, actions: np.ndarray, poses: Float32[np.ndarray, "n objects 7"]
    ) -> Drawing:
        actions = np.concatenate([state.first_reached[None], actions])
        first = self._poses(model.mean_poses(state.memory.start.objects), state.task)
        poses = np.concatenate([first, poses])
        present = poses[..., 2] > ABSENT_POSE[2]
        states = SceneStates.of_actions(actions, state.anchor, poses, present, validated=True)
        boxes_m = np.array(self._metadata.object_boxes_m[state.task])
        size = state.memory.start.size.mean(0)[0, : len(boxes_m)].double().numpy()
        boxes_m = boxes_m * size[:, features.BOX_AXES]
        return Drawing(state.image, state.K_head, states, boxes_m)

    def _uncertainty(
        self, state: StateRollout, steps: model.ImaginedSteps, index: int
    ) -> Uncertainty:
        """`distance` is of the hands' motion alone, and no part uses the readers' own `sd_m`."""
        bounds = self._metadata.bounds
        # Of the worst latent step, independent of the chunk length.
        disagreement_m = float(steps.disagreement_m[index].max())
        distance = float(steps.distance[index].max())
        count = len(self._metadata.object_names[state.task])
        seen = state.memory.start.objects.present[..., :count]
        found = bool((seen > model.PRESENCE_THRESHOLD).all())
        reason = None
        if state.num_moving > UNRELIABLE_HORIZONS * bounds.horizon_latents:
            reason = "hands moved longer than in any episode of training"
        elif not found:
            reason = "an object of the task was not found at the start, or not by all members"
        elif disagreement_m > bounds.disagreement_m:
            reason = (
                f"members disagree by {1e3 * disagreement_m:.0f} mm about an object, more than "
                f"{1e3 * bounds.disagreement_m:.0f} mm"
            )
        elif distance > bounds.latent_distance:
            times = distance / bounds.latent_distance
            reason = f"hands are {times:.1f} times as far from training as allowed"
        elif not self._knows_instruction(state):
            reason = "the instruction is none of training"
        # Of movable objects, as a share of the usual size.
        movable = self._dynamics.core.movable[self._description.tasks.index(state.task)]
        deviations = (state.memory.start.size.mean(0)[0] - 1.0).abs() * movable[:, None]
        success = steps.success[:, index, -1]
        return Uncertainty(
            disagreement=disagreement_m,
            distance=distance,
            outside=reason is not None,
            reason=reason,
            success_probability=float(success.logit(1e-6).mean().sigmoid()),
            success_spread=float(success.max() - success.min()),
            size_deviation=float(deviations.max()),
        )

    def _knows_instruction(self, state: StateRollout) -> bool:
        cosines = functional.cosine_similarity(
            self._instructions, state.memory.start.instruction[0], dim=1
        )
        return not self._instructions.numel() or float(cosines.max()) > _SAME_INSTRUCTION

    def _poses(
        self, objects: features.ObjectPoses, task: str
    ) -> Float32[np.ndarray, "n objects 7"]:
        """Poses of the task's objects; absent ones lie below the table."""
        used = objects.slots(len(self._metadata.object_names[task]))
        poses = features.poses_from_objects(used).astype(np.float32)
        there = used.present.numpy() > model.PRESENCE_THRESHOLD
        return np.where(there[..., None], poses, ABSENT_POSE)

    def snapshot(self, state: StateRollout) -> bytes:
        """Serialize the state for `restore` with the same checkpoint."""
        names = ("task", "action_kind", "step", "num_moving")
        fields = {"digest": self._digest, **{name: getattr(state, name) for name in names}}
        arrays = {
            "image": state.image,
            "anchor": np.stack(state.anchor.as_tuple()),
            "K_head": state.K_head,
            "first_reached": state.first_reached,
        }
        return pack(fields, {**arrays, **model.memory_arrays(state.memory)})

    def restore(self, data: bytes) -> StateRollout:
        """Restore a snapshot; raises InvalidInputError or NonFiniteError for another's."""
        fields, arrays = predicted_world.opened_snapshot(data, self._digest)
        config, name = self._metadata.dynamics, fields.get("task")
        step, moving = fields.get("step"), fields.get("num_moving")
        size = (config.image_px, config.image_px, 3)
        shapes = {"image": size, "anchor": (3, 4, 4), "K_head": (3, 3), "first_reached": (67,)}
        if (
            name not in config.tasks
            or fields.get("action_kind") not in inputs.ACTION_KINDS
            or not (isinstance(step, int) and isinstance(moving, int) and min(step, moving) >= 0)
            or arrays.get("image", np.zeros(0)).dtype != np.uint8
            or any(key not in arrays or arrays[key].shape != shapes[key] for key in shapes)
        ):
            raise predicted_world.foreign_snapshot(fields, arrays)
        anchor, K_head = AnchorPoses(*np.array(arrays["anchor"])), np.array(arrays["K_head"])
        predicted_world.check_geometry(anchor, K_head)
        memory = model.memory_from_arrays(arrays, config, self._metadata.num_members)
        if int(memory.start.task[0, 0]) != config.tasks.index(name):
            raise InvalidInputError(f"snapshot: its memory belongs to another task than {name!r}")
        first_reached = check_actions(arrays["first_reached"][None], where="snapshot")
        inputs.check_reach(first_reached)
        return StateRollout(
            task=name,
            action_kind=fields["action_kind"],
            image=arrays["image"],
            anchor=anchor,
            K_head=K_head,
            first_reached=first_reached[0],
            memory=memory,
            step=step,
            num_moving=moving,
        )
