"""A process that aligns recordings for its parent, which may stop it at any time."""

import threading
from typing import Any

from dextouch.errors import UnavailableError
from dextouch.schemas import Problem, error_from_problem
from dextouch.serving import ChildProcess
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import OnProgress, Progress


class AlignmentWorker:
    """One process that aligns one recording after another."""

    def __init__(self, store_url: str, log_level: str = "warning") -> None:
        self._store_url, self._log_level = store_url, log_level
        self._child: ChildProcess | None = None
        # Guards which process there is; `stop` must not wait for an order to end.
        self._guard = threading.Lock()
        # Held while orders are sent and answers are read.
        self._in_use = threading.RLock()

    @property
    def pid(self) -> int | None:
        """Of the process; None where there is none."""
        child = self._child
        return None if child is None else child.pid

    def start(self) -> None:
        """Start the process and wait until its solver is ready; does nothing if it runs.

        Raises:
            UnavailableError: it does not start.
        """
        with self._in_use:
            with self._guard:
                if self._child is not None and self._child.is_running:
                    return
                # One thread each: the workers share the processors.
                child = self._child = ChildProcess(
                    "services.alignment.worker_process",
                    self._store_url,
                    self._log_level,
                    environment={"OMP_NUM_THREADS": "1"},
                )
            _receive(child, "the alignment process does not start")

    def run(
        self, recording_id: str, options: AlignmentOptions, on_progress: OnProgress
    ) -> AlignmentReport:
        """Align a finished recording; its progress is told a few times a second.

        Raises:
            UnavailableError: the process was killed; the store is as it was.
            DexTouchError: as `align_recording`.
        """
        with self._in_use:
            self.start()
            child = self._child
            what = f"recording {recording_id!r}: the process that aligned it died"
            if child is None:
                raise UnavailableError(f"{what} before it began; ask again")
            child.send({"recording_id": recording_id, "options": options.model_dump()})
            while True:
                answer = _receive(child, what)
                if "progress" in answer:
                    on_progress(Progress(*answer["progress"]))
                elif "problem" in answer:
                    raise error_from_problem(Problem.model_validate(answer["problem"]))
                else:
                    return AlignmentReport.model_validate(answer["report"])

    def stop(self) -> None:
        """Kill the process; the recording it was aligning is lost, the store is as it was."""
        with self._guard:
            child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        with self._in_use:
            child.close()


def _receive(child: ChildProcess, what: str) -> dict[str, Any]:
    try:
        return child.receive()
    except UnavailableError as error:
        raise UnavailableError(
            f"{what}: {error.message}. Nothing was written; ask for it again", **error.details
        ) from error
