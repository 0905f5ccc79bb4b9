"""Numbered batches of one unfinished upload, which its spool keeps."""

from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError
from dextouch.schemas import BatchReceipt, RecordingStatus
from dextouch.streams import read_batch


def upload_status(spool: SpoolWriter) -> RecordingStatus:
    """The batch that each stream expects next."""
    names = [stream.name for stream in spool.attributes.streams]
    return RecordingStatus(
        recording_id=spool.attributes.recording_id,
        state="open",
        next_batch={name: spool.num_batches(name) for name in names},
    )


def put_batch(spool: SpoolWriter, stream: str, number: int, data: bytes) -> BatchReceipt:
    """Store batch `number` of a stream; raises as `Ingest.put_batch`."""
    recording_id = spool.attributes.recording_id
    expected = spool.num_batches(stream)
    if number > expected:
        raise ConflictError(
            f"{recording_id} {stream}: got batch {number}, expected {expected}; "
            "send the missing ones first",
            got=number,
            expected=expected,
        )
    descriptor = next(known for known in spool.attributes.streams if known.name == stream)
    batch = read_batch(data, descriptor, number=number)
    replayed = number < expected
    if not replayed:
        spool.append_record(batch, flush=True)
    elif SpoolReader(spool.path).appended(stream, number) != batch.body:
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
        num_samples=batch.num_samples,
        replayed=replayed,
    )
