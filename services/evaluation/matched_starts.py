"""First observations of the real world from which every rollout of a comparison starts."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.clients import PolicyStart
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind, Observation
from dextouch.streams import HEAD_CAMERA
from services.evaluation.scores import RolloutFailure
from services.evaluation.study_worlds import WorldAddress

# Digests of first observations, which keep training and evaluation starts disjoint.


def start_digest(head_image: np.ndarray, tactile_kpa: np.ndarray) -> str:
    """SHA-256 of a first observation: head camera image [h, w, 3] and taxels [2, 320] in kPa.

    The same task and seed give the same first observation, so equal digests mean the same start.
    """
    image = np.ascontiguousarray(head_image, dtype=np.uint8)
    tactile = np.ascontiguousarray(tactile_kpa, dtype="<f4")
    if image.ndim != 3 or tactile.shape != (2, 320):
        raise InvalidInputError(
            f"start: got image {image.shape} and tactile {tactile.shape}, "
            "expected one image [h, w, 3] and [2, 320]"
        )
    digest = hashlib.sha256(repr((image.shape, tactile.shape)).encode())
    digest.update(image.tobytes())
    digest.update(tactile.tobytes())
    return digest.hexdigest()


def refuse_training_starts(digests: Iterable[str], *, trained_on: Iterable[str], what: str) -> None:
    """Raise if a start of the evaluation was trained on.

    Args:
        digests: digests of the evaluation's starts.
        trained_on: digests of the first observations of the training episodes.
        what: the trained network, for the error message.

    Raises:
        ConflictError: a start of the evaluation was trained on.
    """
    shared = sorted(set(digests) & set(trained_on))
    if shared:
        raise ConflictError(
            f"evaluation: {len(shared)} starts were trained on by {what}, first {shared[0][:12]}…; "
            "choose others, outside its training data",
            starts=shared,
        )


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


# Robot episodes with instructions, as every training of this service has them.


@runtime_checkable
class Instructed(Protocol):
    """Anything with a task and its instruction."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def instruction(self) -> str:
        """Instruction of the task."""


def instructions_of(demonstrations: Iterable[Instructed]) -> dict[str, str]:
    """Instruction of every task, from its first episode."""
    found: dict[str, str] = {}
    for item in demonstrations:
        found.setdefault(item.task, item.instruction)
    return found
