"""One unfinished upload: numbered batches appended to its spool."""

import numpy as np

from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError, UnknownNameError
from dextouch.schemas import BatchReceipt, RecordingAttributes, RecordingStatus
from dextouch.streams import SampleBatch, decode_batch


class Upload:
    """One unfinished recording; not thread-safe.

    Args:
        spool: of the recording, open for writing.
    """

    def __init__(self, spool: SpoolWriter) -> None:
        self._spool = spool
        self._streams = {stream.name: stream for stream in spool.attributes.streams}

    @property
    def attributes(self) -> RecordingAttributes:
        """Attributes given when the upload began."""
        return self._spool.attributes

    def status(self) -> RecordingStatus:
        """The batch that each stream expects next."""
        return RecordingStatus(
            recording_id=self.attributes.recording_id,
            state="open",
            next_batch={name: self._spool.num_batches(name) for name in self._streams},
        )

    def put(self, stream: str, number: int, data: bytes) -> BatchReceipt:
        """Store batch `number` of a stream; raises as `Ingest.put_batch`."""
        if stream not in self._streams:
            raise UnknownNameError("stream", stream, list(self._streams))
        expected, recording_id = self._spool.num_batches(stream), self.attributes.recording_id
        if number > expected:
            raise ConflictError(
                f"{recording_id} {stream}: got batch {number}, expected {expected}; "
                "send the missing ones first",
                got=number,
                expected=expected,
            )
        batch = decode_batch(data, self._streams[stream], number=number)
        replayed = number < expected
        if not replayed:
            self._spool.append(stream, batch, flush=True)
        elif not _same(SpoolReader(self._spool.path).appended(stream, number), batch):
            raise ConflictError(
                f"{recording_id} {stream}: batch {number} exists with other samples; "
                "batches are immutable",
                got=number,
                expected=expected,
            )
        return BatchReceipt(
            recording_id=recording_id,
            stream=stream,
            number=number,
            num_samples=len(batch),
            replayed=replayed,
        )

    def close(self) -> None:
        """Mark the spool as complete and close all files."""
        self._spool.close()

    def abandon(self) -> None:
        """Close all files; the upload can be continued."""
        self._spool.abandon()


def _same(ours: SampleBatch, theirs: SampleBatch) -> bool:
    """Whether two batches hold the same samples; a NaN equals itself, -0.0 is not 0.0."""
    columns = ("t_host_ns", "t_device_ns", "sequence")
    if not all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in columns):
        return False
    if ours.values.dtype == object:
        return bool(np.array_equal(ours.values, theirs.values))
    return ours.values.tobytes() == theirs.values.tobytes()
