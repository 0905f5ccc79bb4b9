"""Commit of a complete spool as a recording of the store, with bounded memory."""

from collections.abc import Callable
from pathlib import Path

from dextouch.episodes import EpisodeStore, WriteOptions
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import RecordingAttributes
from dextouch.streams import ENCODED_UNITS

COPY_SAMPLES = 256
COPY_BYTES = 4 << 20
# Images take about 50 kB each.
COPY_IMAGES = 32

# Commits the spool in a folder with its final attributes.
Commit = Callable[[Path, RecordingAttributes], dict[str, int]]


def commit_spool(
    store: EpisodeStore, spool: Path, attributes: RecordingAttributes
) -> dict[str, int]:
    """Copy a closed spool to a new recording; returns the number of samples by stream.

    Raises:
        ConflictError: the recording exists.
        CorruptDataError: the spool is damaged; nothing is written.
        StorageFullError: no space; nothing is written, the spool is kept.
    """
    reader = SpoolReader(spool)
    # Not recoverable: the spool has all data, and a recording recovered from a partial copy would
    # block the id of the complete one.
    options = WriteOptions(recoverable=False)
    with store.writer(kind="recording", attributes=attributes, options=options) as writer:
        for name, descriptor in reader.streams.items():
            fitting = max(1, min(COPY_SAMPLES, COPY_BYTES // descriptor.sample_bytes()))
            num_samples = COPY_IMAGES if descriptor.unit in ENCODED_UNITS else fitting
            for batch in reader.batches(name, num_samples=num_samples):
                writer.append(name, **vars(batch))
    return {name: reader.num_samples(name) for name in reader.streams}
