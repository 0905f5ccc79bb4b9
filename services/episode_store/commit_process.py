"""Spools to commit in, as lines of JSON to a process of its own; counts or a problem come back.

Copying a take costs as much as receiving it, and in the process that acknowledges batches it
would hold up every station. The child ends when its standard input does: it never outlives the
service.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError, UnavailableError
from dextouch.schemas.problems import Problem, error_from_problem, problem_from_error
from dextouch.schemas.recordings import RecordingAttributes
from services.episode_store.committing import commit_spool

# Acknowledging goes before committing when the processor is short.
NICENESS = 5
RETRY_AFTER_S = 1
STOP_TIMEOUT_S = 30.0


class CommitProcess:
    """A `Commit` that another process carries out, one spool at a time; started when first used.

    Args:
        store_url: of the store, as the child opens it.
    """

    def __init__(self, store_url: str) -> None:
        self._store_url = store_url
        self._child: subprocess.Popen[bytes] | None = None
        self._guard = threading.Lock()

    def __call__(self, spool: Path, attributes: RecordingAttributes) -> dict[str, int]:
        """Commit a spool; raises as `commit_spool`.

        Raises:
            UnavailableError: the process died on the way; the spool is as it was.
        """
        order = {"spool": str(spool), "attributes": attributes.model_dump_json()}
        with self._guard:
            answer = self._ask(json.dumps(order).encode() + b"\n")
        if not answer:
            raise UnavailableError(
                f"finish {attributes.recording_id}: the process that writes recordings died; "
                "try again",
                retry_after_s=RETRY_AFTER_S,
            )
        told = json.loads(answer)
        if "problem" in told:
            raise error_from_problem(Problem.model_validate(told["problem"]))
        counts: dict[str, int] = told["num_samples"]
        return counts

    def close(self) -> None:
        """Let the process end the spool it has, and wait for it."""
        with self._guard:
            if self._child is None:
                return
            self._stop(self._child)

    def _ask(self, order: bytes) -> bytes:
        if self._child is None or self._child.poll() is not None:
            self._child = self._start()
        child = self._child
        assert child.stdin is not None  # noqa: S101 - both are pipes
        assert child.stdout is not None  # noqa: S101
        try:
            child.stdin.write(order)
            child.stdin.flush()
            answer = child.stdout.readline()
        except BrokenPipeError:
            answer = b""
        if not answer.endswith(b"\n"):
            self._stop(child)
            return b""
        return answer

    def _stop(self, child: subprocess.Popen[bytes]) -> None:
        self._child = None
        try:
            child.communicate(timeout=STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.communicate()

    def _start(self) -> subprocess.Popen[bytes]:
        # The child finds the same packages, wherever this process found them.
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)
        }
        return subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", "services.episode_store.commit_process", self._store_url],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )


def serve(store_url: str) -> None:
    """Answer orders on standard input until it ends."""
    # The service decides when to end; a Ctrl-C at the terminal reaches both.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    store = EpisodeStore(store_url)
    for line in sys.stdin.buffer:
        order = json.loads(line)
        attributes = RecordingAttributes.model_validate_json(order["attributes"])
        told: dict[str, object]
        try:
            told = {"num_samples": commit_spool(store, Path(order["spool"]), attributes)}
        except DexTouchError as error:
            problem = problem_from_error(error, instance=attributes.recording_id, request_id="")
            told = {"problem": problem.model_dump()}
        sys.stdout.buffer.write(json.dumps(told).encode() + b"\n")
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    serve(sys.argv[1])
