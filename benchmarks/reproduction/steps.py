"""Steps of a reproduction: commands with what they need, each run once and resumed after a stop."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

RECEIPT: Final = "step.json"
LOG: Final = "log.txt"
DEXTOUCH: Final = (sys.executable, "-m", "services.cli.main")
_LOG_LINES_SHOWN: Final = 12
_STOP_TIMEOUT_S: Final = 30.0
# Commands take seconds to hours.
_POLL_S: Final = 0.1


@dataclass(frozen=True)
class Step:
    """One command of a reproduction, whose results lie in a folder with the step's name.

    `command` is without `dextouch` and runs in the folder of the reproduction. `makes` are the
    results that exist once it has ended, and `inputs` texts that are written before, both by their
    names in the step's folder; `needs` are the steps that run before. An exit status in `exits`
    counts as done: `train data` ends with 1 if the physics of an episode diverged.
    """

    name: str
    command: str
    makes: tuple[str, ...]
    needs: tuple["Step", ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()
    exits: tuple[int, ...] = (0,)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the command and of those of all steps that it depends on."""
        text = json.dumps([self.command, self.inputs, [need.digest for need in self.needs]])
        return hashlib.sha256(text.encode()).hexdigest()

    def receipt(self, folder: Path) -> dict[str, Any] | None:
        """Command, digest and times, if this command is done and its results exist."""
        path = folder / self.name / RECEIPT
        if not all(one.exists() for one in (path, *(path.with_name(m) for m in self.makes))):
            return None
        receipt: dict[str, Any] = json.loads(path.read_bytes())
        return receipt if receipt["digest"] == self.digest else None

    def start(self, folder: Path, program: Sequence[str]) -> subprocess.Popen[bytes]:
        """Begin or resume the command, without the results of another one."""
        own = folder / self.name
        begun = own / f"begun-{self.digest[:16]}"
        if not begun.exists():
            shutil.rmtree(own, ignore_errors=True)
        own.mkdir(parents=True, exist_ok=True)
        begun.touch()
        (own / RECEIPT).unlink(missing_ok=True)
        for name, text in self.inputs:
            (own / name).write_text(text, encoding="utf-8")
        python_path = os.pathsep.join(str(Path(path).resolve()) for path in sys.path if path)
        with (own / LOG).open("ab") as log:
            return subprocess.Popen(  # noqa: S603 - our own commands
                [*program, *self.command.split()],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONPATH": python_path, "OMP_NUM_THREADS": "1"},
            )

    def end(self, folder: Path, status: int, **times_s: float) -> bool:
        """Write the receipt of a command that has ended; whether it did what it should."""
        path = folder / self.name / RECEIPT
        if status in self.exits:
            receipt = {"command": f"dextouch {self.command}", "digest": self.digest, **times_s}
            partial = path.with_suffix(".partial")
            partial.write_text(json.dumps(receipt, indent=2), encoding="utf-8")
            partial.replace(path)
        return self.receipt(folder) is not None


def step_with_result(name: str, command: str, *makes: str, **more: Any) -> Step:  # noqa: ANN401
    """A step whose command also writes its result as JSON; `more` are other fields of `Step`."""
    words = f"{' '.join(command.split())} --json {name}/result.json"
    return Step(name, words, ("result.json", *makes), **more)


def run(
    steps: Sequence[Step], folder: Path, num_jobs: int, program: Sequence[str] = DEXTOUCH
) -> list[str]:
    """Run the missing steps, `num_jobs` at a time; returns the names of those that failed.

    Steps that need a failed one are not run. An exception, such as Ctrl-C, stops the commands.
    """
    waiting = {step.name: step for step in steps if step.receipt(folder) is None}
    running: dict[str, tuple[Step, subprocess.Popen[bytes], float]] = {}
    failed: list[str] = []
    try:
        while True:
            missing = {*waiting, *running, *failed}
            ready = [s for s in waiting.values() if missing.isdisjoint(n.name for n in s.needs)]
            for step in ready[: num_jobs - len(running)]:
                print(f"{step.name}: dextouch {step.command}", flush=True)
                running[step.name] = step, step.start(folder, program), time.monotonic()
                del waiting[step.name]
            if not running:
                return failed
            time.sleep(_POLL_S)
            for step, child, started_s in list(running.values()):
                pid, status, usage = os.wait4(child.pid, os.WNOHANG)
                if not pid:
                    continue
                del running[step.name]
                child.returncode = os.waitstatus_to_exitcode(status)
                wall_s, cpu_s = time.monotonic() - started_s, usage.ru_utime + usage.ru_stime
                if step.end(folder, child.returncode, wall_s=wall_s, cpu_s=cpu_s):
                    left = len(waiting) + len(running)
                    print(f"{step.name}: {wall_s:.0f} s; steps left: {left}", flush=True)
                else:
                    failed.append(step.name)
                    print(f"{step.name}: FAILED; {_end_of(folder / step.name / LOG)}", flush=True)
    finally:
        for _, child, _ in running.values():
            child.terminate()
        for _, child, _ in running.values():
            try:
                child.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                child.kill()


def _end_of(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n  ".join([f"the end of {log}:", *lines[-_LOG_LINES_SHOWN:]])
