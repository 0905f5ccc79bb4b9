"""Replay of human takes by the twin's robot hand, with success and contact times."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from benchmarks.closure.contact_times import ContactTimes, contact_times
from benchmarks.closure.methods import Method, RetargetedTake, retarget_take, robot_trajectory
from dextouch.hands.actions import HandTrajectory, actions_from_poses, poses_from_actions
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import Recorder, TakeOptions, TruthStream, record
from services.twin.names import Domain
from services.twin.settings import TwinSettings
from services.twin.stage import Plan, Stage, command_row

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
