"""`train-policy`, `train-probe` or `run` and flags in; a checkpoint or a scored evaluation out."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.schemas.rollouts import ReturnSelector
from services.evaluation.checkpoints import Checkpoint, save_checkpoint
from services.evaluation.closed_loop import EvaluationPlan, WorldAddress, evaluate
from services.evaluation.demonstrations import CAMERA, read_demonstrations
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.cloning_training import train_cloned_policy
from services.evaluation.policies.hold import HoldPolicy
from services.evaluation.policies.replay import ReplayPolicy
from services.evaluation.reporting import ReportPictures, write_report
from services.evaluation.reporting.sections import figure
from services.evaluation.settings import (
    RunSettings,
    ServedWorld,
    TrainPolicySettings,
    TrainProbeSettings,
    command_line,
    parse,
)
from services.evaluation.success_probe import SuccessProbe
from services.evaluation.success_probe_training import train_success_probe

USAGE = """usage: evaluation train-policy|train-probe|run [flags]

  train-policy   imitate the successful robot episodes of a store
  train-probe    learn to tell success from the last images and touch
  run            roll policies out in a real and in imagined worlds, and score both

Flags: evaluation COMMAND --help"""
EXIT_USAGE = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status, 2 for a word that is none."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str]], int]] = {
        "train-policy": run_train_policy,
        "train-probe": run_train_probe,
        "run": run_evaluation,
    }
    word, *rest = arguments or ["--help"]
    if word in {"-h", "--help"}:
        print(USAGE)
        return 0
    if word not in commands:
        print(f"evaluation: unknown command {word!r}\n\n{USAGE}", file=sys.stderr)
        return EXIT_USAGE
    return commands[word](rest)


def run_train_policy(arguments: list[str]) -> int:
    """Train the cloned policy and keep it."""
    settings = parse(TrainPolicySettings, arguments)
    stores = [EpisodeStore(url) for url in settings.episodes]
    demonstrations = read_demonstrations(*stores, tasks=settings.tasks)
    command = command_line("train-policy", arguments)
    checkpoint = train_cloned_policy(demonstrations, settings.training, command=command)
    return _keep(checkpoint, settings.output, settings.json_path)


def run_train_probe(arguments: list[str]) -> int:
    """Train the success probe and keep it."""
    settings = parse(TrainProbeSettings, arguments)
    stores = [EpisodeStore(url) for url in settings.episodes]
    demonstrations = read_demonstrations(*stores, tasks=settings.tasks)
    command = command_line("train-probe", arguments)
    checkpoint = train_success_probe(demonstrations, settings.training, command=command)
    return _keep(checkpoint, settings.output, settings.json_path)


def _keep(checkpoint: Checkpoint, output: Path, json_path: Path | None) -> int:
    save_checkpoint(output, checkpoint)
    print(f"{output}  {output.stat().st_size / 1e6:.2f} MB")
    for name, value in checkpoint.metadata.metrics.items():
        print(f"  {name:<45} {value:.4g}")
    _write_json(json_path, {"checkpoint": str(output), "metrics": checkpoint.metadata.metrics})
    return 0


def run_evaluation(arguments: list[str]) -> int:
    """Score every policy in every world; the figures go to the terminal and the asked files."""
    settings = parse(RunSettings, arguments)
    probe = SuccessProbe.load(settings.probe)
    cloned = BehaviourCloningPolicy.load(settings.policy)
    instructions = probe.metadata.settings["instructions"]
    plan = EvaluationPlan(
        {task: instructions[task] for task in settings.tasks or probe.metadata.tasks},
        settings.seed_range(),
        settings.num_chunks,
        trained_on={"the cloned policy": cloned.metadata.training_starts},
    )
    scripts = {
        name: ReplayPolicy.of(read_demonstrations(EpisodeStore(url), tasks=settings.tasks))
        for name, url in settings.scripts.items()
    }
    report = evaluate(
        real=_address(settings.real),
        imagined={name: _address(world) for name, world in settings.imagined.items()},
        policies={**scripts, "behaviour-cloning": cloned, "hold": HoldPolicy()},
        plan=plan,
        probe=probe,
    ).to_report()
    _print_scores(report)
    _write_json(settings.json_path, report)
    if settings.html is not None:
        write_report(report, ReportPictures(), settings.html)
    return 0


def _address(world: ServedWorld) -> WorldAddress:
    selector = ReturnSelector(cameras=(CAMERA,))
    return WorldAddress(RolloutClient(world.url, world.api_key, selector=selector), world.world)


def _print_scores(report: Mapping[str, Any]) -> None:
    print(f"{'task':<16}{'policy':<22}{'real':>6}{'imagined':>10}")
    for row in report["policies"]:
        print(f"{row['task']:<16}{row['policy']:<22}{row['real']:>6.2f}{row['imagined']:>10.2f}")
    for task, figures in report["agreement"].items():
        print(
            f"\n{task}: Pearson {figure(figures['pearson'])}, MMRV {figure(figures['mmrv'])} "
            f"with ties counted, {figure(figures['mmrv_paper'])} by the paper's rule"
        )
        for comment in report["comments"][task]:
            print(f"  {comment}")


def _write_json(path: Path | None, content: Mapping[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
