"""Served worlds and policies in; their scores in the real and the imagined world, out."""

from collections.abc import Mapping
from typing import Any

from dextouch.clients.policy import Policy
from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError
from services.cli.demo.models import Models
from services.cli.demo.settings import TASKS, DemoPlan
from services.evaluation.closed_loop import EvaluationPlan, WorldAddress, evaluate
from services.evaluation.demonstrations import read_demonstration
from services.evaluation.policies.replay import ReplayPolicy
from services.twin.tasks import get_task

MODEL = "world_model"
BASELINE = "copy-first"


def ladder(store: EpisodeStore, episode_ids: Mapping[float, list[str]]) -> dict[str, Policy]:
    """The scripted demonstrator at each noise level, as policies that replay its commands."""
    return {
        f"scripted, {noise_m * 1e3:.0f} mm off": ReplayPolicy.of(
            read_demonstration(store.open(episode_id)) for episode_id in ids
        )
        for noise_m, ids in episode_ids.items()
    }


def judge(
    urls: Mapping[str, str], policies: Mapping[str, Policy], models: Models, plan: DemoPlan
) -> dict[str, Any]:
    """Roll all policies out from matched starts in the twin, the model and the copy baseline.

    Args:
        urls: of the services `twin` and `imagined`.
        policies: by name.
        models: the probe judges imagined success; what they were trained on is never judged on.
        plan: seeds.

    Returns:
        `policies`, `agreement` and the rest, as `report.json` holds them.

    Raises:
        DexTouchError: a rollout failed.
    """
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
