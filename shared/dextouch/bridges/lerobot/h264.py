"""H.264 of a dataset's cameras: images that have to be encoded, and samples for its statistics."""

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import UInt8

from dextouch.episodes import FULL_FORM, GopEncoder, VideoSettings, decoder_of_this_thread
from dextouch.errors import CorruptDataError


def encode_images(
    images: Iterable[UInt8[np.ndarray, "h w 3"]], *, fps: int, settings: VideoSettings, group: int
) -> list[bytes]:
    """Encode RGB images, one access unit each.

    Args:
        images: all of one size.
        fps: nominal rate, written into the stream.
        settings: quality and speed.
        group: images from one entry point to the next.

    Raises:
        InvalidInputError: an image with an odd side.
    """
    encoder: GopEncoder | None = None
    units = []
    for image in images:
        if encoder is None:
            height_px, width_px = image.shape[:2]
            encoder = GopEncoder(
                height_px, width_px, rate_hz=float(fps), settings=settings, group_images=group
            )
        units.append(encoder.encode(image))
    return units


def decode_entry_points(
    access_units: Iterable[bytes], shape: tuple[int, ...], *, where: str
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Decode access units that are each decodable on their own to RGB images [h, w, 3].

    Raises:
        CorruptDataError: an access unit that cannot be decoded, or is of another size.
    """
    decoder = decoder_of_this_thread(*shape[:2])
    for index, data in enumerate(access_units):
        image = np.empty((1, *shape), dtype=np.uint8)
        try:
            decoder.decode([data], [0], FULL_FORM, image)
        except CorruptDataError as error:
            raise CorruptDataError(f"{where}: entry point {index} is damaged ({error})") from error
        yield image[0]
