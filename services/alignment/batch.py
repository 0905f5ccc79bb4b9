"""Alignment of many recordings in parallel worker processes, as `dextouch align run` does it."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError, InvalidInputError
from services.alignment.jobs import check_recording
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import Progress
from services.alignment.worker import AlignmentWorker

# The recording, and how far it is.
OnRecordingProgress = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Outcome:
    """Result for one recording: its report, or the error that prevented it."""

    recording_id: str
    report: AlignmentReport | None
    error: DexTouchError | None = None


def align_batch(
    store_url: str,
    recording_ids: Sequence[str],
    options: AlignmentOptions,
    *,
    num_workers: int,
    on_progress: OnRecordingProgress,
) -> Iterator[Outcome]:
    """Align recordings in parallel; yields outcomes as they complete. Failures do not stop others.

    `num_workers` are aligned at the same time, each in its own process; `on_progress` is called
    from several threads.
    """
    workers: list[AlignmentWorker] = []
    mine = threading.local()

    def start() -> None:
        mine.worker = AlignmentWorker(store_url)
        workers.append(mine.worker)

    def align(recording_id: str) -> Outcome:
        try:
            report = mine.worker.run(recording_id, options, lambda p: on_progress(recording_id, p))
            return Outcome(recording_id, report)
        except DexTouchError as error:
            return Outcome(recording_id, None, error)

    threads = ThreadPoolExecutor(num_workers, thread_name_prefix="align", initializer=start)
    try:
        for ready in as_completed([threads.submit(align, one) for one in recording_ids]):
            yield ready.result()
    finally:
        # Also when the caller goes away in the middle (Ctrl-C).
        threads.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.stop()
        threads.shutdown()


def not_aligned(store: EpisodeStore, options: AlignmentOptions) -> tuple[list[str], list[Outcome]]:
    """Recordings of a store without an episode under these options.

    Returns:
        Ids to align, and failed outcomes of recordings that cannot become an episode.
    """
    wanted, impossible = [], []
    for recording_id in store.list(kind="recording"):
        try:
            if not store.exists(check_recording(store, recording_id, options)):
                wanted.append(recording_id)
        except InvalidInputError as error:
            impossible.append(Outcome(recording_id, None, error))
    return wanted, impossible
