"""Saved takes of the spool come in, recordings of the episode store go out, each exactly once."""

import shutil
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import structlog

from dextouch.episodes.files import disk_errors, replace_file
from dextouch.episodes.log import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError, DexTouchError, StorageError
from dextouch.schemas.recordings import (
    BatchReceipt,
    LedgerEntry,
    RecordingAttributes,
    RecordingStatus,
)
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch
from services.acquisition.heap import give_back_free_memory
from services.acquisition.schemas import UploadStatus

logger = structlog.get_logger(__name__)

RECORDING_FILE = "recording.json"
UPLOADED_FILE = "uploaded.json"
NO_STORE = "no episode_store_url is set: takes stay in the spool"
MAX_BATCH_SAMPLES = 120
# Of pixels: half of what may travel, since a JPEG image of noise can be larger than its pixels.
MAX_BATCH_BYTES = 8 * 2**20


@runtime_checkable
class RecordingStore(Protocol):
    """What the uploader needs of a store's client; every call bears being repeated."""

    def create(self, attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload, or say where it stands."""
        ...

    def send_batch(
        self, recording_id: str, descriptor: StreamDescriptor, batch: SampleBatch, *, number: int
    ) -> BatchReceipt:
        """Send batch `number` of a stream."""
        ...

    def finish(
        self,
        recording_id: str,
        num_batches: Mapping[str, int],
        *,
        success: bool | None = None,
        ledger: tuple[LedgerEntry, ...] = (),
    ) -> RecordingStatus:
        """Announce that everything was sent."""
        ...


class Uploader:
    """Sends closed spools in the background, one after the other, until the store has them all.

    What the store acknowledged is not sent again, also not by the next process: batch n of a
    stream is always the same samples, and the store says which batch it expects next.

    Args:
        spool_root: folder of the takes.
        store: where they go; None keeps them in the spool.
        period_s: pause between two looks into the spool, and after a failure.
        keep_uploaded: whether a take stays in the spool when the store has it.
    """

    def __init__(
        self,
        spool_root: Path,
        store: RecordingStore | None,
        *,
        period_s: float,
        keep_uploaded: bool = True,
    ) -> None:
        self._spool_root = spool_root
        self._store = store
        self._period_s = period_s
        self._keep_uploaded = keep_uploaded
        self._errors: dict[str, str] = {}
        # How long the store asked to be left alone.
        self._retry_after_s = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="upload", daemon=True)

    def start(self) -> None:
        """Start looking for saved takes."""
        if self._store is not None:
            self._thread.start()

    def stop(self) -> None:
        """End the thread after the batch being sent; the rest goes on at the next start."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def status(self) -> list[UploadStatus]:
        """Every saved take, and every damaged one."""
        found = []
        for path in _spools(self._spool_root):
            error = self._errors.get(path.name)
            try:
                if not SpoolReader(path).closed:
                    continue
            except StorageError as damage:
                error = damage.message
            uploaded = (path / UPLOADED_FILE).exists()
            if self._store is None and not uploaded and error is None:
                error = NO_STORE
            found.append(UploadStatus(recording_id=path.name, uploaded=uploaded, error=error))
        return found

    def upload_all(self) -> list[str]:
        """Send every closed take that the store lacks; ids of those that it has now.

        A take that cannot be sent is reported by `status` and tried again at the next call. A
        store that is busy or full says when to come again, and is asked for nothing else before.
        """
        done = []
        self._retry_after_s = 0.0
        for path in _spools(self._spool_root):
            if (path / UPLOADED_FILE).exists() or self._stopping.is_set():
                continue
            try:
                if self._upload(path):
                    done.append(path.name)
                    self._errors.pop(path.name, None)
                    give_back_free_memory()
            except DexTouchError as error:
                if self._errors.get(path.name) != error.message:
                    logger.warning("fail_upload", recording_id=path.name, error=error.message)
                self._errors[path.name] = error.message
                if "retry_after_s" in error.details:
                    self._retry_after_s = float(str(error.details["retry_after_s"]))
                    break
        return done

    def _run(self) -> None:
        while not self._stopping.is_set():
            self.upload_all()
            self._stopping.wait(max(self._period_s, self._retry_after_s))

    def _upload(self, path: Path) -> bool:
        spool = SpoolReader(path)
        if not spool.closed or self._store is None:
            return False
        status = self._store.create(spool.attributes)
        num_batches = {}
        for name, descriptor in spool.streams.items():
            num_samples = batch_samples(descriptor)
            num_batches[name] = -(-spool.num_samples(name) // num_samples)
            if status.state == "finished":
                continue
            first = status.next_batch.get(name, 0)
            batches = spool.batches(name, num_samples=num_samples, first=first)
            for number, batch in enumerate(batches, start=first):
                if self._stopping.is_set():
                    return False
                self._store.send_batch(path.name, descriptor, batch, number=number)
        known = spool.attributes
        status = self._store.finish(
            path.name, num_batches, success=known.success, ledger=known.ledger
        )
        logger.info("upload_take", recording_id=path.name)
        # Where this fails the take is sent again: the store then answers that it has everything.
        with disk_errors(f"note the upload of {path.name!r}"):
            if self._keep_uploaded:
                replace_file(path / UPLOADED_FILE, status.model_dump_json().encode())
            else:
                shutil.rmtree(path)
        return True


def batch_samples(descriptor: StreamDescriptor) -> int:
    """Samples in each batch of a stream: fixed by what the stream is, never by chance."""
    num_bytes = descriptor.numpy_dtype().itemsize
    for size in descriptor.shape:
        num_bytes *= size
    return max(1, min(MAX_BATCH_SAMPLES, MAX_BATCH_BYTES // max(1, num_bytes)))


def recover_spool(spool_root: Path) -> list[str]:
    """Close what a killed process left open, so that it is uploaded; ids of what was recovered.

    Every acknowledged sample is kept and the recording's ledger says `interrupted`. A take that
    holds no sample is removed; one that another process is writing, or that is damaged, is left
    alone.
    """
    recovered = []
    for path in _spools(spool_root):
        try:
            if not SpoolReader(path).closed and _recover(path):
                recovered.append(path.name)
        except ConflictError:
            continue
        except StorageError as error:
            # One damaged take must not keep the station from starting; it stays for a person.
            logger.error("fail_recovery", recording_id=path.name, error=error.message)  # noqa: TRY400
    return recovered


def _recover(path: Path) -> bool:
    spool = SpoolWriter.resume(path)
    names = [descriptor.name for descriptor in spool.attributes.streams]
    if not any(spool.num_samples(name) for name in names):
        spool.abandon()
        shutil.rmtree(path)
        return False
    marks = tuple(LedgerEntry(stream=name, event="interrupted", count=1) for name in names)
    ledger = (*spool.attributes.ledger, *marks)
    spool.set_attributes(spool.attributes.model_copy(update={"ledger": ledger, "recovered": True}))
    spool.close()
    logger.warning("recover_take", recording_id=path.name)
    return True


def _spools(spool_root: Path) -> Iterator[Path]:
    if not spool_root.is_dir():
        return
    for path in sorted(spool_root.iterdir()):
        if (path / RECORDING_FILE).is_file():
            yield path
