"""Programs that some tests need: a test without one is skipped, in `.ci/run` it fails."""

import os
import shutil
from typing import NoReturn

import pytest

# Set by `.ci/run`, which installs them all: a skipped test would look like a passed one there.
REQUIRED_VARIABLE = "DEXTOUCH_REQUIRE_SERVICES"


def needed_program(name: str, *, package: str) -> str:
    """Path of a program that Debian's `package` installs; skips or fails the test without it."""
    path = shutil.which(name)
    if path is None:
        skip_or_fail(f"no {name} on the PATH: apt-get install {package}")
    return path


def skip_or_fail(lacking: str) -> NoReturn:
    """Skip the test because of what is lacking; fail it where nothing may lack."""
    if os.environ.get(REQUIRED_VARIABLE, "") not in {"", "0"}:
        pytest.fail(f"{lacking} ({REQUIRED_VARIABLE} is set, so nothing is skipped)", pytrace=False)
    pytest.skip(lacking)
