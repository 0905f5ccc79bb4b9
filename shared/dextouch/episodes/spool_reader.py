"""A spool folder → its recording's attributes and checked batches of samples."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from dextouch.episodes.files import disk_errors
from dextouch.episodes.journal import SAMPLE_JOURNAL, journal_path, read_payloads, read_rows
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import ENCODED_UNITS
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch, encoded_values

RECORDING_FILE = "recording.json"
CLOSED_FILE = "closed"
DEFAULT_BATCH_SAMPLES = 60


class SpoolReader:
    """Reads a spool, even while it is written: every sample whose row is whole.

    A stream's journal is read when the stream is first asked for; what comes later is not seen.

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
        self._rows: dict[str, np.ndarray] = {}

    def num_samples(self, stream_name: str) -> int:
        """How many samples a stream held when it was first asked for.

        Raises:
            UnknownNameError: no such stream.
            CorruptDataError: damage that is no torn end.
        """
        return len(self._stream_rows(stream_name))

    def read(self, stream_name: str, start: int = 0, stop: int | None = None) -> SampleBatch:
        """Samples start … stop-1 of a stream, each checked.

        Raises:
            InvalidInputError: outside the stream.
            CorruptDataError: a payload does not match its checksum.
        """
        rows = self._stream_rows(stream_name)
        stop = len(rows) if stop is None else stop
        if not 0 <= start <= stop <= len(rows):
            raise InvalidInputError(
                f"{stream_name}: got samples {start} … {stop}, expected within 0 … {len(rows)}"
            )
        rows = rows[start:stop]
        payloads = read_payloads(self.path, stream_name, rows)
        return SampleBatch(
            rows["t_host_ns"].astype(np.int64),
            rows["t_device_ns"].astype(np.int64),
            rows["sequence"].astype(np.int64),
            _values(self.streams[stream_name], payloads),
        )

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

    def _stream_rows(self, name: str) -> np.ndarray:
        if name not in self.streams:
            raise UnknownNameError("stream", name, list(self.streams))
        if name not in self._rows:
            if not journal_path(self.path, name).exists():
                raise CorruptDataError(f"spool {self.path.name!r}: journal of {name!r} is missing")
            self._rows[name] = read_rows(self.path, name, SAMPLE_JOURNAL)
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


def _values(descriptor: StreamDescriptor, payloads: list[bytes]) -> np.ndarray:
    if descriptor.unit in ENCODED_UNITS:
        return encoded_values(payloads)
    values = np.frombuffer(b"".join(payloads), dtype=descriptor.numpy_dtype())
    return values.reshape(len(payloads), *descriptor.shape)
