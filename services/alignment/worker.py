"""Recordings to align in, their reports out, by a process that is started when it is needed."""

import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

from dextouch.errors import UnavailableError
from dextouch.schemas.problems import Problem, error_from_problem
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import Progress, Tell

STOP_TIMEOUT_S = 30.0


class AlignmentWorker:
    """One process that aligns one recording after another.

    Args:
        store_url: of the store, as the process opens it.
        log_level: of the process's log.
    """

    def __init__(self, store_url: str, log_level: str = "warning") -> None:
        self._store_url, self._log_level = store_url, log_level
        self._child: subprocess.Popen[bytes] | None = None
        self._guard = threading.Lock()
        # Held by whoever talks with the process.
        self._talking = threading.RLock()

    @property
    def pid(self) -> int | None:
        """Of the process; None where there is none."""
        child = self._child
        return None if child is None else child.pid

    def start(self) -> None:
        """Start the process and wait until its solver is ready; again does nothing.

        Raises:
            UnavailableError: it does not start.
        """
        with self._talking:
            with self._guard:
                if self._child is not None and self._child.poll() is None:
                    return
                child = self._child = _spawn(self._store_url, self._log_level)
            _answer(child, "the alignment process does not start")

    def run(self, recording_id: str, options: AlignmentOptions, tell: Tell) -> AlignmentReport:
        """Align a recording.

        Args:
            recording_id: of a finished recording.
            options: of the alignment.
            tell: called with the progress, a few times a second.

        Raises:
            UnavailableError: the process was killed; the store is as it was.
            DexTouchError: as `align_recording`.
        """
        with self._talking:
            self.start()
            child = self._child
            what = f"recording {recording_id!r}: the process that aligned it died"
            if child is None or child.stdin is None:
                raise UnavailableError(f"{what} before it began; ask again")
            order = {"recording_id": recording_id, "options": options.model_dump()}
            try:
                child.stdin.write(json.dumps(order).encode() + b"\n")
                child.stdin.flush()
            except BrokenPipeError as error:
                _close_pipes(child)
                raise UnavailableError(f"{what} before it began; ask again") from error
            while True:
                answer = _answer(child, what)
                if "progress" in answer:
                    tell(Progress(*answer["progress"]))
                elif "problem" in answer:
                    raise error_from_problem(Problem.model_validate(answer["problem"]))
                else:
                    return AlignmentReport.model_validate(answer["report"])

    def stop(self) -> None:
        """End the process at once; what it was at is lost, the store is as it was."""
        with self._guard:
            child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait(STOP_TIMEOUT_S)
        with self._talking:
            _close_pipes(child)


def _spawn(store_url: str, log_level: str) -> subprocess.Popen[bytes]:
    # The child finds the same packages, wherever this process found them, and keeps to one
    # processor where libraries would take all.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "OMP_NUM_THREADS": "1",
    }
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "services.alignment.worker_process", store_url, log_level],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    )


def _answer(child: subprocess.Popen[bytes], what: str) -> dict[str, Any]:
    """The next line of the child.

    Raises:
        UnavailableError: it ended instead.
    """
    line = child.stdout.readline() if child.stdout is not None else b""
    if line.endswith(b"\n"):
        answer: dict[str, Any] = json.loads(line)
        return answer
    status = child.wait(STOP_TIMEOUT_S)
    _close_pipes(child)
    if status == -signal.SIGKILL:
        how = "killed; if nobody did, memory was short: give it more, or use fewer workers"
    else:
        how = f"signal {-status}" if status < 0 else f"exit status {status}; its log says why"
    raise UnavailableError(
        f"{what} ({how}). Nothing was written; ask for it again", exit_status=status
    )


def _close_pipes(child: subprocess.Popen[bytes]) -> None:
    for pipe in (child.stdin, child.stdout):
        if pipe is not None:
            with suppress(BrokenPipeError):
                pipe.close()
