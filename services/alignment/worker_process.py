"""Entry point of the process in which an `AlignmentWorker` aligns recordings.

Recordings are aligned side by side on several processors, and a process that is killed takes
nothing but its own recording along.
"""

import sys
import time
from collections.abc import Mapping

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError
from dextouch.schemas import Problem, json_ready, problem_from_error
from dextouch.serving import Answer, configure_logging, serve_parent
from services.alignment.jobs import align_recording
from services.alignment.options import AlignmentOptions
from services.alignment.synchronization.progress import Progress

logger = structlog.get_logger(__name__)

# Answering requests goes before aligning when the processor is short.
NICENESS = 5
PROGRESS_PERIOD_S = 0.2


def carry_out(
    store: EpisodeStore, order: Mapping[str, object], answer: Answer
) -> dict[str, object]:
    """Align the recording that an order names; the final answer is its report or the problem."""
    recording_id = str(order["recording_id"])
    try:
        options = AlignmentOptions.model_validate(order["options"])
        report = align_recording(store, recording_id, options, _ProgressAnswers(answer))
    except DexTouchError as error:
        return {"problem": _problem(error, recording_id).model_dump()}
    except BrokenPipeError:
        raise
    except Exception:
        # The job's supervisor: one broken recording must not end the worker.
        logger.exception("alignment_crashed", recording_id=recording_id)
        broken = DexTouchError(
            f"recording {recording_id!r}: unexpected error in alignment; see the service's log. "
            "The recording is as it was"
        )
        return {"problem": _problem(broken, recording_id).model_dump()}
    return {"report": json_ready(report)}


def warm_up() -> None:
    """Load the solver, which takes half a minute when it is compiled for the first time."""
    from services.alignment.retargeting import hand_retargeter

    hand_retargeter.warm_up()


class _ProgressAnswers:
    """Answers with the progress, but not more often than anybody reads it."""

    def __init__(self, answer: Answer) -> None:
        self._answer, self._last_s = answer, float("-inf")

    def __call__(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if now_s - self._last_s >= PROGRESS_PERIOD_S:
            self._last_s = now_s
            self._answer({"progress": list(progress)})


def _problem(error: DexTouchError, recording_id: str) -> Problem:
    return problem_from_error(error, instance=recording_id, request_id="")


def main() -> None:
    """Serve the store that the first argument names; the second is the log's level."""
    store_url, log_level = sys.argv[1:]
    orders, answer = serve_parent(niceness=NICENESS)
    configure_logging(service="alignment", log_format="auto", level=log_level)
    store = EpisodeStore(store_url)
    warm_up()
    answer({"ready": True})
    for order in orders:
        answer(carry_out(store, order, answer))


if __name__ == "__main__":
    main()
