"""Networks of the demo, shipped or freshly trained, and the scoring of policies by them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dextouch.clients import Policy, RolloutClient
from dextouch.errors import DexTouchError
from dextouch.worlds import BatchWorld
from services.evaluation.bundled_policies import DEFAULT_POLICY
from services.evaluation.closed_loop import EvaluationPlan, evaluate, film
from services.evaluation.command_line import run_train_judge, run_train_policy
from services.evaluation.matched_starts import WorldAddress
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.reporting.pictures import PredictionPicture
from services.evaluation.scores import REAL, RolloutScore
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.success_classifier import SuccessClassifier
from services.pipelines import imagined_data, training_data
from services.pipelines.parsers import TASKS, DemoPlan
from services.pipelines.study import demonstrator
from services.twin.stage import ELSEWHERE, HOLD, RETREAT, script_name
from services.twin.tasks import get_task
from services.world_model.command_line import run_train
from services.world_model.world import open_world

MODEL = "world_model"
BASELINE = "copy-first"
LADDER = "position only"
DEMONSTRATIONS = ("--mix", "demonstrations")
# Exact demonstrations for the policy: seeds that nothing else uses, no noise, no misses.
EXACT_DATA = ("--first", "1000", "--count", "120", "--exact")
# Endings near the boundary of success for world model and probe, and others for evaluation.
ENDINGS = (
    "--ladder", "--first", "2000", "--count", "315",
    "--miss-fraction", "0.1", "--still-fraction", "0.1",
)  # fmt: skip
UNSEEN_ENDINGS = ("--ladder", "--first", "30000", "--count", "180")
# A small state model: one ensemble member, few steps.
SMALL_STATE_MODEL = (
    "--num-members=1", "--jobs=1", "--reader.num-steps=2500", "--core.num-steps=1500",
    "--drawing.cpu-budget-s=300",
)  # fmt: skip


@dataclass(frozen=True)
class Models:
    """State model and its checkpoint, closed-loop policy and probe."""

    world_model: BatchWorld[Any]
    checkpoint: Path
    policy: BehaviourCloningPolicy
    probe: SuccessClassifier

    @classmethod
    def load(
        cls, world_model: Path, policy: Path = DEFAULT_POLICY, probe: Path = DEFAULT_PROBE
    ) -> "Models":
        """Load the networks of files, policy and probe by default those of the package."""
        return cls(
            open_world(world_model),
            world_model,
            BehaviourCloningPolicy.load(policy),
            SuccessClassifier.load(probe),
        )


def train_models(folder: Path) -> Models:
    """Record training episodes and train a small state model, a policy and a success classifier.

    The probe is trained on true endings and on those imagined by the state model. The folder is for
    episodes, of which existing ones are reused, and checkpoints.
    """
    episodes, exact, endings, unseen, imagined = (
        str(folder / name) for name in ("episodes", "exact", "endings", "unseen", "imagined")
    )
    world_model = folder / "state.safetensors"
    policy, probe = folder / "behaviour_cloning.safetensors", folder / "success_probe.safetensors"
    scenes = f"--tasks={','.join(TASKS)}"
    steps: list[tuple[Callable[[list[str]], int], list[str]]] = [
        (training_data.main, ["--store", episodes, *DEMONSTRATIONS]),
        (training_data.main, ["--store", exact, *EXACT_DATA]),
        (training_data.main, ["--store", endings, *ENDINGS]),
        (training_data.main, ["--store", unseen, *UNSEEN_ENDINGS]),
        (run_train, [*_stores(episodes, endings, to=world_model), scenes, *SMALL_STATE_MODEL]),
        (run_train_policy, _stores(exact, episodes, to=policy)),
        (
            imagined_data.imagined_main,
            [*_stores(endings), "--store", imagined, "--checkpoint", str(world_model)],
        ),
        (run_train_judge, ["--held-out", unseen, *_stores(endings, imagined, to=probe)]),
    ]
    for step, words in steps:
        step(words)
    return Models.load(world_model, policy, probe)


def _stores(*stores: str, to: Path | None = None) -> list[str]:
    """Flags that name the stores to read, and the file to write."""
    flags = [word for store in stores for word in ("--episodes", store)]
    return flags if to is None else [*flags, "--output", str(to)]


def ladder(plan: DemoPlan) -> dict[str, Policy]:
    """Open-loop policies of graded quality.

    The scripted demonstrator with position errors, the same with other mistakes, and three that
    should fail: holding still, retreating, and the actions of another scene. The twin only plans
    the demonstrator's commands, without simulation.
    """
    names = (*_scripts(plan), *plan.mistakes, HOLD, RETREAT, ELSEWHERE)
    return {name: demonstrator(TASKS, plan.seeds, name) for name in names}


def _scripts(plan: DemoPlan) -> tuple[str, ...]:
    return tuple(script_name(level) for level in plan.levels_mm)


def score_policies(
    urls: Mapping[str, str], policies: Mapping[str, Policy], models: Models, plan: DemoPlan
) -> tuple[dict[str, Any], tuple[PredictionPicture, ...]]:
    """Roll out all policies from matched starts in the twin, the model and the copy baseline.

    Returns entries of `report.json`, and a pair of rollouts of every task to show.
    """
    twin, imagined = RolloutClient(urls["twin"]), RolloutClient(urls["imagined"])
    tasks = EvaluationPlan(
        instructions={task: get_task(task).instruction for task in TASKS},
        seeds=list(plan.seeds),
        trained_on={"the policy": models.policy.metadata.training_starts},
    )
    real, probe = WorldAddress(twin, "twin"), models.probe
    worlds = {name: WorldAddress(imagined, name) for name in (MODEL, BASELINE)}
    report = evaluate(real=real, imagined=worlds, policies=policies, plan=tasks, probe=probe)
    if report.failures:
        first = report.failures[0]
        raise DexTouchError(
            f"{len(report.failures)} of {len(report.rollouts)} rollouts failed, first "
            f"{first.policy!r} in {first.world!r}: {first.message}"
        )
    found = report.to_report()
    found["mistakes"] = mistake_rows(report.scores, plan)
    for task, comments in found["comments"].items():
        comments.append(mistake_comment(task, found["mistakes"]))
    return found, film(
        report, real=real, imagined=worlds, policies=policies, plan=tasks, probe=probe
    )


def mistake_rows(scores: Iterable[RolloutScore], plan: DemoPlan) -> list[dict[str, Any]]:
    """Real against imagined outcomes of the ladder of scripts, and of every mistake beside it."""
    known = {(s.world, s.task, s.policy, s.seed): s for s in scores}
    groups = {LADDER: _scripts(plan), **{name: (name,) for name in plan.mistakes}}
    rows = []
    for task in TASKS:
        for name, policies in groups.items():
            pairs = [
                (known[REAL, task, policy, seed], known[MODEL, task, policy, seed])
                for policy in policies
                for seed in plan.seeds
            ]
            rows.append(
                {
                    "task": task,
                    "mistake": name,
                    "rollouts": len(pairs),
                    "real": sum(real.success for real, _ in pairs),
                    "imagined": sum(imagined.success for _, imagined in pairs),
                    "wrong": sum(real.success != imagined.success for real, imagined in pairs),
                    "cannot_tell": sum(imagined.cannot_tell is not None for _, imagined in pairs),
                }
            )
    return rows


def mistake_comment(task: str, rows: Iterable[Mapping[str, Any]]) -> str:
    """How many rollouts of a task are judged wrongly, without and with mistakes."""
    mine = [row for row in rows if row["task"] == task]
    shares = []
    for is_ladder in (True, False):
        group = [row for row in mine if (row["mistake"] == LADDER) == is_ladder]
        wrong, rollouts = (sum(row[name] for row in group) for name in ("wrong", "rollouts"))
        shares.append(f"{wrong} of {rollouts}")
    names = ", ".join(row["mistake"] for row in mine if row["mistake"] != LADDER)
    return (
        f"Imagined outcomes differ from the real ones in {shares[0]} rollouts of scripts that err "
        f"in position only, and in {shares[1]} with mistakes of kinds that no training data "
        f"contain ({names})."
    )
