"""Attributes and arrays of a committed group."""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from dextouch.episodes.format import (
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    ArrayEntry,
    Kind,
    array_metadata,
    decode_commit,
    group_attributes,
    sha256_hex,
    shard_path,
    stream_arrays,
)
from dextouch.episodes.image_codecs import ImageChunks
from dextouch.episodes.shards import ShardReader, decode_rows
from dextouch.episodes.sources import GroupFiles, OpenedGroup
from dextouch.errors import CorruptDataError, StorageError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes

A = TypeVar("A", EpisodeAttributes, RecordingAttributes)
# The largest picture of H.264 (level 6.2): 139,264 macroblocks.
MAX_IMAGE_PIXELS = 139_264 * 256


@dataclass
class GroupContents(Generic[A]):
    """A committed group, as it was when it was opened."""

    files: GroupFiles
    kind: Kind
    attributes: A
    entries: dict[str, ArrayEntry]
    content_sha256: str
    what: str
    opened: OpenedGroup
    _shards: dict[str, ShardReader] = field(default_factory=dict)

    def shard(self, name: str) -> ShardReader:
        """Reader of one array; its shard index is cached."""
        if name not in self._shards:
            entry, what = self.entries[name], f"{self.what}: array {name!r}"
            source = self.files.source(f"{name}/{shard_path(len(entry.shape))}")
            self._shards[name] = ShardReader(source, entry, what=what, group=self.opened)
        return self._shards[name]

    def inspect_array(
        self, name: str, *, progress: Callable[[int], None] = lambda _: None
    ) -> Iterator[tuple[int | None, StorageError]]:
        """Read an array of a committed group and iterate over its damage.

        Damage is the number of a storage chunk, None for the whole array, and its error. `progress`
        gets the size of every intact storage chunk, encoded, in bytes.

        Raises:
            NotFoundError: the group was deleted or replaced since it was opened.
        """
        for number, error in self._inspect_array(name, progress):
            self.opened.check_present(error)
            yield number, error

    def _inspect_array(
        self, name: str, progress: Callable[[int], None]
    ) -> Iterator[tuple[int | None, StorageError]]:
        entry, what = self.entries[name], f"{self.what}: array {name!r}"
        digest, is_whole = hashlib.sha256(), True
        try:
            metadata = self.files.get(f"{name}/{METADATA_FILE}")
            if metadata != array_metadata(entry):
                is_whole = False
                yield None, CorruptDataError(f"{what}: {METADATA_FILE} is damaged")
            shard = self.shard(name)
            num_chunks = len(shard.check_index())
        except StorageError as error:
            yield None, error
            return
        for number in range(num_chunks):
            try:
                payload = shard.payload(number)
                digest.update(hashed_bytes(payload, entry, number, what))
            except StorageError as error:
                is_whole = False
                yield number, error
            else:
                progress(len(payload))
        # Also detects damage for which a forger has adapted the checksums.
        if is_whole and digest.hexdigest() != entry.sha256:
            yield None, CorruptDataError(f"{what}: sha256 does not match")


def hashed_bytes(payload: bytes, entry: ArrayEntry, number: int, what: str) -> bytes | memoryview:
    """Bytes of a storage chunk that enter its array's hash.

    Images are decoded, since intact bytes of a damaged image are damage, too.

    Raises:
        CorruptDataError: it does not contain the expected rows, or an image cannot be decoded.
    """
    where = f"{what}: storage chunk {number}"
    num_rows = min(entry.chunk_rows, entry.shape[0] - number * entry.chunk_rows)
    if entry.codec == "zstd":
        return decode_rows(payload, entry, what=where)[:num_rows].data
    chunks = ImageChunks(entry.codec, entry.shape[1:], entry.chunk_rows, what)
    images = chunks.unpack(payload, number)
    if len(images) != num_rows:
        raise CorruptDataError(f"{where} holds {len(images)} images, expected {num_rows}")
    chunks.check(payload, number)
    return payload


def read_group(files: GroupFiles, model: type[A]) -> GroupContents[A]:
    """Open a committed group; arrays are read lazily.

    Raises:
        CorruptDataError: the commit record or the attributes are damaged.
        NotFoundError: it was deleted or replaced while it was opened.
        StorageError: written by another version of the format.
    """
    kind: Kind = "episode" if issubclass(model, EpisodeAttributes) else "recording"
    what = f"{kind} {files.item_id}"
    commit = files.get(COMMIT_FILE)
    if commit is None:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is missing")
    opened = OpenedGroup(files, COMMIT_FILE, sha256_hex(commit), what)
    try:
        return _read_group(opened, commit, kind, model)
    except StorageError as error:
        opened.check_present(error)
        raise


def _read_group(opened: OpenedGroup, commit: bytes, kind: Kind, model: type[A]) -> GroupContents[A]:
    files, what = opened.files, opened.what
    group = files.get(METADATA_FILE)
    record, content_sha256 = decode_commit(commit, what=what)
    if group is None:
        raise CorruptDataError(f"{what}: {METADATA_FILE} is missing")
    if (record.kind, record.id) != (kind, files.item_id):
        raise CorruptDataError(f"{what}: commit record says {record.kind} {record.id}")
    if sha256_hex(group) != record.attributes_sha256:
        raise CorruptDataError(f"{what}: attributes do not match their sha256")
    try:
        attributes = group_attributes(group, model)
        expected = {stream.name: stream_arrays(stream, kind) for stream in attributes.streams}
    except MALFORMED as error:
        raise StorageError(f"{what}: attributes are invalid ({error})") from error
    _check_arrays(expected, record.arrays, what)
    return GroupContents(files, kind, attributes, record.arrays, content_sha256, what, opened)


def _check_arrays(
    expected: Mapping[str, Mapping[str, ArrayEntry]], arrays: Mapping[str, ArrayEntry], what: str
) -> None:
    """Check that the commit record's arrays match the streams and have consistent lengths."""
    names: list[str] = []
    for stream, wanted in expected.items():
        names += wanted
        missing = [name for name in wanted if name not in arrays]
        if missing:
            raise CorruptDataError(f"{what}: arrays {missing} are not in the commit record")
        for name, entry in wanted.items():
            got = arrays[name]
            if _layout(got) != _layout(entry) or len({arrays[n].shape[0] for n in wanted}) != 1:
                raise CorruptDataError(
                    f"{what}: commit record says {got.dtype} {got.shape} {got.codec} of array "
                    f"{name!r}, which is not what the attributes say of stream {stream!r}"
                )
            if got.codec != "zstd" and math.prod(got.shape[1:3]) > MAX_IMAGE_PIXELS:
                raise CorruptDataError(
                    f"{what}: images of {name!r} are {got.shape[1]} x {got.shape[2]} pixels, "
                    f"expected at most {MAX_IMAGE_PIXELS} in all"
                )
    foreign = sorted(set(arrays) - set(names))
    if foreign or len(set(names)) != len(names):
        raise CorruptDataError(
            f"{what}: commit record lists arrays {foreign or sorted(names)}, "
            f"expected those of {len(expected)} streams, each once"
        )


def _layout(entry: ArrayEntry) -> tuple[object, ...]:
    return entry.dtype, entry.shape[1:], entry.codec
