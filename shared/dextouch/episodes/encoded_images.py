"""The encoded images of one stream in a committed group, and the inspection of its arrays."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property

import google_crc32c
import numpy as np
from jaxtyping import Int64

from dextouch.episodes.image_codecs import ImageGroups, pack_group, unpack_group
from dextouch.episodes.shards import ShardReader
from dextouch.errors import CorruptDataError, StorageError


class EncodedImages(ABC):
    """Random access to the encoded images of a stream, by group.

    `counted` is the array with a row for each image.
    """

    def __init__(self, groups: ImageGroups, counted: ShardReader) -> None:
        self.groups, self._counted, self.num_images = groups, counted, counted.num_rows

    def read_group(self, number: int, count: int | None = None) -> list[bytes]:
        """The first `count` images of a group, None for all.

        Raises CorruptDataError for damaged bytes.
        """
        first = number * self.groups.size
        num_there = min(self.groups.size, self.num_images - first)
        return self._read(number, num_there if count is None else min(count, num_there))

    @abstractmethod
    def _read(self, number: int, count: int) -> list[bytes]: ...

    def check_claim(self) -> None:
        """Raise CorruptDataError for more images than the files can hold."""
        self._counted.check_index()


class GroupChunks(EncodedImages):
    """Format v2: a group of images is a storage chunk."""

    def _read(self, number: int, count: int) -> list[bytes]:
        where = f"{self.groups.what}: storage chunk {number}"
        images = unpack_group(self.groups.codec, self._counted.payload(number), where)
        expected = min(self.groups.size, self.num_images - number * self.groups.size)
        if len(images) != expected:
            raise CorruptDataError(f"{where} holds {len(images)} images, expected {expected}")
        return images[:count]


class IndexedBytes(EncodedImages):
    """Format v3: an index says where in an array of bytes each image lies, and its checksum.

    Of the array, only the bytes of the requested images are read.
    """

    def __init__(self, groups: ImageGroups, data: ShardReader, index: ShardReader) -> None:
        super().__init__(groups, index)
        self._data = data

    @cached_property
    def index(self) -> Int64[np.ndarray, "images 3"]:
        """First byte, end byte and crc32c of each image, verified.

        Raises CorruptDataError unless the images follow each other through the whole array.
        """
        rows = self._counted.read()
        bounds = np.concatenate([np.zeros(1, np.int64), rows[:, 1]])
        num_bytes = self._data.num_rows
        is_whole = int(bounds[-1]) == num_bytes and (bounds[1:] > bounds[:-1]).all()
        if not is_whole or not np.array_equal(rows[:, 0], bounds[:-1]):
            raise CorruptDataError(
                f"{self.groups.what}: its index is inconsistent with its {num_bytes} bytes"
            )
        return rows

    def has_index(self) -> bool:
        """Whether the index is intact."""
        try:
            return len(self.index) == self.num_images
        except StorageError:
            return False

    def read_image(self, image: int) -> bytes:
        """One image; raises CorruptDataError for damaged bytes."""
        return self._verified(image, image + 1)[0]

    def _read(self, number: int, count: int) -> list[bytes]:
        first = number * self.groups.size
        return self._verified(first, first + count)

    def _verified(self, first: int, stop: int) -> list[bytes]:
        rows = self.index[first:stop].tolist()
        begin = rows[0][0]
        data = self._data.read_bytes(begin, rows[-1][1])
        images = []
        for image, (start, end, crc) in enumerate(rows, start=first):
            images.append(data[start - begin : end - begin])
            if google_crc32c.value(images[-1]) != crc:
                raise CorruptDataError(
                    f"{self.groups.what}: image {image}: checksum mismatch ({end - start} bytes "
                    "read); the file is damaged or another one, restore it from a copy",
                    image=image,
                )
        return images

    def images_in(self, start: int, stop: int) -> range:
        """The images that have bytes start … stop−1 of the array."""
        ends = self.index[:, 1]
        first = int(ends.searchsorted(start, "right"))
        return range(first, int(self.index[:, 0].searchsorted(stop)))


Digest = Callable[[bytes | memoryview], None]
Progress = Callable[[int], None]
Damage = Iterator[tuple[int | None, StorageError]]


def inspect_chunks(
    shard: ShardReader, images: EncodedImages | None, digest: Digest, progress: Progress
) -> Damage:
    """Inspect numbers, or the encoded images of format v2."""
    for number in range(shard.num_chunks):
        try:
            payload = shard.payload(number)
            digest(hashed_bytes(shard, payload, number, images))
        except StorageError as error:
            yield number, error
        else:
            progress(len(payload))


def hashed_bytes(
    shard: ShardReader, payload: bytes, number: int, images: EncodedImages | None
) -> bytes | memoryview:
    """Bytes of a storage chunk that enter its array's hash.

    Images are decoded, since intact bytes of a damaged image are damage, too. Raises
    CorruptDataError for other rows than expected, or an image that cannot be decoded.
    """
    if images is None:
        return shard.rows_of(payload, number).data
    images.groups.check(images.read_group(number), number)
    return payload


def inspect_images(
    shard: ShardReader, images: IndexedBytes, digest: Digest, progress: Progress
) -> Damage:
    """Inspect the encoded images of format v3: their storage chunks, and each image.

    A damaged storage chunk is named with the images that it damages. `image` in the details of an
    error is an image that is damaged by itself: bytes of another file, or no image.
    """
    rows, size = np.array([[0, shard.num_rows, 0]]), 0
    if images.has_index():
        rows, size = images.index, images.groups.size
    checked, bad_stop = 0, 0
    for first in range(0, len(rows), size or 1):
        group = rows[first : first + (size or 1)]
        stop = -(-int(group[-1, 1]) // shard.chunk_rows)
        for number in range(checked, stop):
            try:
                progress(len(shard.payload(number)))
            except StorageError as error:
                bad_stop = (number + 1) * shard.chunk_rows
                yield number, _with_images(error, images, number * shard.chunk_rows, bad_stop)
        checked = max(checked, stop)
        if size:
            yield from _inspect_group(images, first // size, bad_stop, digest)


def _inspect_group(images: IndexedBytes, number: int, bad_stop: int, digest: Digest) -> Damage:
    """Inspect the images of a group; bytes before `bad_stop` may be known to be damaged."""
    encoded, is_whole, first = [], True, number * images.groups.size
    for image in range(first, min(first + images.groups.size, images.num_images)):
        try:
            encoded.append(images.read_image(image))
        except StorageError as error:
            is_whole = False
            if images.index[image, 0] >= bad_stop:
                yield None, error
    if is_whole:
        try:
            images.groups.check(encoded, number)
            digest(pack_group(images.groups.codec, encoded))
        except StorageError as error:
            yield None, error


def _with_images(error: StorageError, images: IndexedBytes, start: int, stop: int) -> StorageError:
    """Add to an error which images are damaged by it; `start` … `stop` are bytes of the array."""
    damaged = []
    try:
        for image in images.images_in(start, stop):
            try:
                images.read_image(image)
            except CorruptDataError:
                damaged.append(str(image))
    except StorageError:
        return error
    which = f"damaged images: {', '.join(damaged)}" if damaged else "no image is damaged"
    return type(error)(f"{error.message}; {which}", **error.details)
