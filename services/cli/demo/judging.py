"""Scoring of policies of different quality in the real and the imagined world."""

from collections.abc import Mapping
from typing import Any

from dextouch.clients import Policy, RolloutClient
from dextouch.errors import DexTouchError
from services.cli.demo.models import Models, refuse_trained
from services.cli.demo.settings import TASKS, DemoPlan
from services.evaluation.closed_loop import EvaluationPlan, WorldAddress, evaluate
from services.evaluation.policies.replay import ReplayPolicy
from services.twin.scripted_actions import ELSEWHERE, HOLD, RETREAT, script_name, scripted_actions
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task

MODEL = "world_model"
BASELINE = "copy-first"


def ladder(plan: DemoPlan) -> dict[str, Policy]:
    """Open-loop policies of graded quality.

    The scripted demonstrator with errors, and three that should fail: holding still, retreating,
    and the actions of another scene. The twin only plans the demonstrator's commands, without
    simulation.
    """
    stages = {task: Stage(task, "robot", TwinSettings()) for task in TASKS}
    names = (*(script_name(level) for level in plan.levels_mm), HOLD, RETREAT, ELSEWHERE)
    return {
        name: ReplayPolicy(
            {
                (task, seed): scripted_actions(stage, seed, name, plan.levels_mm)
                for task, stage in stages.items()
                for seed in plan.seeds
            }
        )
        for name in names
    }


def judge(
    urls: Mapping[str, str], policies: Mapping[str, Policy], models: Models, plan: DemoPlan
) -> dict[str, Any]:
    """Roll out all policies from matched starts in the twin, the model and the copy baseline.

    Args:
        urls: URLs of the services `twin` and `imagined`.
        policies: policies by name.
        models: with the success probe; training scenes are excluded.
        plan: plan of the run, with the seeds.

    Returns:
        `policies`, `agreement` and other entries of `report.json`.

    Raises:
        DexTouchError: a rollout failed.
    """
    refuse_trained(models.training_seeds, plan.seeds)
    twin, imagined = RolloutClient(urls["twin"]), RolloutClient(urls["imagined"])
    tasks = EvaluationPlan(
        instructions={task: get_task(task).instruction for task in TASKS},
        seeds=list(plan.seeds),
        trained_on={"the policy": models.policy.metadata.training_starts},
    )
    report = evaluate(
        real=WorldAddress(twin, "twin"),
        imagined={
            MODEL: WorldAddress(imagined, MODEL),
            BASELINE: WorldAddress(imagined, BASELINE),
        },
        policies=policies,
        plan=tasks,
        probe=models.probe,
    )
    if report.failures:
        first = report.failures[0]
        raise DexTouchError(
            f"{len(report.failures)} of {len(report.rollouts)} rollouts failed, first "
            f"{first.policy!r} in {first.world!r}: {first.message}"
        )
    return report.to_report()
