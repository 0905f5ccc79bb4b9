"""Still images, uint8 RGB [h, w, 3]: their JPEG codec, and scaling to a smaller square."""

import numpy as np
import simplejpeg
from jaxtyping import Float32, Float64, UInt8

from dextouch.errors import CorruptDataError, ShapeError

DEFAULT_QUALITY = 90


def encode_jpeg(image: np.ndarray, *, quality: int = DEFAULT_QUALITY) -> bytes:
    """Encode one RGB image as JPEG, without chroma subsampling.

    Raises ShapeError unless it is uint8 [h ≥ 1, w ≥ 1, 3].
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ShapeError(f"image: got {image.dtype} {image.shape}, expected uint8 [h, w, 3]")
    return simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=quality)


def decode_jpeg(
    data: bytes,
    *,
    where: str = "image",
    size_px: tuple[int, ...] | None = None,
    gray: bool = False,
    **reduced: int,
) -> UInt8[np.ndarray, "h w c"]:
    """Decode a JPEG to an RGB image, or with `gray` its luma alone, to one channel.

    `where` names it in messages, `size_px` is the expected height and width, and `reduced` are
    `min_height`, `min_width` and `min_factor` of `simplejpeg`, for a smaller image.

    Raises:
        CorruptDataError: not a complete JPEG image, or one of another size.
    """
    # Check the header first: the decoder allocates what it declares.
    if size_px is not None and (size := jpeg_size(data, where=where)) != size_px:
        raise CorruptDataError(f"{where}: got a JPEG image of {size} pixels, expected {size_px}")
    try:
        return simplejpeg.decode_jpeg(data, colorspace="GRAY" if gray else "RGB", **reduced)
    except ValueError as error:
        raise CorruptDataError(
            f"{where}: {len(data)} bytes are not a complete JPEG image ({error})"
        ) from error


def jpeg_size(data: bytes, *, where: str = "image") -> tuple[int, int]:
    """Height and width (pixels) of a JPEG, from its header; raises CorruptDataError without one."""
    try:
        height_px, width_px, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError as error:
        raise CorruptDataError(
            f"{where}: {len(data)} bytes are not a JPEG image ({error})"
        ) from error
    return height_px, width_px


def check_jpeg(
    data: bytes, size_px: tuple[int, int], *, where: str = "image"
) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a JPEG of a known size to an eighth of it; raises as `decode_jpeg`.

    At an eighth of the size all coefficients are still read, so that the same images are refused
    in about 60 % of the time.
    """
    return decode_jpeg(data, where=where, size_px=size_px, min_height=1, min_width=1, min_factor=8)


def scaled_square(
    images: UInt8[np.ndarray, "n h w 3"], K: Float64[np.ndarray, "3 3"], side_px: int
) -> tuple[UInt8[np.ndarray, "n side side 3"], Float64[np.ndarray, "3 3"]]:
    """The middle square of images, each pixel the mean of the area that it covers, and its camera.

    Images that have the side already are returned as they are. K is in pixels, whose centres are at
    half-integers.
    """
    height_px, width_px = images.shape[1:3]
    if height_px == width_px == side_px:
        return images, K
    side = min(height_px, width_px)
    top, left = (height_px - side) // 2, (width_px - side) // 2
    share = _area_shares(side, side_px)
    scaled = np.empty((len(images), side_px, side_px, 3), dtype=np.uint8)
    for index, image in enumerate(images):
        square = image[top : top + side, left : left + side].astype(np.float32)
        rows = (share @ square.reshape(side, -1)).reshape(side_px, side, 3)
        scaled[index] = (share @ rows).round()
    moved = K.copy()
    moved[0, 2] -= left
    moved[1, 2] -= top
    moved[:2] *= side_px / side
    return scaled, moved


def square_of_at_most(
    images: UInt8[np.ndarray, "n h w 3"], K: Float64[np.ndarray, "3 3"], side_px: int | None
) -> tuple[UInt8[np.ndarray, "n new_h new_w 3"], Float64[np.ndarray, "3 3"]]:
    """The middle square of images, scaled if it is larger than a side; None leaves them.

    As `scaled_square`, but small images are not enlarged.
    """
    if side_px is None or not images.size:
        return images, K
    return scaled_square(images, K, min(side_px, *images.shape[1:3]))


def _area_shares(side: int, side_px: int) -> Float32[np.ndarray, "new old"]:
    """Share of every old pixel in each new one, along one axis."""
    edges = np.linspace(0.0, side, side_px + 1)
    old = np.arange(side)
    overlap = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return (overlap.clip(0.0) * (side_px / side)).astype(np.float32)
