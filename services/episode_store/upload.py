"""Numbered batches of one unfinished recording → its spool and receipts, which always agree."""

import hashlib

from dextouch.episodes.log import SpoolWriter
from dextouch.errors import ConflictError, UnknownNameError
from dextouch.schemas.recordings import BatchReceipt, RecordingAttributes, RecordingStatus
from dextouch.streams.wire import decode_batch
from services.episode_store.receipts import Receipts


class Upload:
    """One unfinished recording; for one thread at a time.

    Args:
        spool: of the recording, open for writing.
        sync: whether an acknowledged batch survives a power loss.
    """

    def __init__(self, spool: SpoolWriter, *, sync: bool) -> None:
        self._spool = spool
        self._sync = sync
        self._streams = {stream.name: stream for stream in spool.attributes.streams}
        self._receipts = {name: Receipts(spool.path / f"{name}.receipts") for name in self._streams}
        for name, receipts in self._receipts.items():
            # What was written but never acknowledged comes again.
            spool.truncate(name, receipts.num_samples)

    @property
    def attributes(self) -> RecordingAttributes:
        """As they were announced."""
        return self._spool.attributes

    def status(self) -> RecordingStatus:
        """The batch that each stream expects next."""
        return RecordingStatus(
            recording_id=self.attributes.recording_id,
            state="open",
            next_batch={name: len(receipts) for name, receipts in self._receipts.items()},
        )

    def put(self, stream: str, number: int, data: bytes) -> BatchReceipt:
        """Take batch `number` of a stream in; raises as `Ingest.put_batch`."""
        if stream not in self._receipts:
            raise UnknownNameError("stream", stream, list(self._receipts))
        receipts, recording_id = self._receipts[stream], self.attributes.recording_id
        if number > len(receipts):
            raise ConflictError(
                f"{recording_id} {stream}: got batch {number}, expected {len(receipts)}; "
                "send the missing ones first",
                got=number,
                expected=len(receipts),
            )
        replayed = number < len(receipts)
        if replayed:
            if hashlib.sha256(data).digest() != receipts[number].sha256:
                raise ConflictError(
                    f"{recording_id} {stream}: batch {number} is here with other bytes; "
                    "a batch never changes",
                    got=number,
                    expected=len(receipts),
                )
        else:
            self._append(stream, number, data)
        before = receipts[number - 1].end_sample if number else 0
        return BatchReceipt(
            recording_id=recording_id,
            stream=stream,
            number=number,
            num_samples=receipts[number].end_sample - before,
            replayed=replayed,
        )

    def close(self) -> None:
        """Mark the spool as complete and give all files back."""
        self._spool.close()
        self._close_receipts()

    def abandon(self) -> None:
        """Give all files back; the upload can be gone on with."""
        self._spool.abandon()
        self._close_receipts()

    def _close_receipts(self) -> None:
        for receipts in self._receipts.values():
            receipts.close()

    def _append(self, stream: str, number: int, data: bytes) -> None:
        receipts = self._receipts[stream]
        batch = decode_batch(data, self._streams[stream], number=number)
        self._spool.append(stream, batch)
        acknowledged = False
        try:
            self._spool.flush()
            end_sample = self._spool.num_samples(stream)
            receipts.append(data, end_sample=end_sample, sync=self._sync)
            acknowledged = True
        finally:
            if not acknowledged:
                self._spool.truncate(stream, receipts.num_samples)
