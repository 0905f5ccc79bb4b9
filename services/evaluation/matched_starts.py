"""First observations of the real world from which every rollout of a comparison starts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.clients import PolicyStart
from dextouch.errors import DexTouchError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind, Observation
from dextouch.streams import HEAD_CAMERA
from services.evaluation.scores import RolloutFailure
from services.evaluation.starts import start_digest
from services.evaluation.study_worlds import WorldAddress


@dataclass(frozen=True)
class MatchedStart:
    """A first observation of the real world from which every rollout starts.

    `action_kind` is that of the actions that imagined worlds are sent.
    """

    task: str
    seed: int
    instruction: str
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    action_kind: ActionKind = "commanded"

    @property
    def digest(self) -> str:
        """Digest of image and touch."""
        return first_digest(self.observation)

    def for_policy(self) -> PolicyStart:
        """Information given to a policy before it acts."""
        return PolicyStart(self.task, self.instruction, self.seed, self.anchor, self.K_head)


@dataclass(frozen=True)
class FailedStart:
    """A task and seed that the real world failed to start."""

    task: str
    seed: int
    error: DexTouchError


def first_digest(observation: Observation) -> str:
    """Digest of the head camera's image and the touch of a first observation."""
    return start_digest(observation.images[HEAD_CAMERA][0], observation.tactile_kpa[0])


def matched_start(real: WorldAddress, task: str, seed: int, instruction: str) -> MatchedStart:
    """First observation of the real world for a task and seed, with all its cameras."""
    with real.client.start(
        world=real.world, task=task, seed=seed, instruction=instruction
    ) as rollout:
        return MatchedStart(
            task, seed, instruction, rollout.observation, rollout.anchor, rollout.K_head
        )


def try_matched_start(
    real: WorldAddress, task: str, seed: int, instruction: str
) -> MatchedStart | FailedStart:
    """`matched_start`, or why the real world refused it."""
    try:
        return matched_start(real, task, seed, instruction)
    except DexTouchError as error:
        return FailedStart(task, seed, error)


def rollout_failure(
    error: DexTouchError,
    start: MatchedStart | FailedStart,
    policy: str,
    world: str,
    repeat: int = 0,
) -> RolloutFailure:
    """A failed rollout with its reason."""
    trace = error.details.get("traceback")
    return RolloutFailure(
        world=world,
        policy=policy,
        task=start.task,
        seed=start.seed,
        error=type(error).__name__,
        message=_printable(error.message),
        traceback=_printable(trace) if isinstance(trace, str) else None,
        repeat=repeat,
    )


def _printable(text: str) -> str:
    """Text of a policy's error without lone surrogates, which JSON readers refuse."""
    return text.encode("utf-8", "replace").decode()
