"""Alignment of one recording into an episode of the same store, here or in a process of its own."""

import hashlib
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import structlog

from dextouch.episodes import EpisodeStore, EpisodeWriter, RecordingReader
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
    UnavailableError,
)
from dextouch.schemas import Problem, error_from_problem, json_ready, problem_from_error
from dextouch.serving import Answer, ChildProcess, configure_logging, serve_parent
from services.alignment.schemas import AlignmentReport, report_of
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization import OnProgress, Progress, progress_within
from services.alignment.synchronization.episode_builder import (
    BuiltEpisode,
    build_episode,
    check_complete,
)

logger = structlog.get_logger(__name__)

# Raised whenever alignment gives other numbers for the same recording and options.
ALIGNMENT_VERSION = 7
MAX_STEM = 100
# Refused recordings that a message lists; its details have all.
MAX_LISTED = 5
# Answering requests goes before aligning when the processor is short.
NICENESS = 5
PROGRESS_PERIOD_S = 0.2


def align_recording(
    store: EpisodeStore,
    recording_id: str,
    options: AlignmentOptions,
    on_progress: OnProgress = lambda _: None,
) -> AlignmentReport:
    """Align one recording and write the episode.

    The episode's id follows from the recording's content and the options: doing it again, even from
    two processes at once, gives the same episode. Raises NotFoundError: no such recording, or it
    was deleted meanwhile; InvalidInputError: it lacks data that an episode needs; CorruptDataError,
    StorageError: the store's bytes are damaged or cannot be written.
    """
    recording = store.recording(recording_id)
    episode_id = episode_id_of(recording, options)
    created = False
    if not store.exists(episode_id):
        episode = build_episode(
            recording, episode_id=episode_id, options=options, on_progress=on_progress
        )
        # What was read before a deletion must not come back after it.
        if not store.exists(recording_id, kind="recording"):
            raise NotFoundError(
                f"recording {recording_id!r}: it was deleted while it was aligned; no episode is "
                "written"
            )
        # Another process may write the same episode meanwhile.
        with suppress(ConflictError):
            with store.writer(kind="episode", attributes=episode.attributes) as writer:
                _write_streams(writer, episode, on_progress)
                writer.set_attributes(episode.complete_attributes())
            created = True
            logger.info("recording_aligned", recording_id=recording_id, episode_id=episode_id)
    return report_of(store.open(episode_id), recording_id=recording_id, created=created)


def check_recording(store: EpisodeStore, recording_id: str, options: AlignmentOptions) -> str:
    """Id of the episode of a recording; raises NotFoundError, or InvalidInputError without data."""
    recording = store.recording(recording_id)
    check_complete(recording)
    return episode_id_of(recording, options)


def check_recordings(
    store: EpisodeStore, recording_ids: Sequence[str], options: AlignmentOptions
) -> dict[str, str]:
    """Ids of the episodes of several; raises as `check_recording`, naming all that are refused."""
    episodes: dict[str, str] = {}
    refused: dict[str, DexTouchError] = {}
    for recording_id in recording_ids:
        try:
            episodes[recording_id] = check_recording(store, recording_id, options)
        except (NotFoundError, InvalidInputError) as error:
            if len(recording_ids) == 1:
                raise
            refused[recording_id] = error
    if refused:
        reasons = "; ".join([error.message for error in refused.values()][:MAX_LISTED])
        more = f"; and {len(refused) - MAX_LISTED} more" if len(refused) > MAX_LISTED else ""
        unknown = all(isinstance(error, NotFoundError) for error in refused.values())
        raise (NotFoundError if unknown else InvalidInputError)(
            f"alignments: {len(refused)} of {len(recording_ids)} recordings cannot be aligned, so "
            f"no job was started; omit them: {reasons}{more}",
            refused={recording_id: error.message for recording_id, error in refused.items()},
        )
    return episodes


def episode_id_of(recording: RecordingReader, options: AlignmentOptions) -> str:
    """The id of the episode that a recording becomes under these options."""
    used = options.of_task(recording.attributes.task).model_dump_json()
    identity = f"{ALIGNMENT_VERSION} {recording.content_sha256} {used}"
    digest = hashlib.sha256(identity.encode()).hexdigest()[:12]
    return f"{recording.attributes.recording_id[:MAX_STEM]}-{digest}"


class AlignmentWorker:
    """One process that aligns one recording after another."""

    def __init__(self, store_url: str, log_level: str = "warning") -> None:
        self._store_url, self._log_level = store_url, log_level
        self._child: ChildProcess | None = None
        # Guards which process there is; `stop` must not wait for an order to end.
        self._guard = threading.Lock()
        # Held while orders are sent and answers are read.
        self._in_use = threading.RLock()

    def start(self) -> None:
        """Start the process and wait until its solver is ready; raises UnavailableError."""
        with self._in_use:
            with self._guard:
                if self._child is not None and self._child.is_running:
                    return
                # One thread each: the workers share the processors.
                child = self._child = ChildProcess(
                    "services.alignment.jobs",
                    self._store_url,
                    self._log_level,
                    environment={"OMP_NUM_THREADS": "1"},
                )
            _receive(child, "the alignment process does not start")

    def run(
        self, recording_id: str, options: AlignmentOptions, on_progress: OnProgress
    ) -> AlignmentReport:
        """Align a recording; raises UnavailableError if killed, else as `align_recording`."""
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


def _write_streams(writer: EpisodeWriter, episode: BuiltEpisode, on_progress: OnProgress) -> None:
    num_streams = len(episode.streams)
    for number, stream in enumerate(episode.streams):
        name = stream.descriptor.name
        for index, block in enumerate(stream.blocks):
            if not index:
                writer.add_stream(stream.descriptor)
            writer.append(name, values=block.values, t_ref_ns=block.t_ns)
            on_progress(progress_within("writing", number / num_streams, name))


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
