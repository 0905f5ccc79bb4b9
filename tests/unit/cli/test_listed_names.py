"""Names that command lines list without importing the work are those of the work."""

import argparse

from dextouch.episodes import TRASH_KINDS
from services.episode_store.parser import store_parser
from services.evaluation.prediction import all_metrics
from services.evaluation.prediction_names import METRIC_NAMES
from services.twin.mistakes import KINDS
from services.twin.names import DEFAULT_MIX, MISTAKE_KINDS, MIX_NAMES, TASK_NAMES, TASK_SETS
from services.twin.take_options import MIXES
from services.twin.tasks import _TASKS


def test_tasks_mixes_and_mistakes_of_the_twin():
    assert set(TASK_NAMES) == set(_TASKS)
    assert len(TASK_NAMES) == len(_TASKS)
    assert {task for tasks in TASK_SETS.values() for task in tasks} == set(TASK_NAMES)
    assert tuple(MIXES) == MIX_NAMES
    assert DEFAULT_MIX in MIXES
    assert tuple(KINDS) == MISTAKE_KINDS


def test_metrics_of_predictions():
    assert tuple(all_metrics()) == METRIC_NAMES


def test_kinds_of_the_trash():
    for kind in TRASH_KINDS:
        assert store_parser().parse_args(["restore", "--kind", kind, "x"]).kind == kind
    (restore,) = [
        commands.choices["restore"]
        for commands in store_parser()._actions
        if isinstance(commands, argparse._SubParsersAction)
    ]
    (kinds,) = [one.choices for one in restore._actions if "--kind" in one.option_strings]
    assert tuple(kinds) == TRASH_KINDS
