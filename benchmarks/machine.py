"""Description of the machine and the code version, for the head of a report."""

import os
import platform
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
        "commit": commit(),
        "processor": _first_value(Path("/proc/cpuinfo"), "model name") or platform.machine(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": _memory(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load of the last minute": f"{os.getloadavg()[0]:.2f}",
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "not set"),
    }
    return about | {name: _version(name) for name in packages}


def commit() -> str:
    """Commit of the running code, with a mark if files are modified."""
    git, root = shutil.which("git"), Path(__file__).resolve().parents[1]
    if git is None or not (root / ".git").exists():
        return "unknown"
    answers = [
        subprocess.run(  # noqa: S603 (a fixed command in our own folder)
            [git, "-C", str(root), *arguments], capture_output=True, text=True, check=False
        )
        for arguments in (("rev-parse", "--short=12", "HEAD"), ("diff", "--quiet", "HEAD"))
    ]
    if answers[0].returncode != 0:
        return "unknown"
    return answers[0].stdout.strip() + (" with changes" if answers[1].returncode else "")


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


def _memory() -> str:
    kilobytes = _first_value(Path("/proc/meminfo"), "MemTotal").removesuffix(" kB")
    return f"{int(kilobytes) / 2**20:.1f} GiB" if kilobytes.isdigit() else "unknown"


def _first_value(path: Path, key: str) -> str:
    """The first `key : value` of a kernel file; empty if there is none."""
    if not path.is_file():
        return ""
    for line in path.read_text(encoding="utf-8").splitlines():
        name, _, value = line.partition(":")
        if name.strip() == key:
            return value.strip()
    return ""
