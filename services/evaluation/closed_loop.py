"""Closed-loop evaluation: rolls out policies in worlds from matched starts and scores them.

The real world starts each (task, seed) once for every policy; every imagined world starts from
exactly that first observation, anchor and camera. Real success is reported by the real world,
imagined success is the probe's decision on the last three steps. A failed rollout is recorded as a
failure, and the others continue.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy, PolicyStart, Rollout
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Observation, ReturnSelector, WorldDescription
from services.evaluation.demonstrations import CAMERA
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.policies.asking import action_chunk, ask
from services.evaluation.progress import Progress
from services.evaluation.scores import REAL, ClosedLoopReport, RolloutFailure, RolloutScore
from services.evaluation.starts import refuse_training_starts, start_digest
from services.evaluation.study_worlds import StudyWorlds, WorldAddress
from services.evaluation.success_probe import SuccessProbe

__all__ = ["EvaluationPlan", "MatchedStart", "WorldAddress", "evaluate", "matched_start"]

# Result of one rollout.
Outcome = RolloutScore | RolloutFailure


@dataclass(frozen=True)
class EvaluationPlan:
    """Tasks, seeds and length of an evaluation.

    `instructions` maps every task to its instruction; every rollout lasts `num_steps` steps of the
    model grid, whatever the length of a policy's chunks; `trained_on` maps each trained component
    (world model, policy, probe) to digests of its training starts, which the evaluation rejects.
    """

    instructions: Mapping[str, str]
    seeds: Sequence[int]
    num_steps: int = 80
    trained_on: Mapping[str, Iterable[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class MatchedStart:
    """A first observation of the real world from which every rollout starts."""

    task: str
    seed: int
    instruction: str
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]

    @property
    def digest(self) -> str:
        """Digest of image and touch."""
        return first_digest(self.observation)

    def for_policy(self) -> PolicyStart:
        """Information given to a policy before it acts."""
        return PolicyStart(self.task, self.instruction, self.seed, self.anchor, self.K_head)


def first_digest(observation: Observation) -> str:
    """Digest of the head camera's image and the touch of a first observation."""
    return start_digest(observation.images[CAMERA][0], observation.tactile_kpa[0])


def evaluate(
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: SuccessProbe,
    keep: Callable[[Outcome], None] | None = None,
) -> ClosedLoopReport:
    """Roll out every policy from every start in every world.

    Args:
        real: the world that reports success itself.
        imagined: worlds to compare with it, by their names in the report; may be empty.
        policies: by their names in the report.
        plan: tasks, seeds and length.
        probe: classifier of imagined success.
        keep: called with every outcome as soon as it is known.

    Returns:
        The scores, and the rollouts that failed with their errors.

    Raises:
        ConflictError: a start was trained on.
        UnknownNameError: unknown world or task.
        InvalidInputError: nothing to evaluate, or worlds that do not match each other or the plan.
        UnavailableError: a world cannot be reached at the beginning.
    """
    if not policies or not plan.instructions or not plan.seeds:
        raise InvalidInputError(
            f"evaluation: got {len(policies)} policies, {len(plan.instructions)} tasks and "
            f"{len(plan.seeds)} seeds; expected at least one of each"
        )
    worlds = StudyWorlds.ask(real, imagined)
    worlds.check(list(plan.instructions), plan.num_steps, probe.shape.image_size_px)
    starts = [
        _start(real, task, seed, instruction)
        for task, instruction in plan.instructions.items()
        for seed in plan.seeds
    ]
    digests = [start.digest for start in starts if isinstance(start, MatchedStart)]
    trained_on = {**plan.trained_on, "the success probe": probe.metadata.training_starts}
    for what, trained in trained_on.items():
        refuse_training_starts(digests, trained_on=trained, what=what)
    scores: list[RolloutScore] = []
    failures: list[RolloutFailure] = []
    study = _Study(worlds, policies, plan, probe)
    with Progress("rollouts", len(starts) * len(policies) * len(worlds.addresses)) as progress:
        for outcome in study.outcomes(starts):
            if keep is not None:
                keep(outcome)
            if isinstance(outcome, RolloutScore):
                scores.append(outcome)
            else:
                failures.append(outcome)
            progress.advance(failed=float(len(failures)))
    return ClosedLoopReport(tuple(scores), tuple(imagined), tuple(policies), tuple(failures))


@dataclass(frozen=True)
class _FailedStart:
    """A task and seed that the real world failed to start."""

    task: str
    seed: int
    error: DexTouchError


def _start(
    real: WorldAddress, task: str, seed: int, instruction: str
) -> MatchedStart | _FailedStart:
    try:
        return matched_start(real, task, seed, instruction)
    except DexTouchError as error:
        return _FailedStart(task, seed, error)


def _failure(
    error: DexTouchError, start: MatchedStart | _FailedStart, policy: str, world: str
) -> RolloutFailure:
    trace = error.details.get("traceback")
    return RolloutFailure(
        world=world,
        policy=policy,
        task=start.task,
        seed=start.seed,
        error=type(error).__name__,
        message=error.message,
        traceback=trace if isinstance(trace, str) else None,
    )


def matched_start(real: WorldAddress, task: str, seed: int, instruction: str) -> MatchedStart:
    """First observation of the real world for a task and seed, with all its cameras."""
    with real.client.start(
        world=real.world, task=task, seed=seed, instruction=instruction
    ) as rollout:
        return MatchedStart(
            task, seed, instruction, rollout.observation, rollout.anchor, rollout.K_head
        )


@dataclass(frozen=True)
class _Study:
    """Shared context of the rollouts of one evaluation."""

    worlds: StudyWorlds
    policies: Mapping[str, Policy]
    plan: EvaluationPlan
    probe: SuccessProbe

    def outcomes(self, starts: Iterable[MatchedStart | _FailedStart]) -> Iterator[Outcome]:
        """Outcomes of all rollouts, one after the other."""
        for start in starts:
            for policy in self.policies:
                for world in self.worlds.addresses:
                    yield self._outcome(start, policy, world)

    def _outcome(self, start: MatchedStart | _FailedStart, policy: str, world: str) -> Outcome:
        if isinstance(start, _FailedStart):
            return _failure(start.error, start, policy, world)
        try:
            return self._score(start, policy, world)
        except DexTouchError as error:
            return _failure(error, start, policy, world)

    def _score(self, start: MatchedStart, policy: str, world: str) -> RolloutScore:
        """Score one rollout; the probe decides where the world does not report success."""
        with self._begin(start, world) as rollout:
            ending = self._play(rollout, start, policy, world)
            success = rollout.observation.success if world == REAL else None
        verdict = self.probe.verdict(ending)
        return RolloutScore(
            world,
            policy,
            start.task,
            start.seed,
            start.digest,
            verdict.likely_success if success is None else success,
            verdict.probability,
            cannot_tell=None if success is not None else verdict.reason,
        )

    def _begin(self, start: MatchedStart, world: str) -> Rollout:
        """Start a rollout from a matched start (by task and seed in the real world).

        Raises:
            ConflictError: the real world started differently than before.
        """
        address = self.worlds.addresses[world]
        client = address.client.selecting(ReturnSelector(cameras=self.worlds.cameras))
        init = None if world == REAL else (start.observation, start.anchor, start.K_head)
        rollout = client.start(
            world=address.world,
            task=start.task,
            seed=start.seed,
            instruction=start.instruction,
            init=init,
        )
        first = rollout.observation
        if init is None and first_digest(first) != start.digest:
            rollout.close()
            raise ConflictError(
                f"world {address.world!r}: task {start.task!r} with seed {start.seed} began "
                "differently than before; matched starts need a deterministic world"
            )
        return rollout

    def _play(self, rollout: Rollout, start: MatchedStart, policy: str, world: str) -> Ending:
        """Run a policy in a rollout and return the last three steps."""
        actor, description = self.policies[policy], self.worlds.descriptions[world]
        where = f"policy {policy!r}, task {start.task!r}, seed {start.seed}"
        ask(actor.reset, start.for_policy(), where=f"{where}: reset")
        looks, cameras = getattr(actor, "looks", True), self.worlds.cameras
        while (left := self.plan.num_steps - rollout.info.last_step) > 0:
            acting = f"{where}, chunk {rollout.info.next_chunk}: act"
            answer = ask(actor.act, rollout.observation, where=acting)
            chunk = action_chunk(answer, description, where=acting)[:left]
            if looks == "last" and len(chunk) < left:
                shown = ReturnSelector(cameras=cameras, steps="last")
                rollout.step(chunk, selector=shown, validated=True)
            elif looks and looks != "last":
                rollout.step(chunk, validated=True)
            else:
                _step_unseen(rollout, chunk, left, description)
        last = rollout.observation
        if len(last) < NUM_SEEN_STEPS:
            raise InvalidInputError(
                f"{where}: the last chunk shows {len(last)} steps, expected at least "
                f"{NUM_SEEN_STEPS}; send longer chunks"
            )
        return Ending.of(last, start.task, imagined=world != REAL)


def _step_unseen(
    rollout: Rollout, chunk: np.ndarray, left: int, description: WorldDescription
) -> None:
    """Advance by a chunk but render only the rollout's ending, since images take most of the time.

    Args:
        rollout: rollout of a policy that ignores the steps before.
        chunk: actions to execute.
        left: steps to the end of the rollout, including this chunk.
        description: the world, which determines the chunk multiple.
    """
    multiple = description.chunk_multiple
    shown = -(-NUM_SEEN_STEPS // multiple) * multiple if len(chunk) == left else 0
    unseen = max(len(chunk) - shown, 0)
    if unseen:
        rollout.step(chunk[:unseen], selector=ReturnSelector(cameras=()), validated=True)
    if unseen < len(chunk):
        rollout.step(chunk[unseen:], validated=True)
