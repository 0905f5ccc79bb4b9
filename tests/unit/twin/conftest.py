"""Stages shared by the twin's tests; small pictures, no settling, so that they are fast."""

import pytest

from services.twin.settings import TwinSettings
from services.twin.stage import Stage


@pytest.fixture(scope="session")
def bottle_stage():
    return Stage("stand_bottle", "robot", TwinSettings())


@pytest.fixture(scope="session")
def bowls_stage():
    return Stage("stack_bowls", "human", TwinSettings())
