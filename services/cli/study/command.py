"""The commands `dextouch study run` and `dextouch study report`."""

import argparse
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from dextouch.command_line import CommandParser, add_json
from dextouch.episodes import EpisodeStore
from services.cli.study.parts import (
    connect,
    demonstrator,
    refuse_training_seeds,
    served_worlds,
)
from services.evaluation.command_line import (
    EXIT_FAILED,
    instructions_for,
    print_failures,
    print_scores,
)
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.studies.definition import read_definition
from services.evaluation.studies.engine import StudyParts, cells_of, run_study
from services.evaluation.studies.policies import PolicyFactory, file_digest
from services.evaluation.studies.reports import REPORT_FILE, write_reports
from services.evaluation.studies.results import StudyHeader, StudyResults
from services.evaluation.success_probe import SuccessProbe

_RUN_EPILOG = """\
example:
  dextouch study run study.toml

A study file:

  name = "touch"
  tasks = ["stand_bottle", "stack_bowls"]
  first_seed = 31000
  num_starts = 10

  [imagined.model]
  builtin = "world-model"

  [policies.careful]
  script = "script 5 mm"
  [policies.mine]
  factory = "package.module:make_policy"

Everything that a study file can hold: docs/studies.md
"""


def main(arguments: list[str]) -> int:
    """Run `dextouch study COMMAND`.

    Returns:
        0, or 1 if a rollout failed or has no result yet.
    """
    options = _parser().parse_args(arguments)
    run: Any = options.run
    return int(run(options))


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="dextouch study",
        description="Score policies in real and imagined worlds from matched starts.",
    )
    words = parser.add_subparsers(required=True, metavar="COMMAND")
    run = words.add_parser(
        "run",
        help="run a study, or continue it",
        description="Run the rollouts of a study that have no result yet, and write its report. "
        "A study may be interrupted at any time; the same command continues it.",
        epilog=_RUN_EPILOG,
    )
    run.add_argument("study", type=Path, metavar="STUDY", help="study file (TOML)")
    run.add_argument(
        "--folder",
        type=Path,
        metavar="PATH",
        help="where results, rollouts and reports go (default: the study file without .toml)",
    )
    run.add_argument(
        "--retry-failed", action="store_true", help="run rollouts that failed before once more"
    )
    run.set_defaults(run=_run)
    report = words.add_parser(
        "report",
        help="write the report of a study's results so far",
        description="Write report.json, a page for each imagined world, and tables.tex from the "
        "results of a study, finished or not.",
        epilog="example:\n  dextouch study report runs/touch",
    )
    report.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the study")
    report.set_defaults(run=_report)
    for one in (run, report):
        add_json(one)
    return parser


def _run(options: argparse.Namespace) -> int:
    definition = read_definition(options.study)
    folder = options.folder or options.study.with_suffix("")
    refuse_training_seeds(definition)
    probe_path = definition.probe or DEFAULT_PROBE
    probe = SuccessProbe.load(probe_path)
    instructions = instructions_for(definition.tasks, probe.metadata.settings["instructions"])
    policies = PolicyFactory(definition, partial(demonstrator, definition.tasks, definition.seeds))
    policies.load()
    with served_worlds(definition) as addresses:
        digests = {"definition": definition.digest, "probe": file_digest(probe_path)}
        digests |= policies.digests()
        with ExitStack() as connections:
            digests |= connect(addresses, connections).digests
        header = StudyHeader(definition.name, definition.model_dump(mode="json"), digests)
        results = StudyResults.create_or_resume(folder, header)
        num_cells = sum(1 for _ in cells_of(definition))
        store = EpisodeStore(folder / "rollouts") if definition.keep_rollouts else None
        if store is not None:
            # What a killed run left unfinished.
            store.sweep()
        print(f"{definition.name}: {len(results.outcomes)} of {num_cells} rollouts have a result")
        run_study(
            definition,
            results,
            StudyParts(
                partial(connect, addresses),
                policies.load,
                probe,
                instructions,
                policies.training_starts(),
                store,
            ),
            retry_failed=options.retry_failed,
        )
    return _finish(results, options.json)


def _report(options: argparse.Namespace) -> int:
    return _finish(StudyResults.read(options.folder), options.json)


def _finish(results: StudyResults, json_path: Path | None) -> int:
    figures = write_reports(results, json_path)
    print_scores(figures)
    print_failures(figures, results.path)
    print(f"\nreport: {results.path.with_name(REPORT_FILE)}")
    return EXIT_FAILED if figures["failures"] else 0
