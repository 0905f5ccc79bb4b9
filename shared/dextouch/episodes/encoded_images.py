"""The encoded images of one stream in a committed group, in format v3 and in v2.

v3 has the images end to end in an array of bytes, and an index of them; v2 one group of images in
each storage chunk.
"""

from abc import ABC, abstractmethod
from functools import cached_property

import google_crc32c
import numpy as np
from jaxtyping import Int64

from dextouch.episodes.image_codecs import ImageGroups, unpack_group
from dextouch.episodes.shards import ShardReader
from dextouch.errors import CorruptDataError, StorageError


class EncodedImages(ABC):
    """Random access to the encoded images of a stream, by group."""

    def __init__(self, groups: ImageGroups, num_images: int) -> None:
        self.groups, self.num_images = groups, num_images
        self.num_groups = -(-num_images // groups.size)

    def read_group(self, number: int, count: int | None = None) -> list[bytes]:
        """The first `count` images of a group, None for all.

        Raises CorruptDataError for damaged bytes.
        """
        first = number * self.groups.size
        num_there = min(self.groups.size, self.num_images - first)
        return self._read(number, num_there if count is None else min(count, num_there))

    @abstractmethod
    def _read(self, number: int, count: int) -> list[bytes]: ...

    @abstractmethod
    def check_claim(self) -> None:
        """Raise CorruptDataError for more images than the files can hold."""


class GroupChunks(EncodedImages):
    """Format v2: a group of images is a storage chunk."""

    def __init__(self, groups: ImageGroups, shard: ShardReader) -> None:
        super().__init__(groups, shard.num_rows)
        self._shard = shard

    def _read(self, number: int, count: int) -> list[bytes]:
        where = f"{self.groups.what}: storage chunk {number}"
        images = unpack_group(self.groups.codec, self._shard.payload(number), where)
        expected = min(self.groups.size, self.num_images - number * self.groups.size)
        if len(images) != expected:
            raise CorruptDataError(f"{where} holds {len(images)} images, expected {expected}")
        return images[:count]

    def check_claim(self) -> None:
        """Raise CorruptDataError for more images than the shard can hold."""
        self._shard.check_index()


class IndexedBytes(EncodedImages):
    """Format v3: an index says where in an array of bytes each image lies, and its checksum.

    Of the array, only the bytes of the requested images are read.
    """

    def __init__(self, groups: ImageGroups, data: ShardReader, index: ShardReader) -> None:
        super().__init__(groups, index.num_rows)
        self._data, self._index_array = data, index

    @cached_property
    def index(self) -> Int64[np.ndarray, "images 3"]:
        """First byte, end byte and crc32c of each image, verified.

        Raises CorruptDataError unless the images follow each other through the whole array.
        """
        rows = self._index_array.read()
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

    def check_claim(self) -> None:
        """Raise CorruptDataError for more images than the index can hold."""
        self._index_array.check_index()

    def images_in(self, start: int, stop: int) -> range:
        """The images that have bytes start … stop−1 of the array."""
        ends = self.index[:, 1]
        first = int(ends.searchsorted(start, "right"))
        return range(first, int(self.index[:, 0].searchsorted(stop)))
