"""PNG encoding of RGB and RGBA images, and data URLs of them, with zlib alone."""

import base64
import struct
import zlib

import numpy as np

from dextouch.errors import ShapeError
from dextouch.images import encode_jpeg

# Larger images are embedded as JPEG.
MAX_PNG_SIDE_PX = 256
_COLOUR_TYPES = {3: 2, 4: 6}


def encode_png(image: np.ndarray) -> bytes:
    """Encode one image as PNG; a fourth channel is opacity.

    Raises:
        ShapeError: not uint8 [h ≥ 1, w ≥ 1, 3 or 4].
    """
    fits = image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] in _COLOUR_TYPES
    if not fits or 0 in image.shape:
        raise ShapeError(f"image: got {image.dtype} {image.shape}, expected uint8 [h, w, 3 or 4]")
    height, width, channels = image.shape
    rows = np.zeros((height, 1 + channels * width), dtype=np.uint8)
    rows[:, 1:] = image.reshape(height, channels * width)
    header = struct.pack(">IIBBBBB", width, height, 8, _COLOUR_TYPES[channels], 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", header)
        + _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
        + _chunk(b"IEND", b"")
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    crc = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)


def data_address(image: np.ndarray) -> str:
    """Data URL of the image."""
    if image.shape[2] == 3 and max(image.shape[:2]) > MAX_PNG_SIDE_PX:
        return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(image)).decode()
    return "data:image/png;base64," + base64.b64encode(encode_png(image)).decode()
