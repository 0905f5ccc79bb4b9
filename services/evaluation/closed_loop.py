"""Closed-loop evaluation: rolls out policies in worlds from matched starts and scores them.

The real world starts each (task, seed) once for every policy; every imagined world starts from
exactly that first observation, anchor and camera. Real success is reported by the real world,
imagined success is the probe's decision on the last three steps. A failed rollout is recorded as a
failure, and the others continue.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from dextouch.clients import Policy
from dextouch.errors import InvalidInputError
from services.evaluation.matched_starts import (
    FailedStart,
    MatchedStart,
    refuse_training_starts,
    try_matched_start,
)
from services.evaluation.progress import Progress
from services.evaluation.rollout_runner import RolloutRunner
from services.evaluation.scores import ClosedLoopReport, Outcome, RolloutFailure, RolloutScore
from services.evaluation.study_worlds import StudyWorlds, WorldAddress
from services.evaluation.success_classifier import SuccessClassifier


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


def evaluate(
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: SuccessClassifier,
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
    starts = begin_matched(real, plan, probe)
    scores: list[RolloutScore] = []
    failures: list[RolloutFailure] = []
    runner = RolloutRunner(worlds, probe, plan.num_steps)
    cells = list(itertools.product(starts, policies, worlds.addresses))
    with Progress("rollouts", len(cells)) as progress:
        for start, policy, world in cells:
            outcome = runner.outcome(start, policies[policy], policy, world)
            if keep is not None:
                keep(outcome)
            if isinstance(outcome, RolloutScore):
                scores.append(outcome)
            else:
                failures.append(outcome)
            progress.advance(failed=float(len(failures)))
    return ClosedLoopReport(tuple(scores), tuple(imagined), tuple(policies), tuple(failures))


def begin_matched(
    real: WorldAddress, plan: EvaluationPlan, probe: SuccessClassifier
) -> list[MatchedStart | FailedStart]:
    """Start every task and seed once in the real world.

    Raises:
        ConflictError: a start was trained on.
    """
    starts = [
        try_matched_start(real, task, seed, instruction)
        for task, instruction in plan.instructions.items()
        for seed in plan.seeds
    ]
    digests = [start.digest for start in starts if isinstance(start, MatchedStart)]
    trained_on = {**plan.trained_on, "the success classifier": probe.metadata.training_starts}
    for what, trained in trained_on.items():
        refuse_training_starts(digests, trained_on=trained, what=what)
    return starts
