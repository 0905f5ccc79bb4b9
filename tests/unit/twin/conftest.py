"""Stages shared by the twin's tests; small pictures, no settling, so that they are fast."""

import numpy as np
import pytest

from services.twin.cameras import HEAD_HOME
from services.twin.settings import TwinSettings
from services.twin.simulation import Command
from services.twin.stage import Stage
from services.twin.tasks.task import relaxed


@pytest.fixture(scope="session")
def bottle_stage():
    return Stage("stand_bottle", "robot", TwinSettings())


@pytest.fixture(scope="session")
def bowls_stage():
    return Stage("stack_bowls", "human", TwinSettings())


@pytest.fixture
def hand_made():
    """A task's objects where a test puts them, the hands resting far away."""

    def make(task, poses):
        stage = Stage(task, "robot", TwinSettings())
        hands = [relaxed("left", "robot"), relaxed("right", "robot")]
        command = Command(
            np.stack([*(hand.T_world_wrist for hand in hands), HEAD_HOME]),
            np.stack([hand.joints_rad for hand in hands]),
        )
        stage.simulation.place(command, np.array(poses, dtype=float), settle_s=0.0)
        return stage.simulation

    return make
