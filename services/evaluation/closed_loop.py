"""Worlds, policies and matched starts in; success in every world and their agreement out.

The real world begins each (task, seed) once for every policy; every imagined world begins from
exactly that first observation, anchor and camera. Real success is what the real world says,
imagined success what the probe says about the last three steps.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from dextouch.clients.policy import Policy, PolicyStart
from dextouch.clients.rollouts import Rollout, RolloutClient
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.rollouts import Observation
from services.evaluation.demonstrations import CAMERA
from services.evaluation.progress import Progress
from services.evaluation.scores import REAL, ClosedLoopReport, RolloutScore
from services.evaluation.starts import refuse_training_starts, start_digest
from services.evaluation.success_probe import (
    DECISION_THRESHOLD,
    NUM_SEEN_STEPS,
    Ending,
    SuccessProbe,
)


@dataclass(frozen=True)
class WorldAddress:
    """Where a world is served, and what it is called there."""

    client: RolloutClient
    world: str


@dataclass(frozen=True)
class EvaluationPlan:
    """What is rolled out.

    `instructions` maps every task to its sentence; `trained_on` maps what was trained (world
    model, policy, probe) to digests of its training starts, none of which may be judged on.
    """

    instructions: Mapping[str, str]
    seeds: Sequence[int]
    num_chunks: int = 5
    trained_on: Mapping[str, Iterable[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class MatchedStart:
    """A first observation of the real world that every rollout begins from."""

    task: str
    seed: int
    instruction: str
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]

    @property
    def digest(self) -> str:
        """Digest of image and touch."""
        return start_digest(self.observation.images[CAMERA][0], self.observation.tactile_kpa[0])

    def for_policy(self) -> PolicyStart:
        """What a policy is told before it acts."""
        return PolicyStart(self.task, self.instruction, self.seed, self.anchor, self.K_head)


def evaluate(
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: SuccessProbe,
) -> ClosedLoopReport:
    """Roll every policy out from every start in every world.

    Args:
        real: the world that judges success itself.
        imagined: worlds to compare with it, by the name they have in the report.
        policies: by the name they have in the report.
        plan: tasks, seeds and length.
        probe: judge of imagined success.

    Raises:
        ConflictError: a start that something was trained on, or a real world that does not begin
            a task and seed the same way twice.
        InvalidInputError: nothing to evaluate, or a real world that does not judge success.
    """
    if not imagined or not policies or not plan.instructions or not plan.seeds:
        raise InvalidInputError(
            f"evaluation: got {len(imagined)} imagined worlds, {len(policies)} policies, "
            f"{len(plan.instructions)} tasks and {len(plan.seeds)} seeds; expected one of each"
        )
    starts = [
        matched_start(real, task, seed, instruction)
        for task, instruction in plan.instructions.items()
        for seed in plan.seeds
    ]
    trained_on = {**plan.trained_on, "the success probe": probe.metadata.training_starts}
    for what, digests in trained_on.items():
        refuse_training_starts((s.digest for s in starts), trained_on=digests, what=what)
    scores: list[RolloutScore] = []
    with Progress("rollouts", len(starts) * len(policies) * (1 + len(imagined))) as progress:
        for start in starts:
            for name, policy in policies.items():
                ending, success = _real_ending(real, start, policy, plan)
                probability = probe.probability(ending)
                scores.append(_score(REAL, name, start, probability, success=success))
                progress.advance()
                for world, address in imagined.items():
                    ending = _imagined_ending(address, start, policy, plan)
                    probability = probe.probability(ending)
                    scores.append(_score(world, name, start, probability))
                    progress.advance()
    return ClosedLoopReport(tuple(scores), tuple(imagined), tuple(policies))


def _score(
    world: str,
    policy: str,
    start: MatchedStart,
    probability: float,
    *,
    success: bool | None = None,
) -> RolloutScore:
    """A score; where the world does not tell, the probe decides."""
    decided = probability >= DECISION_THRESHOLD if success is None else success
    return RolloutScore(world, policy, start.task, start.seed, start.digest, decided, probability)


def matched_start(real: WorldAddress, task: str, seed: int, instruction: str) -> MatchedStart:
    """How the real world begins a task and seed, as far as the head camera and the hands see."""
    with real.client.start(
        world=real.world, task=task, seed=seed, instruction=instruction
    ) as rollout:
        first = rollout.observation
        if CAMERA not in first.images:
            raise UnknownNameError("camera", CAMERA, list(first.images))
        seen = replace(first, images={CAMERA: first.images[CAMERA]})
        return MatchedStart(task, seed, instruction, seen, rollout.anchor, rollout.K_head)


def _real_ending(
    real: WorldAddress, start: MatchedStart, policy: Policy, plan: EvaluationPlan
) -> tuple[Ending, bool]:
    with real.client.start(
        world=real.world, task=start.task, seed=start.seed, instruction=start.instruction
    ) as rollout:
        first = rollout.observation
        if start_digest(first.images[CAMERA][0], first.tactile_kpa[0]) != start.digest:
            raise ConflictError(
                f"world {real.world!r}: task {start.task!r} with seed {start.seed} began "
                "differently than before; matched starts need a world that repeats itself"
            )
        ending = play(rollout, policy, start, num_chunks=plan.num_chunks)
        success = rollout.observation.success
    if success is None:
        raise InvalidInputError(
            f"world {real.world!r} does not judge success; expected one that does, such as the twin"
        )
    return ending, success


def _imagined_ending(
    imagined: WorldAddress, start: MatchedStart, policy: Policy, plan: EvaluationPlan
) -> Ending:
    with imagined.client.start(
        world=imagined.world,
        task=start.task,
        seed=start.seed,
        instruction=start.instruction,
        init=(start.observation, start.anchor, start.K_head),
    ) as rollout:
        return play(rollout, policy, start, num_chunks=plan.num_chunks)


def play(rollout: Rollout, policy: Policy, start: MatchedStart, *, num_chunks: int) -> Ending:
    """Let a policy act in a rollout; what is seen in its last three steps.

    Raises:
        InvalidInputError: chunks too short to show three steps.
    """
    policy.reset(start.for_policy())
    observation = rollout.observation
    for _ in range(num_chunks):
        observation = rollout.step(policy.act(observation))
    if len(observation) < NUM_SEEN_STEPS:
        raise InvalidInputError(
            f"rollout in {start.task!r}: the last chunk shows {len(observation)} steps, "
            f"expected at least {NUM_SEEN_STEPS}"
        )
    return Ending(
        observation.images[CAMERA][-NUM_SEEN_STEPS:],
        observation.tactile_kpa[-NUM_SEEN_STEPS:],
        start.task,
    )
