"""Upload of saved takes from a station's spool to the episode store, each exactly once."""

import hashlib
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import structlog
from structlog.contextvars import bound_contextvars

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import ContentDigest, disk_errors, replace_file
from dextouch.episodes.maintenance import is_held
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import (
    ID_TAKEN,
    TAKE_DELETED,
    LedgerEntry,
    RecordingAttributes,
    RecordingStatus,
    StreamContent,
    UploadStatus,
)
from dextouch.streams import StreamDescriptor, decode_body, frame_body
from dextouch.tracing import in_trace, new_trace
from services.acquisition.recorder import give_back_free_memory
from services.acquisition.retention import (
    RECORDING_FILE,
    REFUSED_FILE,
    UPLOAD_STATES,
    UPLOADED_FILE,
    DeletedTakes,
    SpoolRetention,
    acknowledgement,
    empty_removed,
    remove_take,
    spooled_takes,
    upload_state,
)
from services.acquisition.settings import Retention

logger = structlog.get_logger(__name__)

# Says why a take that a killed process left could not be recovered.
DAMAGED_FILE = "damaged.txt"
# A refusal may be a passing one (an upload that expired in between), but not so often in a row.
MAX_REFUSALS = 3
# Chosen: of a proxy that says longer, the store may be back sooner.
MAX_RETRY_AFTER_S = 3600.0
REFUSALS = (ConflictError, InvalidInputError, LimitExceededError)
MAX_ID_CHARACTERS = 128
NO_STORE = "no episode_store_url is set: takes stay in the spool"
MAX_BATCH_SAMPLES = 120
# Of pixels: half of what may travel, since a JPEG image of noise can be larger than its pixels.
MAX_BATCH_BYTES = 8 * 2**20


class Uploader:
    """Sends closed spools in the background, one after the other, until the store has them all.

    Batch n of a stream is always the same samples, so that the store says which one it expects
    next. A take whose id another recording of the store has is stored under a second one,
    `second_id`; one that the store refuses permanently stays in the spool until `retry`; one that
    was deleted in the store is removed. Without a store, which `stop` closes, takes stay.
    """

    def __init__(
        self,
        spool_root: Path,
        store: EpisodeStoreClient | None,
        *,
        period_s: float,
        retention: Retention | None = None,
        deleted: DeletedTakes | None = None,
    ) -> None:
        self._spool_root = spool_root
        self._store = store
        self._period_s = period_s
        self.retention = SpoolRetention(spool_root, retention or Retention())
        self._deleted = deleted
        # The last error of each take, and how often in a row the store refused it.
        self._failures: dict[str, tuple[str, int]] = {}
        # How long the store asked to be left alone, and the take at which it did, or was away.
        self._retry_after_s = 0.0
        self._gave_up_at = ""
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
        if self._store is not None:
            self._store.close()

    @property
    def refused(self) -> Mapping[str, str]:
        """The store's reason for each quarantined take, as stored in the spool."""
        paths = sorted(self._spool_root.glob(f"*/{REFUSED_FILE}"))
        reasons = {path.parent.name: _text(path) for path in paths}
        return {name: reason for name, reason in reasons.items() if reason is not None}

    def counts(self) -> dict[str, int]:
        """Takes of the spool that wait, are uploaded, or were refused; a running one waits too."""
        found = Counter(map(upload_state, spooled_takes(self._spool_root)))
        return {state: found[state] for state in UPLOAD_STATES}

    def status(self, *, only_refused: bool = False) -> list[UploadStatus]:
        """Every saved take, and every damaged one; or those alone that the store refused."""
        found = []
        refused = [self._spool_root / name for name in self.refused]
        for path in refused if only_refused else spooled_takes(self._spool_root):
            try:
                is_closed, damage = _condition(path)
            except NotFoundError:
                continue  # removed meanwhile
            if is_closed or damage is not None:
                found.append(self._status(path, damage))
        return found

    def status_of(self, recording_id: str) -> UploadStatus:
        """One saved take.

        Raises:
            NotFoundError: no such take in the spool; uploaded ones may have been removed from it.
        """
        path = self._spool_root / recording_id
        if not (path / RECORDING_FILE).is_file():
            raise NotFoundError(
                f"take {recording_id!r}: not in the spool; see GET /v1/uploads for those that are"
            )
        return self._status(path, _condition(path)[1])

    def retry(self, recording_id: str) -> UploadStatus:
        """Send a quarantined take again.

        Raises:
            NotFoundError: there is no such quarantined take.
        """
        path = self._spool_root / recording_id
        if not (path / REFUSED_FILE).is_file():
            raise NotFoundError(
                f"take {recording_id!r}: got no such take among those that the store refused; "
                "see GET /v1/uploads"
            )
        # Forgotten first: the upload may begin as soon as the file is gone.
        self._failures.pop(recording_id, None)
        with disk_errors(f"send {recording_id!r} again"):
            (path / REFUSED_FILE).unlink(missing_ok=True)
        return self._status(path, None)

    def upload_all(self) -> list[str]:
        """Send every closed take that the store lacks; ids of those that it has now.

        A take that cannot be sent is reported by `status` and tried again at the next call, unless
        the store refused it for good. A store that is away, busy or full is asked for nothing else
        in this call: reading the logs of all takes for nothing would hold up what is recorded. The
        next call begins with the take after that one. A busy or full one says when to come again.
        """
        done = []
        self._retry_after_s = 0.0
        waiting = spooled_takes(self._spool_root)
        waiting.sort(key=lambda path: (path.name <= self._gave_up_at, path))
        self._gave_up_at = ""
        for path in waiting:
            if self._stopping.is_set():
                break
            try:
                if upload_state(path) != "waiting":
                    continue
                is_done = self._upload_traced(path)
                if is_done:
                    done.append(path.name)
                    self._failures.pop(path.name, None)
                    give_back_free_memory()
            except DexTouchError as error:
                if self._is_removed_as_deleted(path, error):
                    continue
                self._note_failure(path, error)
                if isinstance(error, UnavailableError) or "retry_after_s" in error.details:
                    asked_s = float(str(error.details.get("retry_after_s", 0.0)))
                    self._retry_after_s = min(asked_s, MAX_RETRY_AFTER_S)
                    self._gave_up_at = path.name
                    break
            except Exception as error:
                # A mistake of ours with one take must not keep all others here.
                text = f"unexpected error ({error!r}); see the service's log"
                if self._failures.get(path.name, ("", 0))[0] != text:
                    logger.exception("fail_upload", recording_id=path.name)
                self._failures[path.name] = (text, 0)
        return done

    def _status(self, path: Path, damage: str | None) -> UploadStatus:
        last_error, _ = self._failures.get(path.name, (None, 0))
        error = damage or last_error
        note, stored_as, reason = acknowledgement(path), None, _text(path / REFUSED_FILE)
        if note is not None:
            stored_as = note.recording_id
        elif reason is not None:
            error = f"the store refuses it: {reason}; it stays here until it is sent again"
        elif self._store is None and error is None:
            error = NO_STORE
        return UploadStatus(
            recording_id=path.name,
            uploaded=note is not None,
            stored_as=stored_as,
            refused=reason is not None,
            error=error,
        )

    def _is_removed_as_deleted(self, path: Path, refusal: DexTouchError) -> bool:
        """Remove a take of which the store says that it was deleted; whether it is gone."""
        if self._deleted is None or refusal.details.get("reason") != TAKE_DELETED:
            return False
        try:
            self._deleted.remove_take(path, "refused by the store as deleted")
        except StorageError as error:
            self._note_failure(path, error)
            return False
        self._failures.pop(path.name, None)
        return True

    def _note_failure(self, path: Path, error: DexTouchError) -> None:
        """Remember why a take was not sent, and set it aside once it is clear that it never is."""
        name = path.name
        last_error, num_refusals = self._failures.get(name, ("", 0))
        if last_error != error.message:
            logger.warning("fail_upload", recording_id=name, error=error.message)
        is_refusal = isinstance(error, REFUSALS) and "retry_after_s" not in error.details
        num_refusals = num_refusals + 1 if is_refusal else 0
        self._failures[name] = (error.message, num_refusals)
        if num_refusals < MAX_REFUSALS:
            return
        try:
            with disk_errors(f"set take {name!r} aside"):
                replace_file(path / REFUSED_FILE, error.message.encode())
        except StorageError as full:
            logger.warning("fail_set_aside", recording_id=name, error=full.message)
            return
        logger.error("set_take_aside", recording_id=name, error=error.message)

    def _run(self) -> None:
        problem = ""
        while not self._stopping.is_set():
            try:
                try:
                    if self._deleted is not None and self._store is not None:
                        self._deleted.remove(self._store)
                    self.upload_all()
                finally:
                    # Whatever fails, the spool must not fill up.
                    self.retention.sweep()
                problem = ""
            except StorageError as error:
                logger.warning("fail_retention", error=error.message)
            except Exception as error:
                # A mistake of ours, or a file that cannot be read, must not end uploads for good.
                if repr(error) != problem:
                    logger.exception("fail_uploads")
                problem = repr(error)
            self._stopping.wait(max(self._period_s, self._retry_after_s))

    def _upload_traced(self, path: Path) -> bool:
        """Upload in the trace of the request that saved the take."""
        spool = SpoolReader(path)
        if not spool.closed or self._store is None:
            return False
        with (
            in_trace(new_trace(spool.attributes.trace_id)) as trace,
            bound_contextvars(trace_id=trace.trace_id),
        ):
            return self._upload(path, spool, self._store)

    def _upload(self, path: Path, spool: SpoolReader, store: EpisodeStoreClient) -> bool:
        # A log that has changed is found before the store hears of the take.
        spool.scan()
        status = _begin(store, spool.attributes)
        recording_id = status.recording_id
        num_batches, content = {}, {}
        for name, descriptor in spool.streams.items():
            size, total = batch_samples(descriptor), spool.num_samples(name)
            num_batches[name] = -(-total // size)
            is_open, digest = status.state == "open", ContentDigest(descriptor)
            # What the store has already is read too: it must have the same.
            for number in range(num_batches[name]):
                if self._stopping.is_set():
                    return False
                start, stop = number * size, min((number + 1) * size, total)
                body = spool.body(name, start, stop)
                digest.add(decode_body(descriptor, body, stop - start))
                if is_open and number >= status.next_batch.get(name, 0):
                    data = frame_body(name, body, stop - start, number=number)
                    store.send_batch(recording_id, descriptor, data, number=number)
            content[name] = digest.content()
        known = spool.attributes
        status = store.finish(
            recording_id, num_batches, success=known.success, ledger=known.ledger, content=content
        )
        check_proof(status, content)
        logger.info("upload_take", recording_id=path.name, stored_as=recording_id)
        # Where this fails the take is sent again: the store then answers that it has everything.
        with disk_errors(f"note the upload of {path.name!r}"):
            replace_file(path / UPLOADED_FILE, status.model_dump_json().encode())
        return True


def check_proof(status: RecordingStatus, content: Mapping[str, StreamContent]) -> None:
    """Check that the store committed all samples of a take; only then the spool may go.

    Raises:
        UnavailableError: the store does not say, as one of an earlier release.
        ConflictError: it has others.
    """
    if not status.content:
        raise UnavailableError(
            f"{status.recording_id}: the store does not say what it has of the take, which stays "
            "here; upgrade the store"
        )
    if status.content != content:
        raise ConflictError(
            f"{status.recording_id}: the store has {status.content}, expected {dict(content)}; "
            "the take stays here"
        )


def _begin(store: EpisodeStoreClient, attributes: RecordingAttributes) -> RecordingStatus:
    """Begin an upload, under its second id where another recording has the first."""
    try:
        return store.create(attributes)
    except ConflictError as error:
        if error.details.get("reason") != ID_TAKEN:
            raise
    return store.create(attributes.model_copy(update={"recording_id": second_id(attributes)}))


def second_id(attributes: RecordingAttributes) -> str:
    """The id of a take whose first one is taken: always the same for one take, else another."""
    started = (attributes.station, attributes.started_at, attributes.started_t_host_ns)
    digest = hashlib.sha256(repr((attributes.recording_id, *map(str, started))).encode())
    suffix = f"-{digest.hexdigest()[:12]}"
    return attributes.recording_id[: MAX_ID_CHARACTERS - len(suffix)] + suffix


def ids_in_store(path: Path, about: RecordingAttributes | None) -> tuple[str, ...]:
    """The id that the store has of a take; before its upload those that it may get.

    `about` is None of a damaged take.
    """
    note = acknowledgement(path)
    if note is not None:
        return (note.recording_id,)
    return (path.name,) if about is None else (about.recording_id, second_id(about))


def batch_samples(descriptor: StreamDescriptor) -> int:
    """Samples in each batch of a stream: fixed by what the stream is, never by chance."""
    return max(1, min(MAX_BATCH_SAMPLES, MAX_BATCH_BYTES // descriptor.sample_bytes()))


def recover_spool(spool_root: Path) -> list[str]:
    """Close what a killed process left open, so that it is uploaded; ids of what was recovered.

    Every acknowledged sample is kept and the recording's ledger says `interrupted`, and what was
    cut off the log. A take that never had a sample is removed; one that another process is writing
    is left alone, and so is a damaged one, with the reason in its folder. Removals that were
    interrupted are completed.
    """
    recovered = []
    try:
        empty_removed(spool_root)
    except StorageError as error:
        logger.warning("fail_retention", error=error.message)
    for path in spooled_takes(spool_root):
        try:
            if not SpoolReader(path).closed and _recover(path):
                recovered.append(path.name)
        except ConflictError:
            continue
        except StorageError as error:
            # One damaged take must not keep the station from starting; it stays for a person.
            logger.error("fail_recovery", recording_id=path.name, error=error.message)  # noqa: TRY400
            _note_damage(path, error)
    return recovered


def _recover(path: Path) -> bool:
    if is_held(path):
        return False
    if SpoolReader(path).is_empty():
        SpoolWriter.resume(path).abandon()
        remove_take(path)
        logger.warning("remove_empty_take", recording_id=path.name)
        return False
    with SpoolWriter.resume(path) as spool:
        attributes, torn = spool.attributes.as_interrupted(), spool.torn_bytes
        # The ledger says what was cut off the log.
        marks = [(stream.name, "torn_bytes", torn) for stream in attributes.streams if torn]
        marks += [(name, "lost_to_damage", count) for name, count in spool.lost_samples.items()]
        added = (LedgerEntry(stream=name, event=event, count=count) for name, event, count in marks)
        ledger = (*attributes.ledger, *added)
        spool.set_attributes(attributes.model_copy(update={"ledger": ledger}))
    (path / DAMAGED_FILE).unlink(missing_ok=True)
    logger.warning(
        "recover_take",
        recording_id=path.name,
        num_samples={s.name: spool.num_samples(s.name) for s in spool.attributes.streams},
        torn_bytes=spool.torn_bytes,
        lost_samples=spool.lost_samples,
    )
    return True


def _note_damage(path: Path, damage: StorageError) -> None:
    try:
        with disk_errors(f"note the damage of {path.name!r}"):
            replace_file(path / DAMAGED_FILE, damage.message.encode())
    except StorageError as error:
        logger.warning("fail_note_damage", recording_id=path.name, error=error.message)


def _condition(path: Path) -> tuple[bool, str | None]:
    """Whether a take is closed, and what is wrong with it."""
    try:
        is_closed = SpoolReader(path).closed
    except StorageError as error:
        return True, error.message
    return is_closed, None if is_closed else _text(path / DAMAGED_FILE)


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None
