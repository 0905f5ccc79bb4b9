"""A station that says while recording whether the robot's hand could follow the operator's."""

import gc
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

from dextouch.errors import UnavailableError
from dextouch.installation import install_command
from dextouch.schemas import Matrix
from dextouch.tactile.layout import Side
from services.acquisition import app

if TYPE_CHECKING:
    from services.pipelines.robot_following import RobotHandCheck


def main(argv: Sequence[str]) -> int:
    """Run a station until SIGINT or SIGTERM."""
    return app.main(argv, follow=load_robot_check)


def load_robot_check(side: Side, calibration: Mapping[str, Matrix]) -> "RobotHandCheck":
    """The check of one hand; loads the compiled solver, which takes a second, the first time more.

    Raises UnavailableError without the packages of alignment, and as `RobotHandCheck`.
    """
    _compile_apart()
    # Collections of the many objects that it makes would hold up the readers: none while it loads,
    # and none visits them afterwards, since they stay.
    gc.disable()
    try:
        from services.pipelines.robot_following import RobotHandCheck

        return RobotHandCheck(side, calibration)
    except ModuleNotFoundError as error:
        raise UnavailableError(
            f"{error.name} is not installed; install it with {install_command('align')}"
        ) from error
    finally:
        gc.freeze()
        gc.enable()


@cache
def _compile_apart() -> None:
    """Compile the solver, once a machine, in a process of its own, which leaves it in the cache.

    In this one it would hold up the readers: a thread with a 5 ms timer woke up to 0.39 s late
    while it compiled, and wakes up to 34 ms late while it is loaded (two busy cores; else 23 ms).
    """
    compiling = (sys.executable, "-m", f"{__package__}.robot_following")
    subprocess.run(compiling, check=False, stderr=subprocess.DEVNULL)  # noqa: S603 - this program
