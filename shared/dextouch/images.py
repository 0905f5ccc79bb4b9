"""JPEG codec of still images: uint8 RGB [h, w, 3]."""

import numpy as np
import simplejpeg
from jaxtyping import UInt8

from dextouch.errors import CorruptDataError, ShapeError

DEFAULT_QUALITY = 90


def encode_jpeg(image: np.ndarray, *, quality: int = DEFAULT_QUALITY) -> bytes:
    """Encode one RGB image as JPEG, without chroma subsampling.

    Raises:
        ShapeError: not uint8 [h ≥ 1, w ≥ 1, 3].
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ShapeError(f"image: got {image.dtype} {image.shape}, expected uint8 [h, w, 3]")
    return simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=quality)


def decode_jpeg(data: bytes, *, where: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Decode a JPEG to an RGB image.

    Raises:
        CorruptDataError: not a complete JPEG image; `where` names it in the message.
    """
    try:
        return simplejpeg.decode_jpeg(data, colorspace="RGB")
    except ValueError as error:
        raise CorruptDataError(
            f"{where}: {len(data)} bytes are not a JPEG image ({error})"
        ) from error


def jpeg_size(data: bytes, *, where: str = "image") -> tuple[int, int]:
    """Height and width (pixels) of a JPEG, from its header.

    Raises:
        CorruptDataError: not a JPEG header.
    """
    try:
        height_px, width_px, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError as error:
        raise CorruptDataError(
            f"{where}: {len(data)} bytes are not a JPEG image ({error})"
        ) from error
    return height_px, width_px


def check_jpeg(data: bytes, size_px: tuple[int, int], *, where: str = "image") -> None:
    """Decode a JPEG of a known size by the rule of `decode_jpeg`, and discard the image.

    At an eighth of the size all coefficients are still read, so that the same images are refused
    in about 60 % of the time.

    Raises:
        CorruptDataError: not a complete JPEG image of that height and width (pixels).
    """
    # Check the header first: the decoder allocates what it declares.
    if (size := jpeg_size(data, where=where)) != size_px:
        raise CorruptDataError(f"{where}: got a JPEG image of {size} pixels, expected {size_px}")
    try:
        simplejpeg.decode_jpeg(data, colorspace="RGB", min_height=1, min_width=1, min_factor=8)
    except ValueError as error:
        raise CorruptDataError(
            f"{where}: {len(data)} bytes are not a complete JPEG image ({error})"
        ) from error
