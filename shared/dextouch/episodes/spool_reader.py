"""Reader of a spool: attributes of the recording and verified batches of samples."""

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from dextouch.episodes.files import disk_errors
from dextouch.episodes.spool_log import read_bodies, read_records
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import (
    ENCODED_UNITS,
    SampleBatch,
    StreamDescriptor,
    decode_body,
    encode_body,
    encoded_values,
    sample_ends,
)

RECORDING_FILE = "recording.json"
CLOSED_FILE = "closed"
DEFAULT_BATCH_SAMPLES = 60


class SpoolReader:
    """Reads the complete records of a spool, even while it is being written.

    The log is scanned on first access; records appended later are not visible.

    Raises:
        NotFoundError: no spool there.
        CorruptDataError: its attributes are damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._where = path, f"spool {path.name!r}"
        self.attributes = read_attributes(path)
        self.closed = (path / CLOSED_FILE).exists()
        self.streams = {d.name: d for d in self.attributes.streams}
        self._rows: dict[str, np.ndarray] | None = None

    def num_samples(self, stream_name: str) -> int:
        """Number of samples of a stream when the log was scanned.

        Raises:
            UnknownNameError: no such stream.
            CorruptDataError: damage other than a torn tail.
        """
        return int(self._stream_rows(stream_name)["num_samples"].sum())

    def read(self, stream_name: str, start: int = 0, stop: int | None = None) -> SampleBatch:
        """Samples start … stop-1 of a stream, verified.

        Raises:
            InvalidInputError: outside the stream.
            CorruptDataError: a payload does not match its checksum.
        """
        stop = self.num_samples(stream_name) if stop is None else stop
        rows, skipped = self._span(stream_name, start, stop)
        batch = read_batch(self.path, self.streams[stream_name], rows)
        wanted = slice(skipped, skipped + stop - start)
        return SampleBatch(*(column[wanted] for column in vars(batch).values()))

    def body(self, stream_name: str, start: int, stop: int) -> bytes:
        """The bytes of samples start … stop-1 as they lie in the log; raises as `read`."""
        rows, skipped = self._span(stream_name, start, stop)
        descriptor, count = self.streams[stream_name], int(rows["num_samples"].sum())
        body = b"".join(_bodies(self.path, descriptor, rows))
        if count == stop - start:
            return body
        ends = [0, *sample_ends(descriptor, body, count, where=self._where)]
        return body[ends[skipped] : ends[skipped + stop - start]]

    def appended(self, stream_name: str, number: int) -> bytes:
        """The bytes of one append, numbered from 0.

        Raises:
            InvalidInputError: no such append.
            CorruptDataError: they do not match their checksum.
        """
        rows = self._stream_rows(stream_name)
        if not 0 <= number < len(rows):
            raise InvalidInputError(
                f"{stream_name}: got append {number}, expected within 0 … {len(rows) - 1}"
            )
        (body,) = _bodies(self.path, self.streams[stream_name], rows[number : number + 1])
        return body

    def batches(
        self, stream_name: str, *, num_samples: int = DEFAULT_BATCH_SAMPLES
    ) -> Iterator[SampleBatch]:
        """Iterate over batches of fixed size; batch n is always the same.

        A spool that is still written yields only full batches; a closed one also the last, partial
        batch.
        """
        total = self.num_samples(stream_name)
        for start in range(0, total, num_samples):
            stop = start + num_samples
            if stop <= total or self.closed:
                yield self.read(stream_name, start, min(stop, total))

    def _span(self, stream_name: str, start: int, stop: int) -> tuple[np.ndarray, int]:
        """The records with samples start … stop-1, and the number of samples in them before."""
        rows, total = self._stream_rows(stream_name), self.num_samples(stream_name)
        if not 0 <= start <= stop <= total:
            raise InvalidInputError(
                f"{stream_name}: got samples {start} … {stop}, expected within 0 … {total}"
            )
        first = int(np.searchsorted(rows["first_sample"], start, side="right")) - 1
        last = int(np.searchsorted(rows["first_sample"], stop, side="left"))
        rows = rows[max(0, first) : max(0, first, last)]
        return rows, start - int(rows["first_sample"][0]) if len(rows) else 0

    def _stream_rows(self, name: str) -> np.ndarray:
        if name not in self.streams:
            raise UnknownNameError("stream", name, list(self.streams))
        if self._rows is None:
            rows = read_records(self.path).rows
            if len(rows) and int(rows["stream"].max()) >= len(self.streams):
                raise CorruptDataError(
                    f"{self._where}: its log has a stream number "
                    f"{int(rows['stream'].max())}, {RECORDING_FILE} has {len(self.streams)} streams"
                )
            self._rows = {
                stream: rows[rows["stream"] == number] for number, stream in enumerate(self.streams)
            }
        return self._rows[name]


def read_batch(path: Path, descriptor: StreamDescriptor, rows: np.ndarray) -> SampleBatch:
    """The samples in consecutive records of one stream of a spool, verified."""
    where, counts = f"spool {path.name!r}", rows["num_samples"].tolist()
    bodies = _bodies(path, descriptor, rows)
    if descriptor.unit not in ENCODED_UNITS or not counts:
        return decode_body(descriptor, b"".join(bodies), sum(counts), where=where)
    # Images are large, and not copied once more.
    found = map(partial(decode_body, descriptor, where=where), bodies, counts)
    return SampleBatch(*map(np.concatenate, zip(*(vars(b).values() for b in found), strict=True)))


def _bodies(path: Path, descriptor: StreamDescriptor, rows: np.ndarray) -> Iterator[bytes]:
    where = f"spool {path.name!r}"
    for row, body in zip(rows, read_bodies(path, rows), strict=True):
        yield body_of(descriptor, row, body, where=where)


def body_of(descriptor: StreamDescriptor, row: np.void, body: bytes, *, where: str) -> bytes:
    """The body of a record; that of one of format 1, which holds columns, in today's layout.

    Raises:
        CorruptDataError: the record was written for another stream.
    """
    count = int(row["num_samples"])
    # Of one sample both layouts are the same.
    if not row["in_columns"] or count == 1:
        return body
    stamps, rest = body[: 24 * count], body[24 * count :]
    is_encoded, ends = descriptor.unit in ENCODED_UNITS, [-1]
    if not is_encoded:
        ends = [count * descriptor.sample_bytes()]
    elif len(rest) >= 4 * count:
        lengths = np.frombuffer(rest, "<u4", count)
        ends = [4 * count, *(4 * count + np.cumsum(lengths, dtype=np.int64)).tolist()]
    if len(rest) != ends[-1]:
        raise CorruptDataError(
            f"{where}: a record of {len(body)} bytes is not that of {count} samples of "
            f"{descriptor.name!r}; it was written for another stream"
        )
    if is_encoded:
        values = encoded_values([rest[low:high] for low, high in pairwise(ends)])
    else:
        values = np.frombuffer(rest, descriptor.numpy_dtype()).reshape(count, *descriptor.shape)
    hosts, devices, numbers = np.frombuffer(stamps, "<i8").reshape(3, count)
    return encode_body(descriptor, SampleBatch(hosts, devices, numbers, values))


def read_attributes(path: Path) -> RecordingAttributes:
    """Attributes of a spool's recording.

    Raises:
        NotFoundError: no spool there.
        CorruptDataError: attributes that cannot be read.
    """
    with disk_errors(f"open spool {path.name}"):
        if not (path / RECORDING_FILE).is_file():
            raise NotFoundError(f"spool {path.name!r}: there is none in {path.parent}")
        text = (path / RECORDING_FILE).read_bytes()
    try:
        return RecordingAttributes.model_validate_json(text)
    except ValidationError as error:
        raise CorruptDataError(f"spool {path.name!r}: {RECORDING_FILE}: {error}") from error
