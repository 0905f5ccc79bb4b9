"""Upgrade of a group from format version 1 to the current version.

Version 1 had no `h264` and kept concatenated JPEG images in one array of bytes, with an array of
their end offsets. Attributes, stamps and numbers are the same in both.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from dextouch.episodes.format import (
    ATTRIBUTES,
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Attributes,
    Kind,
    decode_commit,
    group_attributes,
    open_commit,
    sha256_hex,
    shard_path,
)
from dextouch.episodes.shards import ShardReader
from dextouch.episodes.sources import GroupFiles
from dextouch.episodes.writer import Block
from dextouch.errors import CorruptDataError
from dextouch.schemas import LineageEntry
from dextouch.streams import JPEG_UNIT, StreamDescriptor, encoded_values

OLD_VERSION = 1
BLOCK_SAMPLES = 256
_JPEG_END_SUFFIX = "_end"


class OldGroup:
    """A group of format version 1, with the checks of its release.

    Raises:
        CorruptDataError: the commit record, the attributes or an array is damaged.
    """

    def __init__(self, files: GroupFiles, kind: Kind) -> None:
        self._files, self._kind, self._what = files, kind, f"{kind} {files.item_id}"
        commit, group = files.get(COMMIT_FILE), files.get(METADATA_FILE)
        record, digest, _ = open_commit(commit or b"", what=self._what)
        try:
            if sha256_hex(group or b"") != record["attributes_sha256"]:
                raise CorruptDataError(f"{self._what}: attributes do not match their sha256")
            self._entries = {
                name: ArrayEntry.model_validate(entry) for name, entry in record["arrays"].items()
            }
            attributes: Attributes = group_attributes(group or b"", ATTRIBUTES[kind])
        except (*MALFORMED, AttributeError) as error:
            raise CorruptDataError(
                f"{self._what}: is not a group of version 1 ({error})"
            ) from error
        before = LineageEntry(kind=kind, id=files.item_id, sha256=str(digest))
        # With the migrated content in their lineage.
        self.attributes = attributes.model_copy(update={"lineage": (*attributes.lineage, before)})

    def blocks(self, stream: StreamDescriptor) -> Iterator[Block]:
        """Iterate over values and stamps of a stream in blocks, verifying every byte."""
        stamps = {
            stamp: self._shard(f"{stream.name}_{stamp}").read() for stamp in STAMPS[self._kind]
        }
        count = len(next(iter(stamps.values())))
        for start in range(0, count, BLOCK_SAMPLES):
            stop = min(start + BLOCK_SAMPLES, count)
            values = self._values(stream, start, stop)
            yield values, {name: column[start:stop] for name, column in stamps.items()}

    def _values(self, stream: StreamDescriptor, start: int, stop: int) -> np.ndarray:
        if stream.unit != JPEG_UNIT:
            return self._shard(stream.name).read(start, stop)
        bounds = np.concatenate([[0], self._shard(stream.name + _JPEG_END_SUFFIX).read()])
        if not (np.diff(bounds) > 0).all():
            raise CorruptDataError(f"{self._what}: image ends of {stream.name!r} do not rise")
        first, last = int(bounds[start]), int(bounds[stop])
        data = self._shard(stream.name).read(first, last).tobytes()
        ends = [int(end) - first for end in bounds[start : stop + 1]]
        return encoded_values([data[low:high] for low, high in pairwise(ends)])

    def _shard(self, name: str) -> ShardReader:
        if name not in self._entries:
            raise CorruptDataError(f"{self._what}: array {name!r} is not in the commit record")
        entry = self._entries[name]
        source = self._files.source(f"{name}/{shard_path(len(entry.shape))}")
        return ShardReader(source, entry, what=f"{self._what}: array {name!r}")


def is_current(files: GroupFiles, *, what: str) -> bool:
    """Whether a group is of the current version.

    Raises:
        CorruptDataError: the commit record is damaged.
        StorageError: a newer version.
    """
    data = files.get(COMMIT_FILE) or b""
    if open_commit(data, what=what)[2] == OLD_VERSION:
        return False
    decode_commit(data, what=what)
    return True
