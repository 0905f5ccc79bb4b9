"""Many recordings in, one outcome each out, aligned side by side in worker processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from queue import SimpleQueue

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError, InvalidInputError
from services.alignment.jobs import check_recording
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import Progress
from services.alignment.worker import AlignmentWorker

# The recording, and how far it is.
TellOne = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: a report, or the reason why there is none."""

    recording_id: str
    report: AlignmentReport | None
    error: DexTouchError | None = None


def align_many(
    store_url: str,
    recording_ids: Sequence[str],
    options: AlignmentOptions,
    *,
    num_workers: int,
    tell: TellOne,
) -> Iterator[Outcome]:
    """Align recordings; outcomes come as they are known, and one failure hinders no other.

    Args:
        store_url: of recordings and episodes.
        recording_ids: of finished recordings.
        options: of all of them.
        num_workers: how many at once, each in a process of its own.
        tell: called with the progress of each, from several threads.
    """
    free: SimpleQueue[AlignmentWorker] = SimpleQueue()
    workers = [AlignmentWorker(store_url) for _ in range(min(num_workers, len(recording_ids)))]
    for worker in workers:
        free.put(worker)

    def align(recording_id: str) -> Outcome:
        worker = free.get()
        try:
            report = worker.run(recording_id, options, lambda p: tell(recording_id, p))
            return Outcome(recording_id, report)
        except DexTouchError as error:
            return Outcome(recording_id, None, error)
        finally:
            free.put(worker)

    threads = ThreadPoolExecutor(max(len(workers), 1), thread_name_prefix="align")
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
    """Recordings of a store that have no episode under these options, and those that never will.

    Returns:
        Ids to align, and outcomes of recordings that lack what an episode needs.
    """
    wanted, hopeless = [], []
    for recording_id in store.list(kind="recording"):
        try:
            if not store.exists(check_recording(store, recording_id, options)):
                wanted.append(recording_id)
        except InvalidInputError as error:
            hopeless.append(Outcome(recording_id, None, error))
    return wanted, hopeless
