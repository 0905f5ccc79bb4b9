"""Steps of a reproduction: commands with what they need, each run once and resumed after a stop."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

from dextouch.errors import ConflictError, NotFoundError
from dextouch.frozen_model import FrozenModel

RECEIPT: Final = "step.json"
LOG: Final = "log.txt"
LOG_LINES_SHOWN: Final = 12
STOP_TIMEOUT_S: Final = 30.0
DEXTOUCH: Final = (sys.executable, "-m", "services.cli.main")


@dataclass(frozen=True)
class Step:
    """One command of a reproduction, whose results lie in a folder with the step's name.

    `words` are those after `dextouch`; the command runs in the folder of the reproduction. `makes`
    are the results that exist once it has ended, and `inputs` texts that are written before, both
    by their names in the step's folder. `needs` names the steps that run before. An exit status
    in `exits` counts as done: `train data` ends with 1 if the physics of an episode diverged.
    """

    name: str
    words: tuple[str, ...]
    makes: tuple[str, ...]
    needs: tuple[str, ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()
    exits: tuple[int, ...] = (0,)

    @property
    def command(self) -> str:
        """The command as typed in the folder of the reproduction."""
        return " ".join(["dextouch", *self.words])


class Receipt(FrozenModel):
    """Record of a step in its folder; `done` is false while it runs and after it failed."""

    command: str
    digest: str
    done: bool = False
    wall_s: float = 0.0
    cpu_s: float = 0.0


class Runner:
    """Runs steps in a folder; those that were done with the same commands are not run again.

    Args:
        folder: of the reproduction.
        steps: every step after those that it needs.
        program: that is called with the words of a step; default: this installation's dextouch.

    Raises:
        ConflictError: two steps have one name, or one precedes a step that it needs.
    """

    def __init__(
        self, folder: Path, steps: Sequence[Step], program: Sequence[str] = DEXTOUCH
    ) -> None:
        self.folder = folder
        self._program = tuple(program)
        # Commands that run; None once they are stopped, so that none begins after that.
        self._children: dict[str, subprocess.Popen[bytes]] | None = {}
        self._lock = threading.Lock()
        self._steps: dict[str, Step] = {}
        for step in steps:
            if step.name in self._steps or not set(step.needs) <= set(self._steps):
                raise ConflictError(
                    f"step {step.name!r}: got it twice or before one of {list(step.needs)}, "
                    "expected each step once, after those that it needs"
                )
            self._steps[step.name] = step

    def digest(self, name: str) -> str:
        """SHA-256 of a step's command and of those of all steps that it depends on."""
        step = self._steps[name]
        text = json.dumps([step.words, step.inputs, [self.digest(one) for one in step.needs]])
        return hashlib.sha256(text.encode()).hexdigest()

    def receipt(self, name: str) -> Receipt | None:
        """Receipt of a step that was done with its present command and whose results exist."""
        receipt = self._begun(name)
        made = all((self.folder / name / one).exists() for one in self._steps[name].makes)
        return receipt if receipt is not None and receipt.done and made else None

    def missing(self) -> list[Step]:
        """Steps that are still to be done, in order."""
        return [step for step in self._steps.values() if self.receipt(step.name) is None]

    def run(self, num_jobs: int) -> list[str]:
        """Run the missing steps, `num_jobs` at a time, and return the names of those that failed.

        Steps that need a failed one are not run. An exception, such as Ctrl-C, stops the commands.
        """
        waiting = {step.name: step for step in self.missing()}
        total, failed = len(waiting), list[str]()
        running: dict[Future[float | None], str] = {}
        with ThreadPoolExecutor(num_jobs) as pool:
            try:
                while True:
                    for step in list(_ready(waiting, running.values(), failed)):
                        if len(running) < num_jobs:
                            del waiting[step.name]
                            print(f"{step.name}: {step.command}", flush=True)
                            running[pool.submit(self._do, step)] = step.name
                    if not running:
                        return failed
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        name, wall_s = running.pop(future), future.result()
                        if wall_s is None:
                            failed.append(name)
                            print(self._failure(name), flush=True)
                            continue
                        left = len(waiting) + len(running)
                        print(f"{name}: {wall_s:.0f} s; {left} of {total} steps left", flush=True)
            except BaseException:
                self._stop()
                raise

    def _do(self, step: Step) -> float | None:
        """Run one step; returns its wall time, or None if it failed or was not begun."""
        self._prepare(step)
        started_s = time.monotonic()
        with (self.folder / step.name / LOG).open("ab") as log:
            child = self._begin(step, log)
            if child is None:
                return None
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        made = all((self.folder / step.name / one).exists() for one in step.makes)
        if child.returncode not in step.exits or not made:
            return None
        wall_s = time.monotonic() - started_s
        self._write_receipt(step, done=True, wall_s=wall_s, cpu_s=usage.ru_utime + usage.ru_stime)
        return wall_s

    def _begin(self, step: Step, log: IO[bytes]) -> subprocess.Popen[bytes] | None:
        python_path = os.pathsep.join(str(Path(path).resolve()) for path in sys.path if path)
        with self._lock:
            if self._children is None:
                return None
            child = subprocess.Popen(  # noqa: S603 - our own commands
                [*self._program, *step.words],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONPATH": python_path, "OMP_NUM_THREADS": "1"},
            )
            self._children[step.name] = child
            return child

    def _stop(self) -> None:
        """Ask commands to end, and kill those that do not; none begins from now on."""
        with self._lock:
            children = list((self._children or {}).values())
            self._children = None
        for child in children:
            _signal(child, signal.SIGTERM)
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        while time.monotonic() < deadline_s and any(child.returncode is None for child in children):
            time.sleep(0.1)
        for child in children:
            _signal(child, signal.SIGKILL)

    def _prepare(self, step: Step) -> None:
        """Create the step's folder, without the results of another command."""
        folder = self.folder / step.name
        if self._begun(step.name) is None:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in step.inputs:
            (folder / name).write_text(text, encoding="utf-8")
        self._write_receipt(step)

    def _begun(self, name: str) -> Receipt | None:
        """Receipt of a step that was begun with its present command."""
        path = self.folder / name / RECEIPT
        if not path.is_file():
            return None
        receipt = Receipt.model_validate_json(path.read_bytes())
        return receipt if receipt.digest == self.digest(name) else None

    def _write_receipt(self, step: Step, **measured: Any) -> None:  # noqa: ANN401 - its fields
        receipt = Receipt(command=step.command, digest=self.digest(step.name), **measured)
        path = self.folder / step.name / RECEIPT
        partial = path.with_suffix(".partial")
        partial.write_text(receipt.model_dump_json(indent=2), encoding="utf-8")
        partial.replace(path)

    def _failure(self, name: str) -> str:
        log = self.folder / name / LOG
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        shown = "\n".join(f"  {line}" for line in lines[-LOG_LINES_SHOWN:])
        return f"{name}: FAILED; the end of {log}:\n{shown}"


def read_json(path: Path) -> Any:  # noqa: ANN401 - JSON of a command
    """Result that a step wrote.

    Raises:
        NotFoundError: there is none.
    """
    if not path.is_file():
        raise NotFoundError(f"reproduction: no {path}; run the steps of its table first")
    return json.loads(path.read_bytes())


def _ready(
    waiting: Mapping[str, Step], running: Iterable[str], failed: Sequence[str]
) -> Iterator[Step]:
    """Steps whose needs are done."""
    not_done = {*waiting, *running, *failed}
    for step in waiting.values():
        if not_done.isdisjoint(step.needs):
            yield step


def _signal(child: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send a signal to a command that has not ended."""
    if child.returncode is None:
        with suppress(ProcessLookupError):
            os.kill(child.pid, number)
