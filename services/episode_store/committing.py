"""A complete spool in, a finished recording of the store out, with bounded memory."""

from collections.abc import Callable
from pathlib import Path

from dextouch.episodes import EpisodeStore, WriteOptions
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import ENCODED_UNITS

COPY_SAMPLES = 256
COPY_BYTES = 4 << 20
# Images are some fifty thousand bytes each.
COPY_IMAGES = 32

# Moves the spool in a folder into the store, under the attributes that are known at the end.
Commit = Callable[[Path, RecordingAttributes], dict[str, int]]


def commit_spool(
    store: EpisodeStore, spool: Path, attributes: RecordingAttributes
) -> dict[str, int]:
    """Copy all samples of a closed spool into a new recording; samples by stream come back.

    Raises:
        ConflictError: the recording exists.
        CorruptDataError: the spool is damaged; nothing is written.
        StorageFullError: no space; nothing remains, the spool stays.
    """
    reader = SpoolReader(spool)
    # What a kill leaves of the copy is worth nothing: the spool has it all, and a recording that
    # was recovered from half a copy would stand in the way of the whole one.
    options = WriteOptions(recoverable=False)
    with store.writer(kind="recording", attributes=attributes, options=options) as writer:
        for name, descriptor in reader.streams.items():
            fitting = max(1, min(COPY_SAMPLES, COPY_BYTES // descriptor.sample_bytes()))
            num_samples = COPY_IMAGES if descriptor.unit in ENCODED_UNITS else fitting
            for batch in reader.batches(name, num_samples=num_samples):
                writer.append(
                    name,
                    values=batch.values,
                    t_host_ns=batch.t_host_ns,
                    t_device_ns=batch.t_device_ns,
                    sequence=batch.sequence,
                )
    return {name: reader.num_samples(name) for name in reader.streams}
