"""Child process that runs a Python module and exchanges JSON lines with its parent.

For work that must not block a service, or kill it when the work is killed. The module calls
`serve_parent` and exits when its standard input closes: it outlives the parent by one request.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

from dextouch.errors import UnavailableError

STOP_TIMEOUT_S = 30.0  # chosen: for a child that hangs

Answer = Callable[[Mapping[str, object]], None]


class ChildProcess:
    """A running child; `kill` is thread-safe, the other methods are not.

    `environment` are variables in addition to this process's own.
    """

    def __init__(
        self, module: str, *arguments: str, environment: Mapping[str, str] | None = None
    ) -> None:
        # The child uses the same import path as this process.
        python_path = os.pathsep.join(path for path in sys.path if path)
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": python_path} | dict(environment or {}),
        )

    @property
    def pid(self) -> int:
        """Process id, valid also after the process has ended."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the process has not ended yet."""
        return self._process.poll() is None

    def send(self, order: Mapping[str, object]) -> None:
        """Send a request; if the process has ended, `receive` raises."""
        assert self._process.stdin is not None  # noqa: S101 - it is a pipe
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()

    def receive(self) -> dict[str, Any]:
        """Wait for the next response.

        Raises UnavailableError if the process ended; `details` has its `exit_status`.
        """
        assert self._process.stdout is not None  # noqa: S101 - it is a pipe
        line = self._process.stdout.readline()
        if line.endswith(b"\n"):
            answer: dict[str, Any] = json.loads(line)
            return answer
        status = self.close()
        if status == -signal.SIGKILL:
            how = "killed; probably out of memory"
        else:
            how = f"signal {-status}" if status < 0 else f"exit status {status}; see its log"
        raise UnavailableError(f"the process ended ({how})", exit_status=status)

    def kill(self) -> None:
        """Kill the process; `close` it afterwards."""
        self._process.kill()
        self._process.wait(STOP_TIMEOUT_S)

    def close(self) -> int:
        """Wait for the current request and the end of the process; returns its exit status."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            try:
                self._process.communicate(timeout=STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()
        return self._process.wait(STOP_TIMEOUT_S)


def serve_parent(*, niceness: int) -> tuple[Iterator[dict[str, Any]], Answer]:
    """In the child: requests of the parent, and the function that sends responses.

    Standard output of the child is redirected to standard error, to keep responses separate.
    `niceness` is added to this process's, so that the parent has priority.
    """
    # The parent decides when to end; Ctrl-C at the terminal reaches both processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def answer(message: Mapping[str, object]) -> None:
        answers.write(json.dumps(message).encode() + b"\n")
        answers.flush()

    return (json.loads(line) for line in sys.stdin.buffer), answer
