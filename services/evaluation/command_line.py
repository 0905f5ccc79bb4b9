"""Commands of the evaluation: train policies and probes, and score policies."""

import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from textwrap import indent
from typing import Any

from dextouch.clients import Policy, RolloutClient
from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore, Split, select_episodes
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.free_text import printable
from dextouch.serving import load_settings
from services.evaluation.bundled_policies import bundled_policy, training_starts_of
from services.evaluation.closed_loop import EvaluationPlan, ResultLog, evaluate, film
from services.evaluation.endings import EndingEpisode, read_ending_episodes
from services.evaluation.matched_starts import WorldAddress
from services.evaluation.policies.cloning_training import read_cloning_episodes, train_cloned_policy
from services.evaluation.policies.open_loop import ReplayPolicy
from services.evaluation.policies.user_policies import load_policies
from services.evaluation.rendering import rendered
from services.evaluation.reporting import write_report
from services.evaluation.reporting.pictures import ReportPictures
from services.evaluation.reporting.sections import failure_rows, undecided_note
from services.evaluation.settings import (
    DEFAULT_PROBE,
    PACKAGE,
    RunSettings,
    ServedWorld,
    TrainJudgeSettings,
    TrainPolicySettings,
    command_line,
)
from services.evaluation.success_classifier import KIND, SuccessClassifier
from services.evaluation.success_classifier_training import (
    calibrate_success_classifier,
    train_success_classifier,
)
from services.evaluation.trained_networks import Checkpoint, load_checkpoint, save_checkpoint

EXIT_FAILED = 1


def run_train_policy(arguments: list[str]) -> int:
    """Train the cloned policy and save it, optionally with an early checkpoint."""
    settings = load_settings(TrainPolicySettings, arguments)
    stores = [EpisodeStore(url) for url in settings.episodes]
    episodes = read_cloning_episodes(
        *stores, tasks=settings.tasks, splits=settings.splits, image_px=settings.image_px
    )
    if settings.imagined:
        generated = [EpisodeStore(url) for url in settings.imagined]
        episodes += read_cloning_episodes(
            *generated, tasks=settings.tasks, image_px=settings.image_px, imagined=True
        )
    finished, early = train_cloned_policy(
        episodes,
        settings.training,
        command=command_line("policy", arguments),
        early_at=settings.early_at,
    )
    if early is not None:
        keep(early, settings.output.with_stem(f"{settings.output.stem}_early"), None)
    return keep(finished, settings.output, settings.json_path)


def run_train_judge(arguments: list[str]) -> int:
    """Train the success classifier and save it."""
    settings = load_settings(TrainJudgeSettings, arguments)

    def read(urls: Sequence[str], splits: Sequence[Split] = settings.splits) -> list[EndingEpisode]:
        stores = [EpisodeStore(url) for url in urls]
        if not stores:
            return []
        return read_ending_episodes(
            *stores, tasks=settings.tasks, splits=splits, image_px=settings.image_px
        )

    if settings.base is not None:
        if settings.held_out:
            raise InvalidInputError(
                f"train judge --base: got --held-out {','.join(settings.held_out)}, expected none: "
                "the figures of the base's weights are kept"
            )
        calibrated = calibrate_success_classifier(
            load_checkpoint(
                DEFAULT_PROBE if settings.base == PACKAGE else settings.base, kind=KIND
            ),
            [*read(settings.episodes), *read(settings.development)],
            settings.training,
            command=command_line("judge", arguments),
        )
        return keep(calibrated, settings.output, settings.json_path)
    checkpoint = train_success_classifier(
        read(settings.episodes),
        settings.training,
        command=command_line("judge", arguments),
        development=read(settings.development),
        held_out=read(settings.held_out, ()),
        jobs=settings.jobs,
    )
    return keep(checkpoint, settings.output, settings.json_path)


def keep(checkpoint: Checkpoint, output: Path, json_path: Path | None) -> int:
    """Write a checkpoint, and its figures if wanted; print both."""
    save_checkpoint(output, checkpoint)
    print(f"{output}  {output.stat().st_size / 1e6:.2f} MB")
    for name, value in checkpoint.metadata.metrics.items():
        print(f"  {name:<45} {value:.4g}")
    figures = {"checkpoint": str(output), "metrics": checkpoint.metadata.metrics}
    write_result(json_path, figures, allow_nan=False)
    return 0


def run_evaluation(arguments: list[str]) -> int:
    """Score every policy in every world; print the results and write the requested files.

    Returns 1 if a rollout failed, otherwise 0.
    """
    settings = load_settings(RunSettings, arguments)
    probe = SuccessClassifier.load(settings.probe)
    policies, trained_on = gather_policies(settings)
    plan = EvaluationPlan(
        instructions_for(settings.tasks, probe.metadata.settings["instructions"]),
        settings.seed_range(),
        settings.num_steps,
        trained_on=trained_on,
    )
    log = ResultLog(settings.results_path())
    with ExitStack() as connections:
        real = opened(settings.real, connections)
        imagined = {n: opened(world, connections) for n, world in settings.imagined.items()}
        report = evaluate(
            real=real, imagined=imagined, policies=policies, plan=plan, probe=probe, keep=log.keep
        )
        figures = report.to_report()
        write_result(settings.json_path, figures, allow_nan=False)
        if settings.html is not None:
            moving = film(
                report, real=real, imagined=imagined, policies=policies, plan=plan, probe=probe
            )
            write_report(figures, ReportPictures(moving=moving), settings.html)
    print_scores(figures)
    print_failures(figures, log.path)
    return EXIT_FAILED if report.failures else 0


def gather_policies(settings: RunSettings) -> tuple[dict[str, Policy], dict[str, Sequence[str]]]:
    """All requested policies by name, and the training starts of bundled ones; `load_policies`."""
    policies = load_policies(
        settings.policy,
        settings.policy_arguments,
        [*settings.scripts, *settings.builtin],
        other_option="--scripts NAME=STORE",
    )
    for name, url in settings.scripts.items():
        found = select_episodes(
            [EpisodeStore(url)], domain="robot", tasks=settings.tasks, origins=()
        )
        policies[name] = ReplayPolicy.of(found)
    trained_on: dict[str, Sequence[str]] = {}
    for name in settings.builtin:
        given = settings.cloned_policy if name == "behaviour-cloning" else None
        policies[name] = bundled_policy(name, given)
        if starts := training_starts_of(policies[name]):
            trained_on[f"policy {name!r}"] = starts
    return policies, trained_on


def instructions_for(tasks: Sequence[str], known: Mapping[str, str]) -> dict[str, str]:
    """Instructions of the given tasks, or of all known tasks if none is given.

    Raises UnknownNameError for a task that the success classifier does not know.
    """
    for task in tasks:
        if task not in known:
            raise UnknownNameError("task of the success classifier", task, list(known))
    return {task: known[task] for task in tasks or known}


def opened(world: ServedWorld, connections: ExitStack) -> WorldAddress:
    """A connection to a served world, which ends with `connections`."""
    client = connections.enter_context(RolloutClient(world.url, world.api_key))
    return WorldAddress(client, world.world)


def print_scores(report: Mapping[str, Any]) -> None:
    """Print success rates, of how many decided rollouts, and agreement of a report."""
    print(rendered("scores.txt.j2", report=report, undecided_note=undecided_note), end="")


def print_failures(report: Mapping[str, Any], results: Path) -> None:
    """Print the failed rollouts to standard error, with one example of each kind."""
    rows = failure_rows(report)
    if rows:
        print(
            f"\n{len(report['failures'])} of {report['num_rollouts']} rollouts failed and are "
            f"missing from the figures; all are in {results}",
            file=sys.stderr,
        )
    for row in rows:
        failed = f"{row.policy} in {row.world}, {row.count} x: {row.message}"
        print(f"  {printable(failed)}", file=sys.stderr)
        if row.traceback:
            print(indent(printable(row.traceback, lines=True), "    "), file=sys.stderr)
