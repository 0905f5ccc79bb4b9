"""A spool folder → its recording's attributes and checked batches of samples."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from dextouch.episodes.batch_bytes import batch_of_bytes
from dextouch.episodes.files import disk_errors
from dextouch.episodes.spool_log import read_bodies, read_records
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.samples import SampleBatch

RECORDING_FILE = "recording.json"
CLOSED_FILE = "closed"
DEFAULT_BATCH_SAMPLES = 60


class SpoolReader:
    """Reads a spool, even while it is written: every sample whose record is whole.

    The log is looked through when a stream is first asked for; what comes later is not seen.

    Args:
        path: of the spool.

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
        """How many samples a stream held when the log was looked through.

        Raises:
            UnknownNameError: no such stream.
            CorruptDataError: damage that is no torn end.
        """
        return int(self._stream_rows(stream_name)["num_samples"].sum())

    def read(self, stream_name: str, start: int = 0, stop: int | None = None) -> SampleBatch:
        """Samples start … stop-1 of a stream, each checked.

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
        batch = self._batch(stream_name, rows)
        skipped = start - int(rows["first_sample"][0]) if len(rows) else 0
        wanted = slice(skipped, skipped + stop - start)
        return SampleBatch(
            batch.t_host_ns[wanted],
            batch.t_device_ns[wanted],
            batch.sequence[wanted],
            batch.values[wanted],
        )

    def appended(self, stream_name: str, number: int) -> SampleBatch:
        """The samples of one append, the first being number 0.

        Raises:
            InvalidInputError: there were not so many.
            CorruptDataError: they do not match their checksum.
        """
        rows = self._stream_rows(stream_name)
        if not 0 <= number < len(rows):
            raise InvalidInputError(
                f"{stream_name}: got append {number}, expected within 0 … {len(rows) - 1}"
            )
        return self._batch(stream_name, rows[number : number + 1])

    def batches(
        self, stream_name: str, *, num_samples: int = DEFAULT_BATCH_SAMPLES, first: int = 0
    ) -> Iterator[SampleBatch]:
        """Batches first, first + 1, … of fixed size, so that batch n is always the same.

        Of a spool that is still written only full batches come; of a closed one also the rest.
        """
        total = self.num_samples(stream_name)
        for start in range(first * num_samples, total, num_samples):
            stop = start + num_samples
            if stop <= total or self.closed:
                yield self.read(stream_name, start, min(stop, total))

    def _batch(self, name: str, rows: np.ndarray) -> SampleBatch:
        return batch_of_bytes(
            self.streams[name],
            read_bodies(self.path, rows),
            rows["num_samples"].tolist(),
            what=f"spool {self.path.name!r}",
        )

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


def read_attributes(path: Path) -> RecordingAttributes:
    """The attributes of a spool's recording.

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
