"""Committed groups: their attributes and arrays, and random access to samples of their streams."""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Int64

from dextouch.episodes.encoded_images import (
    EncodedImages,
    GroupChunks,
    IndexedBytes,
    inspect_chunks,
    inspect_images,
)
from dextouch.episodes.files import GroupFiles, OpenedGroup
from dextouch.episodes.format import (
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Kind,
    Version,
    array_metadata,
    attributes_id,
    decode_commit,
    group_attributes,
    image_codec,
    index_name,
    sha256_hex,
    shard_path,
    stream_arrays,
)
from dextouch.episodes.image_codecs import FULL_FORM, ImageForm, ImageGroups, transform_pixels
from dextouch.episodes.shards import ShardReader
from dextouch.episodes.trash import NOTES_FILE, read_remark
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnknownNameError,
)
from dextouch.geometry import nearest_index
from dextouch.schemas import EpisodeAttributes, ItemNotes, RecordingAttributes, Verification
from dextouch.streams import StreamDescriptor

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
    version: Version
    _shards: dict[str, ShardReader] = field(default_factory=dict)
    _images: dict[str, EncodedImages] = field(default_factory=dict)

    def shard(self, name: str) -> ShardReader:
        """Reader of one array; its shard index is cached."""
        if name not in self._shards:
            entry, what = self.entries[name], f"{self.what}: array {name!r}"
            source = self.files.source(f"{name}/{shard_path(len(entry.shape))}")
            self._shards[name] = ShardReader(source, entry, what=what, group=self.opened)
        return self._shards[name]

    def images(self, descriptor: StreamDescriptor) -> EncodedImages | None:
        """The encoded images of a stream, and what was cached of them; None of other streams."""
        name, codec = descriptor.name, image_codec(descriptor)
        if codec is None:
            return None
        if name not in self._images:
            groups = ImageGroups(codec, descriptor.shape, f"{self.what}: array {name!r}")
            self._images[name] = (
                GroupChunks(groups, self.shard(name))
                if self.version == 2
                else IndexedBytes(groups, self.shard(name), self.shard(index_name(name)))
            )
        return self._images[name]

    def inspect_array(
        self, name: str, *, progress: Callable[[int], None] = lambda _: None
    ) -> Iterator[tuple[int | None, StorageError]]:
        """Iterate over the damage of an array: number of a storage chunk (None for all) and error.

        `image` in the details of an error is the damaged image. `progress` gets the size of every
        intact storage chunk, encoded, in bytes. Raises NotFoundError if the group was deleted or
        replaced since it was opened.
        """
        for number, error in self._inspect_array(name, progress):
            self.opened.check_present(error)
            yield number, error

    def _inspect_array(
        self, name: str, progress: Callable[[int], None]
    ) -> Iterator[tuple[int | None, StorageError]]:
        entry, what = self.entries[name], f"{self.what}: array {name!r}"
        is_whole = True
        try:
            metadata = self.files.get(f"{name}/{METADATA_FILE}")
            if metadata != array_metadata(entry):
                is_whole = False
                yield None, CorruptDataError(f"{what}: {METADATA_FILE} is damaged")
            self.shard(name).check_index()
        except StorageError as error:
            yield None, error
            return
        digest = hashlib.sha256()
        stream = next((s for s in self.attributes.streams if s.name == name), None)
        images = None if stream is None else self.images(stream)
        if isinstance(images, IndexedBytes):
            # Without its index, whose damage is another finding, the hash cannot be computed.
            is_whole &= images.has_index()
            found = inspect_images(self.shard(name), images, digest.update, progress)
        else:
            found = inspect_chunks(self.shard(name), images, digest.update, progress)
        for number, damage in found:
            is_whole = False
            yield number, damage
        # Also detects damage for which a forger has adapted the checksums.
        if is_whole and digest.hexdigest() != entry.sha256:
            yield None, CorruptDataError(f"{what}: sha256 does not match")


def read_group(files: GroupFiles, model: type[A]) -> GroupContents[A]:
    """Open a committed group; arrays are read lazily.

    Raises CorruptDataError for a damaged commit record or attributes, StorageError for another
    version of the format, NotFoundError if the group was deleted or replaced meanwhile.
    """
    kind: Kind = "episode" if issubclass(model, EpisodeAttributes) else "recording"
    what = f"{kind} {files.item_id}"
    commit = files.get(COMMIT_FILE)
    if commit is None:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is missing")
    opened = OpenedGroup(files, sha256_hex(commit), what)
    with opened.present():
        return _read_group(opened, commit, kind, model)


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
        expected = {
            stream.name: _arrays_of(stream, kind, record.format_version)
            for stream in attributes.streams
        }
    except MALFORMED as error:
        raise StorageError(f"{what}: attributes are invalid ({error})") from error
    _check_arrays(expected, record.arrays, what)
    for stream in attributes.streams:
        if image_codec(stream) and math.prod(stream.shape[:2]) > MAX_IMAGE_PIXELS:
            raise CorruptDataError(
                f"{what}: images of {stream.name!r} are {stream.shape[0]} x {stream.shape[1]} "
                f"pixels, expected at most {MAX_IMAGE_PIXELS} in all"
            )
    return GroupContents(
        files, kind, attributes, record.arrays, content_sha256, what, opened, record.format_version
    )


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
            # Encoded images of v3 have one row for each byte.
            lengths = {arrays[n].shape[0] for n, one in wanted.items() if one.codec != "bytes"}
            if _layout(got) != _layout(entry) or len(lengths) != 1:
                raise CorruptDataError(
                    f"{what}: commit record says {got.dtype} {got.shape} {got.codec} of array "
                    f"{name!r}, which is not what the attributes say of stream {stream!r}"
                )
    foreign = sorted(set(arrays) - set(names))
    if foreign or len(set(names)) != len(names):
        raise CorruptDataError(
            f"{what}: commit record lists arrays {foreign or sorted(names)}, "
            f"expected those of {len(expected)} streams, each once"
        )


# Most episodes of a store have the same streams.
_arrays_of = lru_cache(1024)(stream_arrays)


def _layout(entry: ArrayEntry) -> tuple[object, ...]:
    # Bytes of encoded images lie at places that follow from the size of their storage chunks.
    rows = entry.chunk_rows if entry.codec == "bytes" else None
    return entry.dtype, entry.shape[1:], entry.codec, rows


class GroupReader(Generic[A]):
    """Common base of episode and recording readers: attributes, arrays and verification.

    Everything is read lazily. A reader is thread-safe and picklable, so that the worker processes
    of a data loader can use it.
    """

    def __init__(self, contents: GroupContents[A]) -> None:
        self._contents: GroupContents[A] = contents
        self._kind, self._what = contents.kind, contents.what
        self.attributes: A = contents.attributes
        self.item_id = attributes_id(contents.attributes)
        self.content_sha256 = contents.content_sha256
        self.streams: dict[str, StreamDescriptor] = {s.name: s for s in self.attributes.streams}
        self._whole: dict[str, np.ndarray] = {}
        # By stream and group: how many of its first images can be decoded.
        self._num_decodable: dict[tuple[str, int], int] = {}
        # Cached since every window needs them.
        stamp = STAMPS[self._kind][0]
        self._stamps = {name: f"{name}_{stamp}" for name in self.streams}

    def num_samples(self, name: str) -> int:
        """Number of samples of a stream, without reading it."""
        return self._contents.entries[self._stamps[self._stream(name).name]].shape[0]

    def count(self, name: str, start_ns: int | None = None, stop_ns: int | None = None) -> int:
        """Number of samples of a time span, damaged images included; reads only the stamps."""
        low, high = self._range(name, start_ns, stop_ns)
        return high - low

    def stamps_ns(self, name: str) -> np.ndarray:
        """The stamps by which a stream is sorted, int64 [n], read-only."""
        return self._column(self._stamps[self._stream(name).name])

    def values(self, name: str, start: int, stop: int) -> np.ndarray:
        """Values of samples start … stop−1; images come decoded.

        Raises UnknownNameError without the stream, InvalidInputError for samples outside of it,
        CorruptDataError for damaged bytes.
        """
        self._check_span("samples", name, start, stop)
        return self._values(name, start, stop)

    def images(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Images start … stop−1 (None for all) of a camera, uint8 [n, h, w, channels].

        Raises as `values`, and InvalidInputError for a stream without images.
        """
        stop = self.num_samples(name) if stop is None else stop
        self._check_span("images", name, start, stop)
        # A forged length must not be expanded to a list of numbers.
        stored = self._contents.images(self.streams[name])
        (self._contents.shard(name).check_index if stored is None else stored.check_claim)()
        return self.images_at(name, np.arange(start, stop))

    def images_at(
        self, name: str, indices: np.ndarray, *, form: ImageForm = FULL_FORM
    ) -> np.ndarray:
        """Images of a camera at non-decreasing indices, or half their size or gray; as `images`."""
        descriptor: StreamDescriptor = self._stream(name)
        if descriptor.kind != "image":
            raise InvalidInputError(f"{self._what}: {name!r} holds no images")
        if len(indices):
            self._check_span("images", name, int(indices[0]), int(indices[-1]) + 1)
        stored = self._contents.images(descriptor)
        if stored is None:
            first, stop = (int(indices[0]), int(indices[-1]) + 1) if len(indices) else (0, 0)
            images = self._contents.shard(name).read(first, stop)
            if not np.array_equal(indices, np.arange(first, stop)):
                images = images[indices - first]
            return images if form == FULL_FORM else transform_pixels(images, form)
        unique, places = np.unique(indices, return_inverse=True)
        images = np.empty((len(unique), *form.shape(descriptor.shape)), dtype=np.uint8)
        _decode_images(stored, unique, form, images)
        return images if len(unique) == len(indices) else images[places]

    def encoded_images(self, name: str, start: int, stop: int) -> list[bytes]:
        """Encoded images start … stop−1 of a `jpeg` or `h264` stream.

        Raises InvalidInputError for another unit or images outside the stream, CorruptDataError for
        damage.
        """
        descriptor = self._stream(name)
        stored = self._contents.images(descriptor)
        if stored is None:
            raise InvalidInputError(
                f"{self._what}: {name!r} has the unit {descriptor.unit!r}, not 'jpeg' or 'h264'"
            )
        self._check_span("images", name, start, stop)
        size = stored.groups.size
        first = start // size
        images: list[bytes] = []
        for number in range(first, -(-stop // size) if stop > start else first):
            images += stored.read_group(number, stop - number * size)
        return images[start - first * size :]

    def damaged_images(
        self, name: str, indices: np.ndarray | None = None
    ) -> Int64[np.ndarray, " damaged"]:
        """Those of a camera's images (None for all) that cannot be decoded: decodes their groups.

        What a decoder would fill in is no image: readers by time treat such an image, and those of
        its H.264 group that depend on it, as images that were never recorded. A stream without
        encoded images has none. Raises CorruptDataError if the store's bytes are damaged (`dextouch
        store verify`).
        """
        descriptor = self._stream(name)
        if indices is None:
            indices = np.arange(self.num_samples(name))
        stored = self._contents.images(descriptor)
        if descriptor.kind != "image" or stored is None:
            return np.zeros(0, dtype=np.int64)
        size = stored.groups.size
        numbers, inverse = np.unique(indices // size, return_inverse=True)
        num_decodable = [
            self._num_decodable_in(stored, name, number) for number in numbers.tolist()
        ]
        limits = np.array(num_decodable, dtype=np.int64)[inverse]
        return indices[indices % size >= limits].astype(np.int64)

    def nearest_images(self, name: str, t_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
        """Index of the image nearest to each time, of those that can be decoded.

        Raises NotFoundError without any, and as `damaged_images`.
        """
        stamps, usable = self.stamps_ns(name), np.arange(self.num_samples(name))
        while len(usable):
            nearest = usable[nearest_index(stamps[usable], t_ns)]
            damaged = self.damaged_images(name, nearest)
            if not len(damaged):
                return nearest
            usable = np.setdiff1d(usable, damaged)
        raise NotFoundError(f"{self._what}: {name!r} holds no image that can be decoded")

    def notes(self) -> ItemNotes:
        """Notes of people on time ranges, as they are now; raises CorruptDataError for others."""
        files = self._contents.files
        return read_remark(files, NOTES_FILE, ItemNotes, what=self._what) or ItemNotes()

    def verify(self) -> Verification:
        """Read everything and compare it with the commit record, up to the first damage.

        `dextouch.episodes.maintenance` finds all damage, for `store verify` and `repair`. Raises
        CorruptDataError for the first damaged array, StorageError if the storage cannot be read.
        """
        contents = self._contents
        sizes: list[int] = []
        for name in contents.entries:
            for _, error in contents.inspect_array(name, progress=sizes.append):
                raise error
        return Verification(
            num_arrays=len(contents.entries),
            num_bytes=sum(sizes),
            content_sha256=self.content_sha256,
        )

    def _check_span(self, what: str, name: str, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= self.num_samples(name):
            raise InvalidInputError(
                f"{self._what}: got {what} {start} … {stop} of {name!r}, expected within "
                f"0 … {self.num_samples(name)}"
            )

    def _stream(self, name: str) -> StreamDescriptor:
        if name not in self.streams:
            raise UnknownNameError(f"stream of {self._what}", name, list(self.streams))
        return self.streams[name]

    def _column(self, name: str) -> np.ndarray:
        """A whole small array (stamps, actions), cached after the first read."""
        column = self._whole.get(name)
        if column is None:
            column = self._contents.shard(name).read()
            column.flags.writeable = False
            self._whole[name] = column
        return column

    def _range(self, name: str, start_ns: int | None, stop_ns: int | None) -> tuple[int, int]:
        stamps = self.stamps_ns(name)
        low = 0 if start_ns is None else int(stamps.searchsorted(start_ns))
        high = len(stamps) if stop_ns is None else int(stamps.searchsorted(stop_ns))
        return low, max(low, high)

    def _num_decodable_in(self, stored: EncodedImages, name: str, number: int) -> int:
        if (name, number) not in self._num_decodable:
            images, found = stored.read_group(number), stored.groups.size
            try:
                stored.groups.check(images, number)
            except CorruptDataError as error:
                found = int(str(error.details["place"]))
            self._num_decodable[name, number] = found
        return self._num_decodable[name, number]

    def _without_damaged(
        self, name: str, low: int, high: int, form: ImageForm = FULL_FORM
    ) -> tuple[slice | np.ndarray, np.ndarray]:
        """Samples low … high−1 and their values, without images that cannot be decoded."""
        if self.streams[name].kind != "image":
            return slice(low, high), self._values(name, low, high)
        indices = np.arange(low, high)
        try:
            return slice(low, high), self.images_at(name, indices, form=form)
        except CorruptDataError:
            kept = np.setdiff1d(indices, self.damaged_images(name, indices))
            return kept, self.images_at(name, kept, form=form)

    def _values(self, name: str, start: int, stop: int) -> np.ndarray:
        if self._contents.images(self.streams[name]) is None:
            return self._contents.shard(name).read(start, stop)
        return self.images_at(name, np.arange(start, stop))


def _decode_images(
    stored: EncodedImages, indices: np.ndarray, form: ImageForm, out: np.ndarray
) -> None:
    size = stored.groups.size
    numbers, starts = np.unique(indices // size, return_index=True)
    bounds: list[int] = np.append(starts, len(indices)).tolist()
    for place, number in enumerate(numbers.tolist()):
        low, high = bounds[place], bounds[place + 1]
        places = (indices[low:high] - number * size).tolist()
        images = stored.read_group(number, places[-1] + 1)
        stored.groups.decode(images, number, places, form, out[low:high])
