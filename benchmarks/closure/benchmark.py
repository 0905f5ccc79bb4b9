"""The benchmark stage `closure`: human takes of the twin, replayed by its robot hand."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from statistics import mean
from typing import Final

import numpy as np
from jaxtyping import Float64

from benchmarks.closure.methods import (
    METHODS,
    OURS,
    Method,
    RetargetedTake,
    retarget_take,
    robot_trajectory,
)
from benchmarks.figures import at_least
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.hands.actions import HandTrajectory, actions_from_poses, poses_from_actions
from dextouch.tactile import PADS, in_contact
from dextouch.tactile.layout import SIDES, split_pads
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import Recorder, TakeOptions, TruthStream, record
from services.twin.names import Domain
from services.twin.settings import TwinSettings
from services.twin.stage import Plan, Stage, command_row

# The whole hand comes last: in contact if any of its pads is.
PLACES: Final = (*PADS, "hand")
_NS_PER_MS: Final = 1e6


@dataclass(frozen=True)
class ContactTimes:
    """First and last contact of each pad of the left and the right hand; NaN: never touched."""

    first_ms: Float64[np.ndarray, "2 7"]
    last_ms: Float64[np.ndarray, "2 7"]


@dataclass(frozen=True)
class TimingErrors:
    """Replay minus human in milliseconds, for pads with contact in both, over many takes."""

    hand_first_ms: tuple[float, ...]
    hand_last_ms: tuple[float, ...]
    pad_first_ms: tuple[float, ...]
    pad_last_ms: tuple[float, ...]
    num_missing: int
    num_extra: int


def contact_times(streams: Mapping[str, TruthStream]) -> ContactTimes:
    """Contact times of every pad in the streams `tactile_left` and `tactile_right`."""
    first, last = np.full((2, len(SIDES), len(PLACES)), np.nan)
    for row, side in enumerate(SIDES):
        stream = streams[f"tactile_{side}"]
        tips, palm = split_pads(in_contact(stream.values))
        palm_touches = np.asarray(palm.any(axis=(1, 2)))[:, None]
        pads = np.concatenate([tips.any(axis=(2, 3)), palm_touches], axis=1)
        places = np.concatenate([pads, pads.any(axis=1, keepdims=True)], axis=1)
        for column in np.flatnonzero(places.any(axis=0)):
            at = np.flatnonzero(places[:, column])
            first[row, column] = stream.t_ref_ns[at[0]] / _NS_PER_MS
            last[row, column] = stream.t_ref_ns[at[-1]] / _NS_PER_MS
    return ContactTimes(first, last)


def timing_errors(pairs: Sequence[tuple[ContactTimes, ContactTimes]]) -> TimingErrors:
    """Errors of all takes, as (human, replay) pairs.

    `num_missing` counts pads with contact in the human take only, `num_extra` in the replay only.
    """
    first, last = (
        np.array([[getattr(take, name) for take in pair] for pair in pairs])
        for name in ("first_ms", "last_ms")
    )
    late_first, late_last = first[:, 1] - first[:, 0], last[:, 1] - last[:, 0]
    human, replay = np.moveaxis(np.isfinite(first[..., :-1]), 1, 0)
    return TimingErrors(
        hand_first_ms=_finite(late_first[..., -1]),
        hand_last_ms=_finite(late_last[..., -1]),
        pad_first_ms=_finite(late_first[..., :-1]),
        pad_last_ms=_finite(late_last[..., :-1]),
        num_missing=int((human & ~replay).sum()),
        num_extra=int((replay & ~human).sum()),
    )


def _finite(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values[np.isfinite(values)].tolist())


TASKS: Final = ("stand_bottle", "stack_bowls")
_IMAGE_PX: Final = 128


@dataclass(frozen=True)
class ClosureTake:
    """One human take and its replay by one method."""

    task: str
    method: Method
    human_succeeded: bool
    succeeded: bool
    human_contact: ContactTimes
    contact: ContactTimes


@lru_cache(maxsize=4)
def closure_stage(task: str, domain: Domain) -> Stage:
    """The stage of a task and domain, compiled once per process."""
    return Stage(task, domain, TwinSettings(image_height_px=_IMAGE_PX, image_width_px=_IMAGE_PX))


def replay(
    task: str, take: RetargetedTake, trajectory: HandTrajectory
) -> tuple[bool, dict[str, TruthStream]]:
    """Success and streams of the robot hand, from the initial object poses of the human take.

    The trajectory is converted to 67-D actions and back, as in every episode.
    """
    stage = closure_stage(task, "robot")
    anchor = stage.start(Plan(take.object_poses, trajectory))
    commands = poses_from_actions(actions_from_poses(trajectory, anchor), anchor)
    recorder = Recorder(stage, TakeOptions(images=()))
    recorder.sample(0)
    for row in range(1, NUM_GRID_STEPS):
        for step_index in stage.simulation.advance(command_row(commands, row)):
            recorder.sample(step_index)
    return stage.task.succeeded(stage.simulation), recorder.streams()


def close_take(
    task: str,
    seed: int,
    methods: Iterable[Method],
    on_step: Callable[[str], None] = lambda _: None,
) -> list[ClosureTake]:
    """Replay one human take with every method."""
    episode = record(closure_stage(task, "human"), seed, TakeOptions(images=()))
    take = retarget_take(episode)
    human_contact = contact_times(episode.streams)
    results = []
    for method in methods:
        on_step(f"{task} {seed}: {method.name}")
        succeeded, streams = replay(task, take, robot_trajectory(take, method))
        contact = contact_times(streams)
        human = bool(episode.attributes.success)
        results.append(ClosureTake(task, method, human, succeeded, human_contact, contact))
    return results


FIRST_SEED = 100
AMOUNTS = Amounts(usual={"takes": 20}, quick={"takes": 1})
MIN_SUCCESS = 0.8
QUICK_METHODS = (METHODS[0], OURS)

Played = Mapping[tuple[str, Method], Sequence[ClosureTake]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    AMOUNTS.add_options(parser, takes="human takes per task")
    parser.add_argument(
        "--tasks", default=",".join(TASKS), metavar="A,B", help="tasks of the twin (%(default)s)"
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record human takes and replay each of them by every method."""
    num_takes = AMOUNTS.of(options)["takes"]
    tasks = options.tasks.split(",")
    methods = QUICK_METHODS if options.quick else METHODS
    played: dict[tuple[str, Method], list[ClosureTake]] = {
        (task, method): [] for task in tasks for method in methods
    }
    with bar("replaying", len(played) * num_takes) as step:
        for task in tasks:
            for seed in range(FIRST_SEED, FIRST_SEED + num_takes):
                for take in close_take(task, seed, methods, step):
                    played[task, take.method].append(take)
    return StageReport(
        stage="closure",
        packages=("numpy", "mujoco", "numba"),
        options={"takes": num_takes, "tasks": tasks},
        tables=[_table(played, num_takes)],
        requirements=[
            at_least(f"{task}: success of {OURS.name}", _rate(played[task, OURS]), MIN_SUCCESS)
            for task in tasks
        ],
        data={
            "succeeded": {
                f"{task}: {method.name}": [take.succeeded for take in takes]
                for (task, method), takes in played.items()
            }
        },
    )


def _table(played: Played, num_takes: int) -> ResultTable:
    rows = []
    for (task, method), takes in played.items():
        errors = timing_errors([(take.human_contact, take.contact) for take in takes])
        *late_ms, missing, extra = astuple(errors)
        means = map(_mean_ms, late_ms)
        name, rate = f"{task}: {method.name}", f"{_rate(takes):.2f}"
        rows.append((name, rate, *means, str(missing), str(extra)))
    return ResultTable(
        f"Replays of {num_takes} human takes a task; contact times against the human's in ms",
        ("", "success", "hand first", "hand last", "pad first", "pad last", "missing", "extra"),
        rows,
    )


def _rate(takes: Sequence[ClosureTake]) -> float:
    return mean(float(take.succeeded) for take in takes)


def _mean_ms(values: Sequence[float]) -> str:
    return f"{mean(abs(value) for value in values):.0f}" if values else "-"
