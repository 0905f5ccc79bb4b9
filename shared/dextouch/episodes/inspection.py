"""Complete reading of one array of a group, which lists all of its damage.

Both functions iterate over the number of a damaged storage chunk (None for none of them) and the
error, pass the bytes of the array's hash to `digest`, and the size of each intact storage chunk to
`progress`.
"""

from collections.abc import Callable, Iterator

import numpy as np

from dextouch.episodes.encoded_images import EncodedImages, IndexedBytes
from dextouch.episodes.image_codecs import pack_group
from dextouch.episodes.shards import ShardReader
from dextouch.errors import CorruptDataError, StorageError

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
