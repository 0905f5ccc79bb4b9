"""A process that aligns recordings for its parent, which may stop it at any time.

Recordings are aligned side by side on several processors, and a process that is killed takes
nothing but its own recording along.
"""

import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError, UnavailableError
from dextouch.schemas import Problem, error_from_problem, json_ready, problem_from_error
from dextouch.serving import Answer, ChildProcess, configure_logging, serve_parent
from services.alignment.jobs import align_recording
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import OnProgress, Progress

logger = structlog.get_logger(__name__)

# Answering requests goes before aligning when the processor is short.
NICENESS = 5
PROGRESS_PERIOD_S = 0.2


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
                    __name__,
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
        if child is not None:
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


def _carry_out(store: EpisodeStore, order: Mapping[str, Any], answer: Answer) -> dict[str, object]:
    """Align the recording that an order names; the final answer is its report or the problem."""
    recording_id, last_s = str(order["recording_id"]), float("-inf")

    def on_progress(progress: Progress) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= PROGRESS_PERIOD_S:
            last_s = time.monotonic()
            answer({"progress": list(progress)})

    try:
        options = AlignmentOptions.model_validate(order["options"])
        return {"report": json_ready(align_recording(store, recording_id, options, on_progress))}
    except DexTouchError as error:
        failure = error
    except BrokenPipeError:
        raise
    except Exception:
        # The job's supervisor: one broken recording must not end the worker.
        logger.exception("alignment_crashed", recording_id=recording_id)
        failure = DexTouchError(
            f"recording {recording_id!r}: unexpected error in alignment; see the service's log. "
            "The recording is as it was"
        )
    problem = problem_from_error(failure, instance=recording_id, request_id="")
    return {"problem": problem.model_dump()}


def main() -> None:
    """Serve the store that the first argument names; the second is the log's level."""
    from services.alignment.retargeting import warm_up

    store_url, log_level = sys.argv[1:]
    orders, answer = serve_parent(niceness=NICENESS)
    configure_logging(service="alignment", log_format="auto", level=log_level)
    store = EpisodeStore(store_url)
    # Half a minute when the solver is compiled for the first time.
    warm_up()
    answer({"ready": True})
    for order in orders:
        answer(_carry_out(store, order, answer))


if __name__ == "__main__":
    main()
