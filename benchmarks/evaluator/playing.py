"""One policy in the twin, and in an imagined world from the same first observation."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from benchmarks.evaluator.plan import NUM_STEPS
from dextouch.clients import Policy, PolicyStart
from dextouch.hands.actions import poses_from_actions, reanchor
from dextouch.schemas import (
    CHUNK_STEPS,
    Observation,
    ReturnSelector,
    RolloutStart,
    RolloutUncertainty,
    rollout_uncertainty,
)
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import StartedRollout, State, World
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.policies.outside import action_chunk, ask
from services.twin.scripted_actions import Actions
from services.twin.world import TwinState, TwinWorld

_NO_IMAGES = ReturnSelector(cameras=())
_LAST_IMAGE = ReturnSelector(steps="last")


@dataclass(frozen=True)
class TrueRollout:
    """Rollout of a policy in the twin.

    Chunk ends are steps 16, 32 … 80. `actions` are what was sent, relative to step 0;
    `object_poses` T_world_object at step 0 and the chunk ends. `images_of_chunks` are those at the
    chunk ends, or none.
    """

    success: bool
    actions: Actions
    tactile_kpa: Float32[np.ndarray, "81 2 320"]
    images_of_chunks: UInt8[np.ndarray, "chunks h w 3"]
    last_images: UInt8[np.ndarray, "3 h w 3"]
    object_poses: Float64[np.ndarray, "ends objects 7"]


@dataclass(frozen=True)
class ImaginedRollout:
    """Imagined rollout of the same policy, with the world's uncertainty of all of it."""

    tactile_kpa: Float32[np.ndarray, "81 2 320"]
    images_of_chunks: UInt8[np.ndarray, "chunks h w 3"]
    last_images: UInt8[np.ndarray, "3 h w 3"]
    object_poses: Float32[np.ndarray, "3 objects 7"] | None
    uncertainty: RolloutUncertainty

    def ending(self, task: str) -> Ending:
        """What the judge sees of it."""
        return Ending(
            self.last_images,
            self.tactile_kpa[-NUM_SEEN_STEPS:],
            task,
            self.object_poses,
            imagined=True,
        ).with_uncertainty(self.uncertainty)


def play_in_twin(
    twin: TwinWorld,
    started: StartedRollout[TwinState],
    policy: Policy | Actions,
    start: PolicyStart,
    *,
    shows_chunks: bool = True,
) -> TrueRollout:
    """Let a policy, in closed loop or as the commands of all steps, act in the twin from its start.

    A closed-loop policy is told `start`; `shows_chunks` keeps images at the ends of chunks.
    """
    stage, state = twin.stage(start.task), started.state
    touch, sent = [started.observation.tactile_kpa], []
    poses, images = [stage_poses(twin, state)], []
    seen = started.observation
    looks = _begin(policy, start)
    for first in range(0, NUM_STEPS, CHUNK_STEPS):
        chunk = _chunk(policy, seen, first, twin)
        shows_end = looks == "last" or first + CHUNK_STEPS == NUM_STEPS
        head = CHUNK_STEPS - 4 if shows_end else CHUNK_STEPS
        # Images are slow, so only those that are used are rendered.
        selector = ReturnSelector() if looks == "all" else _NO_IMAGES
        step = twin.step(state, chunk[:head], seed=start.seed, selector=selector)
        parts = [step]
        if shows_end:
            parts.append(twin.step(step.state, chunk[head:], seed=start.seed))
        touch.extend(part.observation.tactile_kpa for part in parts)
        state, seen = parts[-1].state, parts[-1].observation
        if shows_chunks:
            images.append(stage.rig.image(stage.simulation, HEAD_CAMERA))
        poses.append(stage.simulation.object_poses())
        sent.append(chunk)
    return TrueRollout(
        bool(seen.success),
        np.concatenate(sent),
        np.concatenate(touch),
        _stacked(images, seen),
        seen.images[HEAD_CAMERA][-NUM_SEEN_STEPS:],
        np.stack(poses),
    )


def stage_poses(twin: TwinWorld, state: TwinState) -> Float64[np.ndarray, "objects 7"]:
    """Object poses of a state."""
    simulation = twin.stage(state.task).simulation
    simulation.set_state(state.physics, step_index=0)
    return simulation.object_poses()


def play_in_imagination(
    world: World[State],
    first: RolloutStart,
    policy: Policy | Actions,
    start: PolicyStart,
    *,
    shows_chunks: bool = True,
) -> ImaginedRollout:
    """Let a policy act in an imagined world; if it uses images, it observes imagined ones.

    Policy, start and images as in `play_in_twin`.
    """
    started = world.reset(first)
    state, seen = started.state, started.observation
    touch, images = [seen.tactile_kpa], []
    looks = _begin(policy, start)
    shown: list[Observation] = []
    for at in range(0, NUM_STEPS, CHUNK_STEPS):
        chunk = _chunk(policy, seen, at, world)
        if looks == "all" or at + CHUNK_STEPS == NUM_STEPS:
            step = last = world.step(state, chunk, seed=start.seed + at)
        else:
            # A world is functional: two calls give touch of all steps and only the last image.
            step = last = world.step(state, chunk, seed=start.seed + at, selector=_NO_IMAGES)
            if shows_chunks or looks == "last":
                last = world.step(state, chunk, seed=start.seed + at, selector=_LAST_IMAGE)
        if shows_chunks:
            images.append(last.observation.images[HEAD_CAMERA][-1])
        state, seen = step.state, last.observation
        touch.append(step.observation.tactile_kpa)
        shown.append(seen)
    poses = seen.object_poses
    return ImaginedRollout(
        np.concatenate(touch),
        _stacked(images, seen),
        seen.images[HEAD_CAMERA][-NUM_SEEN_STEPS:],
        None if poses is None else poses[-NUM_SEEN_STEPS:],
        rollout_uncertainty(shown),
    )


def _stacked(images: list[np.ndarray], seen: Observation) -> UInt8[np.ndarray, "chunks h w 3"]:
    return np.stack(images) if images else seen.images[HEAD_CAMERA][:0]


def _begin(policy: Policy | Actions, start: PolicyStart) -> Literal["no", "last", "all"]:
    """Reset a closed-loop policy, and return which steps of a chunk it needs images of."""
    if isinstance(policy, np.ndarray):
        return "no"
    ask(policy.reset, start, where="policy: reset")
    looks = getattr(policy, "looks", True)
    return "last" if looks == "last" else "all" if looks else "no"


def _chunk(
    policy: Policy | Actions, seen: Observation, first: int, world: World[State]
) -> Float64[np.ndarray, "16 67"]:
    if isinstance(policy, np.ndarray):
        return policy[first : first + CHUNK_STEPS]
    where = f"policy, step {first}: act"
    answer = ask(policy.act, seen, where=where)
    return action_chunk(answer, world.description, where=where)[:CHUNK_STEPS]


def start_amid(
    first: RolloutStart,
    image: UInt8[np.ndarray, "h w 3"],
    tactile_kpa: Float32[np.ndarray, "2 320"],
    reached: Float64[np.ndarray, "67"],
) -> RolloutStart:
    """A start from a later step of a rollout, with what is seen and felt at that step.

    The action that the hands have reached is relative to the start of the rollout, `first`.
    """
    if first.anchor is None:
        raise ValueError("the twin gives an anchor with every start")
    observation = Observation(
        first_step=0,
        images={HEAD_CAMERA: image[None]},
        tactile_kpa=tactile_kpa[None],
        action_reached=reanchor(reached[None], 0),
        reached_is_measured=True,
    )
    anchor = poses_from_actions(reached[None], first.anchor).anchor(0)
    return replace(first, observation=observation, anchor=anchor)


def start_in_twin(
    twin: TwinWorld, task: str, seed: int, instruction: str
) -> tuple[StartedRollout[TwinState], RolloutStart, PolicyStart]:
    """Start of a rollout in the twin, and the same start for an imagined world and a policy."""
    asked = RolloutStart(task=task, seed=seed, instruction=instruction)
    started = twin.reset(asked)
    imagined = replace(
        asked, observation=started.observation, anchor=started.anchor, K_head=started.K_head
    )
    return started, imagined, PolicyStart(task, instruction, seed, started.anchor, started.K_head)
