"""Images of a response as JPEG: a tenth of the bytes, at the price of small errors.

The array `image/CAMERA`, uint8 [n, h, w, 3], is replaced by `jpeg/CAMERA`, uint8, the n files one
behind the other, and `jpeg_bytes/CAMERA`, int32 [n], their sizes.
"""

import itertools
import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.images import decode_jpeg, encode_jpeg, jpeg_size

IMAGE_PREFIX: Final = "image/"
JPEG_PREFIX: Final = "jpeg/"
SIZES_PREFIX: Final = "jpeg_bytes/"
CHANNELS: Final = 3


def encode_images(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of a response with its images as JPEG of quality 90."""
    found = {}
    for name, array in arrays.items():
        if not name.startswith(IMAGE_PREFIX):
            found[name] = array
            continue
        camera, files = name.removeprefix(IMAGE_PREFIX), [encode_jpeg(image) for image in array]
        found[JPEG_PREFIX + camera] = np.frombuffer(b"".join(files), np.uint8)
        found[SIZES_PREFIX + camera] = np.array([len(file) for file in files], np.int32)
    return found


def decode_images(
    arrays: Mapping[str, np.ndarray], *, max_bytes: int, where: str
) -> dict[str, np.ndarray]:
    """Inverse of `encode_images`, for a response that may hold JPEG.

    Raises:
        InvalidInputError: sizes that are missing or do not fit the bytes, or images of different
            sizes.
        LimitExceededError: images that take more than `max_bytes` once decoded.
        CorruptDataError: not JPEG.
    """
    found = {}
    for name, array in arrays.items():
        if name.startswith(JPEG_PREFIX):
            camera = name.removeprefix(JPEG_PREFIX)
            sizes = arrays.get(SIZES_PREFIX + camera)
            found[IMAGE_PREFIX + camera] = _decoded(
                array, sizes, max_bytes=max_bytes, where=f"{where}: images of {camera}"
            )
        elif not name.startswith(SIZES_PREFIX):
            found[name] = array
    return found


def _decoded(
    data: np.ndarray, sizes: np.ndarray | None, *, max_bytes: int, where: str
) -> np.ndarray:
    if sizes is None or sizes.dtype != np.int32 or sizes.ndim != 1 or (sizes < 1).any():
        raise InvalidInputError(f"{where}: the sizes of the JPEG files are missing or not positive")
    ends = [0, *itertools.accumulate(int(size) for size in sizes)]
    if data.dtype != np.uint8 or data.ndim != 1 or ends[-1] != len(data) or len(sizes) == 0:
        raise InvalidInputError(
            f"{where}: got {data.dtype} {list(data.shape)}, expected {ends[-1]} bytes of "
            f"{len(sizes)} JPEG files"
        )
    files = [data[start:end].tobytes() for start, end in itertools.pairwise(ends)]
    shapes = {jpeg_size(file, where=where) for file in files}
    if len(shapes) != 1:
        raise InvalidInputError(f"{where}: got sizes {sorted(shapes)} px, expected one size")
    decoded_bytes = len(files) * CHANNELS * math.prod(*shapes)
    if decoded_bytes > max_bytes:
        raise LimitExceededError(
            f"{where}: {decoded_bytes} bytes when decoded, expected at most {max_bytes}"
        )
    return np.stack([decode_jpeg(file, where=where) for file in files])
