"""`python -m tests.mutants.run`: plant each bug in a copy of the repository and run its tests.

Prints which bugs a test noticed ("killed") and the share of them. Exit status 1 if that share is
below the bound, or if a test fails without any bug.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from tests.mutants.bugs import ROOT, PlantedBug, planted_bugs

MIN_KILLED = 0.9
# A bug that makes its tests run for longer, or wait for ever, counts as noticed.
MAX_CPU_S = 600
MAX_WALL_S = 1800


def copy_of_repository(folder: Path) -> Path:
    """The files that git knows, with `../shared` beside them where it exists."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, check=True,
    )  # fmt: skip
    copy = folder / "repository"
    for name in listed.stdout.decode().split("\0"):
        source = ROOT / name
        if name and source.is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy / name)
    data = ROOT.parent / "shared"
    if data.is_dir():
        (folder / "shared").symlink_to(data)
    return copy


def run_tests(copy: Path, tests: Iterable[str]) -> tuple[bool, str]:
    """Whether all pass in a copy, and the last lines of what pytest says."""
    environment = os.environ | {
        "PYTHONPATH": f"{copy}:{copy / 'shared'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
    }
    tests = tuple(tests)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    if any("::" in test for test in tests):
        # Tests that are named one by one run even if they are slow.
        command += ["-m", "slow or not slow"]
    limited = ["sh", "-c", f'ulimit -t {MAX_CPU_S}; exec "$@"', "sh", *command]
    try:
        done = subprocess.run(
            limited, cwd=copy, env=environment, capture_output=True, text=True, check=False,
            timeout=MAX_WALL_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False, f"no end after {MAX_WALL_S} s"
    return done.returncode == 0, "\n".join(done.stdout.splitlines()[-12:])


def is_killed(copy: Path, bug: PlantedBug) -> bool:
    """Whether a test fails once the bug is in; the copy is whole again afterwards."""
    path = copy / bug.file
    source = path.read_text(encoding="utf-8")
    path.write_text(bug.planted(source), encoding="utf-8")
    try:
        passed, _ = run_tests(copy, bug.tests)
    finally:
        path.write_text(source, encoding="utf-8")
    return not passed


def survivors_of(bugs: Sequence[PlantedBug], *, jobs: int) -> list[PlantedBug]:
    """The bugs that no test noticed; prints one line a bug as it goes."""
    with tempfile.TemporaryDirectory(prefix="dextouch-mutants-") as folder:
        copies: SimpleQueue[Path] = SimpleQueue()
        for index in range(jobs):
            (Path(folder) / str(index)).mkdir()
            copies.put(copy_of_repository(Path(folder) / str(index)))

        def try_one(bug: PlantedBug) -> bool:
            copy = copies.get()
            try:
                killed = is_killed(copy, bug)
            finally:
                copies.put(copy)
            word = "killed  " if killed else "SURVIVED"
            print(f"{word}  {bug.area:<14}{bug.file}: {bug.what}", flush=True)
            return killed

        with ThreadPoolExecutor(jobs) as pool:
            killed = list(pool.map(try_one, bugs))
    return [bug for bug, was in zip(bugs, killed, strict=True) if not was]


def passes_without_bugs(bugs: Sequence[PlantedBug]) -> bool:
    """Whether every test that is used passes on the code as it is."""
    tests = sorted({test for bug in bugs for test in bug.tests})
    with tempfile.TemporaryDirectory(prefix="dextouch-mutants-") as folder:
        passed, said = run_tests(copy_of_repository(Path(folder)), tests)
    if not passed:
        print(f"these tests fail without any bug:\n{said}")
    return passed


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0 if enough bugs were noticed."""
    parser = argparse.ArgumentParser(prog="make mutants", description=__doc__)
    parser.add_argument("--area", nargs="+", default=(), help="tables to try; all by default")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="copies side by side")
    parser.add_argument("--min-killed", type=float, default=MIN_KILLED, help="share, 0 to 1")
    parser.add_argument("--list", action="store_true", help="print the table, run nothing")
    options = parser.parse_args(arguments)
    bugs = planted_bugs(tuple(options.area))
    if options.list:
        print("\n".join(f"{bug.area:<14}{bug.file}: {bug.what}" for bug in bugs))
        return 0
    if not passes_without_bugs(bugs):
        return 1
    survivors = survivors_of(bugs, jobs=options.jobs)
    share = 1 - len(survivors) / len(bugs)
    print(f"\nkilled {len(bugs) - len(survivors)} of {len(bugs)} planted bugs ({share:.1%})")
    for bug in survivors:
        print(f"  survived: {bug.file}: {bug.what}")
    return 0 if share >= options.min_killed else 1


if __name__ == "__main__":
    sys.exit(main())
