"""Reader of a spool: attributes of the recording and verified batches of samples."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from dextouch.episodes.batch_bytes import batch_of_bytes
from dextouch.episodes.files import disk_errors
from dextouch.episodes.spool_log import read_bodies, read_records
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor

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
        self.path = path
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
        total = self.num_samples(stream_name)
        stop = total if stop is None else stop
        if not 0 <= start <= stop <= total:
            raise InvalidInputError(
                f"{stream_name}: got samples {start} … {stop}, expected within 0 … {total}"
            )
        rows = self._stream_rows(stream_name)
        first = int(np.searchsorted(rows["first_sample"], start, side="right")) - 1
        last = int(np.searchsorted(rows["first_sample"], stop, side="left"))
        rows = rows[max(0, first) : max(0, first, last)]
        batch = read_batch(self.path, self.streams[stream_name], rows)
        skipped = start - int(rows["first_sample"][0]) if len(rows) else 0
        wanted = slice(skipped, skipped + stop - start)
        return SampleBatch(*(column[wanted] for column in vars(batch).values()))

    def appended(self, stream_name: str, number: int) -> SampleBatch:
        """The samples of one append, numbered from 0.

        Raises:
            InvalidInputError: no such append.
            CorruptDataError: they do not match their checksum.
        """
        rows = self._stream_rows(stream_name)
        if not 0 <= number < len(rows):
            raise InvalidInputError(
                f"{stream_name}: got append {number}, expected within 0 … {len(rows) - 1}"
            )
        return read_batch(self.path, self.streams[stream_name], rows[number : number + 1])

    def batches(
        self, stream_name: str, *, num_samples: int = DEFAULT_BATCH_SAMPLES, first: int = 0
    ) -> Iterator[SampleBatch]:
        """Iterate over batches of fixed size from number `first` on; batch n is always the same.

        A spool that is still written yields only full batches; a closed one also the last, partial
        batch.
        """
        total = self.num_samples(stream_name)
        for start in range(first * num_samples, total, num_samples):
            stop = start + num_samples
            if stop <= total or self.closed:
                yield self.read(stream_name, start, min(stop, total))

    def _stream_rows(self, name: str) -> np.ndarray:
        if name not in self.streams:
            raise UnknownNameError("stream", name, list(self.streams))
        if self._rows is None:
            rows = read_records(self.path).rows
            if len(rows) and int(rows["stream"].max()) >= len(self.streams):
                raise CorruptDataError(
                    f"spool {self.path.name!r}: its log has a stream number "
                    f"{int(rows['stream'].max())}, {RECORDING_FILE} has {len(self.streams)} streams"
                )
            self._rows = {
                stream: rows[rows["stream"] == number] for number, stream in enumerate(self.streams)
            }
        return self._rows[name]


def read_batch(path: Path, descriptor: StreamDescriptor, rows: np.ndarray) -> SampleBatch:
    """The samples in consecutive records of one stream of a spool, verified."""
    counts = rows["num_samples"].tolist()
    bodies = read_bodies(path, rows)
    return batch_of_bytes(descriptor, bodies, counts, what=f"spool {path.name!r}")


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
