"""Description of the machine and the code version, for the head of a report."""

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import dextouch
from dextouch.errors import ConflictError

NOT_INSTALLED = "not installed"


def describe_machine(packages: Sequence[str]) -> dict[str, str]:
    """Processor, memory, system, load and versions of packages, for the head of a report."""
    about = {
        "dextouch": dextouch.__version__,
        "commit": _commit(),
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load of the last minute": f"{os.getloadavg()[0]:.2f}",
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "not set"),
    }
    return about | {name: _version(name) for name in packages}


def _commit() -> str:
    """Commit of the running code, with a mark if files are modified."""
    git, root = shutil.which("git"), Path(__file__).resolve().parents[1]
    if git is None or not (root / ".git").exists():
        return "unknown"
    command = [git, "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=12"]
    answer = subprocess.run(  # noqa: S603 (a fixed command in our own folder)
        [*command, "--dirty= with changes"], capture_output=True, text=True, check=False
    )
    return answer.stdout.strip() or "unknown"


def refuse_shape_checks() -> None:
    """Refuse to time code with run-time checks of array shapes.

    Raises:
        ConflictError: the import hook of the tests is active in this process.
    """
    if any(type(finder).__module__.startswith("jaxtyping") for finder in sys.meta_path):
        raise ConflictError(
            "bench: this process checks array shapes at every call, which would distort timings; "
            "run `python -m benchmarks` in a separate process"
        )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return NOT_INSTALLED


def _processor() -> str:
    found = re.search(
        r"^model name\s*: (.*)", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE
    )
    return found[1] if found else platform.machine()
