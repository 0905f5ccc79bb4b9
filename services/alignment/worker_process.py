"""Orders on standard input, a line of JSON each; progress, and a report or a problem, come back.

A process of its own for each worker: recordings are aligned side by side on as many processors,
and one that is killed takes nothing but its own recording along. The process ends when its
standard input does, so it never outlives its parent by more than the recording it is at.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError
from dextouch.schemas.episodes import json_ready
from dextouch.schemas.problems import Problem, problem_from_error
from dextouch.serving.logs import configure_logging
from services.alignment.jobs import align_recording
from services.alignment.options import AlignmentOptions
from services.alignment.synchronization.progress import Progress

logger = structlog.get_logger(__name__)

# Answering requests goes before aligning when the processor is short.
NICENESS = 5
TELL_PERIOD_S = 0.2

Say = Callable[[dict[str, object]], None]


def serve(store_url: str, say: Say) -> None:
    """Answer the orders on standard input until it ends."""
    store = EpisodeStore(store_url)
    warm_up()
    say({"ready": True})
    for line in sys.stdin.buffer:
        say(carry_out(store, json.loads(line), say))


def carry_out(store: EpisodeStore, order: dict[str, object], say: Say) -> dict[str, object]:
    """What became of one order: its report, or the problem."""
    recording_id = str(order["recording_id"])
    try:
        options = AlignmentOptions.model_validate(order["options"])
        report = align_recording(store, recording_id, options, _Teller(say))
    except DexTouchError as error:
        return {"problem": _problem(error, recording_id).model_dump()}
    except BrokenPipeError:
        raise
    except Exception:
        # The job's supervisor: one broken recording must not end the worker.
        logger.exception("alignment_broke", recording_id=recording_id)
        broken = DexTouchError(
            f"recording {recording_id!r}: unexpected error in alignment; the service's log tells "
            "more. The recording is as it was"
        )
        return {"problem": _problem(broken, recording_id).model_dump()}
    return {"report": json_ready(report)}


def warm_up() -> None:
    """Make the solver ready, which takes seconds when it is compiled for the first time."""
    from services.alignment.retargeting import hand_retargeter

    hand_retargeter.warm_up()


class _Teller:
    """Says progress, but not more often than anybody reads it."""

    def __init__(self, say: Say) -> None:
        self._say, self._told_s = say, float("-inf")

    def __call__(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s >= TELL_PERIOD_S:
            self._told_s = now_s
            self._say({"progress": list(progress)})


def _problem(error: DexTouchError, recording_id: str) -> Problem:
    return problem_from_error(error, instance=recording_id, request_id="")


def main() -> None:
    """Serve the store that the first argument names; the second is the log's level."""
    store_url, log_level = sys.argv[1:]
    # The parent decides when to end; a Ctrl-C at the terminal reaches both.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    # Answers have the real standard output for themselves.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    configure_logging(service="alignment", log_format="auto", level=log_level)

    def say(answer: dict[str, object]) -> None:
        answers.write(json.dumps(answer).encode() + b"\n")
        answers.flush()

    serve(store_url, say)


if __name__ == "__main__":
    main()
