"""A committed group on disk → attributes and slices of streams, every byte of them checked."""

import hashlib
import json
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from pydantic import ValidationError

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import (
    ATTRIBUTES_KEY,
    COMMIT_FILE,
    JPEG_END_SUFFIX,
    METADATA_FILE,
    STAMPS,
    Kind,
    array_metadata,
    array_names,
    decode_commit,
    sha256_hex,
    shard_path,
)
from dextouch.episodes.shards import ShardReader
from dextouch.errors import CorruptDataError, StorageError, UnknownNameError
from dextouch.images.jpeg import decode_jpeg
from dextouch.schemas.episodes import EpisodeAttributes, Verification
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import JPEG_UNIT
from dextouch.streams.descriptors import StreamDescriptor

A = TypeVar("A", EpisodeAttributes, RecordingAttributes)
VERIFY_BYTES = 1 << 24


class GroupReader(Generic[A]):
    """What episodes and recordings share: attributes, arrays and their verification.

    Nothing is read before it is asked for, and no file stays open.

    Args:
        folder: of a committed group.
        kind: what it must be.
        model: of its attributes.

    Raises:
        CorruptDataError: the commit record or the attributes are damaged.
        StorageError: written by a newer version of the format.
    """

    def __init__(self, folder: Path, kind: Kind, model: type[A]) -> None:
        self._folder, self._kind = folder, kind
        self._what = f"{kind} {folder.name}"
        with disk_errors(f"open {self._what}"):
            if not (folder / COMMIT_FILE).is_file():
                raise CorruptDataError(f"{self._what}: {COMMIT_FILE} is missing")
            commit = (folder / COMMIT_FILE).read_bytes()
            if not (folder / METADATA_FILE).is_file():
                raise CorruptDataError(f"{self._what}: {METADATA_FILE} is missing")
            group = (folder / METADATA_FILE).read_bytes()
        self._record, self.content_sha256 = decode_commit(commit, what=self._what)
        if (self._record.kind, self._record.id) != (kind, folder.name):
            raise CorruptDataError(
                f"{self._what}: commit record says {self._record.kind} {self._record.id}"
            )
        if sha256_hex(group) != self._record.attributes_sha256:
            raise CorruptDataError(f"{self._what}: attributes do not match their sha256")
        try:
            self.attributes: A = model.model_validate_json(
                json.dumps(json.loads(group)["attributes"][ATTRIBUTES_KEY])
            )
        except (ValidationError, ValueError, KeyError) as error:
            raise StorageError(f"{self._what}: attributes of an unknown kind ({error})") from error
        self.streams: dict[str, StreamDescriptor] = {s.name: s for s in self.attributes.streams}
        missing = [
            name
            for descriptor in self.attributes.streams
            for name in array_names(descriptor, kind)
            if name not in self._record.arrays
        ]
        if missing:
            raise CorruptDataError(f"{self._what}: arrays {missing} are not in the commit record")
        self._shards: dict[str, ShardReader] = {}
        self._whole: dict[str, np.ndarray] = {}

    def num_samples(self, name: str) -> int:
        """How many samples a stream holds; nothing is read."""
        stamp = STAMPS[self._kind][0]
        return self._record.arrays[f"{self._stream(name).name}_{stamp}"].shape[0]

    def count(self, name: str, start_ns: int | None = None, stop_ns: int | None = None) -> int:
        """How many samples `read` would give; only stamps are read."""
        low, high = self._range(name, start_ns, stop_ns)
        return high - low

    def verify(self) -> Verification:
        """Read everything and compare it with the commit record.

        Raises:
            CorruptDataError: the first array that does not hold, by name.
        """
        num_bytes = 0
        for name, entry in self._record.arrays.items():
            path = self._folder / name / METADATA_FILE
            if not path.is_file() or path.read_bytes() != array_metadata(entry):
                raise CorruptDataError(f"{self._what}: {METADATA_FILE} of {name!r} is damaged")
            shard, digest = self._shard(name), hashlib.sha256()
            row_bytes = np.dtype(entry.dtype).itemsize * int(np.prod(entry.shape[1:]))
            step = max(1, VERIFY_BYTES // max(1, row_bytes * entry.chunk_rows)) * entry.chunk_rows
            for start in range(0, entry.shape[0], step):
                data = shard.read(start, min(start + step, entry.shape[0])).tobytes()
                digest.update(data)
                num_bytes += len(data)
            if digest.hexdigest() != entry.sha256:
                raise CorruptDataError(f"{self._what}: sha256 of array {name!r} does not hold")
        return Verification(
            num_arrays=len(self._record.arrays),
            num_bytes=num_bytes,
            content_sha256=self.content_sha256,
        )

    def array_sha256(self, name: str) -> str:
        """The content hash of one array."""
        if name not in self._record.arrays:
            raise UnknownNameError("array", name, list(self._record.arrays))
        return self._record.arrays[name].sha256

    def _stream(self, name: str) -> StreamDescriptor:
        if name not in self.streams:
            raise UnknownNameError(f"stream of {self._what}", name, list(self.streams))
        return self.streams[name]

    def _shard(self, name: str) -> ShardReader:
        if name not in self._shards:
            entry = self._record.arrays[name]
            self._shards[name] = ShardReader(
                self._folder / name / shard_path(len(entry.shape)),
                entry,
                what=f"{self._what}: array {name!r}",
            )
        return self._shards[name]

    def _column(self, name: str) -> np.ndarray:
        """A whole small array (stamps, actions), read once and kept."""
        if name not in self._whole:
            column = self._shard(name).read()
            column.flags.writeable = False
            self._whole[name] = column
        return self._whole[name]

    def _range(self, name: str, start_ns: int | None, stop_ns: int | None) -> tuple[int, int]:
        stamps = self._column(f"{self._stream(name).name}_{STAMPS[self._kind][0]}")
        low = 0 if start_ns is None else int(np.searchsorted(stamps, start_ns))
        high = len(stamps) if stop_ns is None else int(np.searchsorted(stamps, stop_ns))
        return low, max(low, high)

    def _values(self, name: str, start: int, stop: int) -> np.ndarray:
        descriptor = self._stream(name)
        if descriptor.unit != JPEG_UNIT:
            return self._shard(name).read(start, stop)
        return self._images(descriptor, np.arange(start, stop))

    def _pick(self, name: str, indices: np.ndarray) -> np.ndarray:
        """Samples at ascending indices; of JPEG streams only these are decoded."""
        descriptor = self._stream(name)
        if descriptor.unit == JPEG_UNIT:
            return self._images(descriptor, indices)
        first = int(indices[0])
        return self._shard(name).read(first, int(indices[-1]) + 1)[indices - first]

    def encoded_images(self, name: str, start: int, stop: int) -> list[bytes]:
        """JPEG bytes of images start … stop-1 of a `jpeg` stream, as they are stored."""
        ends = self._column(self._stream(name).name + JPEG_END_SUFFIX)
        bounds = np.concatenate([[0], ends])
        if not (np.diff(bounds) > 0).all() or int(bounds[-1]) != self._record.arrays[name].shape[0]:
            raise CorruptDataError(f"{self._what}: image ends of {name!r} do not fit its bytes")
        if start == stop:
            return []
        first = int(bounds[start])
        data = self._shard(name).read(first, int(bounds[stop])).tobytes()
        return [
            data[int(bounds[i]) - first : int(bounds[i + 1]) - first] for i in range(start, stop)
        ]

    def _images(self, descriptor: StreamDescriptor, indices: np.ndarray) -> np.ndarray:
        images = np.empty((len(indices), *descriptor.shape), dtype=np.uint8)
        if not len(indices):
            return images
        first = int(indices[0])
        encoded = self.encoded_images(descriptor.name, first, int(indices[-1]) + 1)
        decoded: dict[int, np.ndarray] = {}
        for row, index in enumerate(int(i) for i in indices):
            if index not in decoded:
                where = f"{self._what}: {descriptor.name!r} image {index}"
                decoded[index] = decode_jpeg(encoded[index - first], where=where)
                if decoded[index].shape != descriptor.shape:
                    raise CorruptDataError(f"{where}: got {decoded[index].shape}")
            images[row] = decoded[index]
        return images
