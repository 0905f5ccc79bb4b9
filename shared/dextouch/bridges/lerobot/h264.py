"""H.264 encoding to Annex B access units, and inspection of their NAL units."""

from collections.abc import Iterable, Iterator
from fractions import Fraction

import av
import numpy as np
from jaxtyping import UInt8

from dextouch.errors import CorruptDataError, ShapeError

_IDR, _SPS, _PPS = 5, 7, 8
# Same settings as the store's video, so that both give the same image.
TO_YUV, TO_RGB = "AREA", "BICUBIC"


def nal_units(access_unit: bytes) -> list[bytes]:
    """The NAL units between the start codes of an access unit (ITU-T H.264, Annex B)."""
    units, start = [], access_unit.find(b"\0\0\1")
    while start >= 0:
        stop = access_unit.find(b"\0\0\1", start + 3)
        unit = access_unit[start + 3 : stop if stop >= 0 else len(access_unit)]
        # The zero before a longer start code belongs to that code, not to the unit.
        units.append(unit.rstrip(b"\0"))
        start = stop
    return [unit for unit in units if unit]


def parameter_sets(access_unit: bytes) -> tuple[bytes, ...]:
    """The sequence and picture parameter sets that an access unit carries."""
    return tuple(u for u in nal_units(access_unit) if u[0] & 0x1F in {_SPS, _PPS})


def is_entry_point(access_unit: bytes) -> bool:
    """Whether decoding can start at this access unit: an IDR picture with its parameter sets."""
    kinds = {unit[0] & 0x1F for unit in nal_units(access_unit)}
    return {_IDR, _SPS, _PPS} <= kinds


def holds_idr(access_unit: bytes) -> bool:
    """Whether an access unit contains an IDR picture, with or without parameter sets."""
    return any(unit[0] & 0x1F == _IDR for unit in nal_units(access_unit))


def encode_images(
    images: Iterable[UInt8[np.ndarray, "h w 3"]], *, fps: int, crf: int, group: int
) -> Iterator[bytes]:
    """Encode RGB images, one access unit each: x264, 4:2:0, closed GOPs, no B-frames.

    Args:
        images: all of one size, with even sides.
        fps: nominal rate, written into the stream.
        crf: constant quality, 0 … 51; lower is better and larger.
        group: images from one IDR picture to the next.

    Raises:
        ShapeError: an image with an odd side.
    """
    encoder: av.VideoCodecContext | None = None
    for index, image in enumerate(images):
        if encoder is None:
            encoder = _encoder(image.shape, fps=fps, crf=crf, group=group)
        rgb = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = rgb.reformat(format="yuv420p", interpolation=TO_YUV)
        frame.pts = index
        for packet in encoder.encode(frame):
            yield bytes(packet)
    if encoder is not None:
        for packet in encoder.encode(None):
            yield bytes(packet)


def _encoder(shape: tuple[int, ...], *, fps: int, crf: int, group: int) -> av.VideoCodecContext:
    height_px, width_px = shape[:2]
    if height_px % 2 or width_px % 2:
        raise ShapeError(
            f"video: got images of {height_px} x {width_px} pixels, expected even sides; "
            "LeRobot's players need 4:2:0 video"
        )
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width_px, height_px, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, fps), Fraction(fps)
    encoder.gop_size, encoder.max_b_frames = group, 0
    # One thread, so that equal images give equal bytes on every machine.
    encoder.thread_count = 1
    encoder.options = {
        "preset": "veryfast",
        "crf": str(crf),
        "x264-params": "scenecut=0:repeat-headers=1:annexb=1:rc-lookahead=0:sync-lookahead=0",
    }
    return encoder


def decode_entry_points(
    access_units: Iterable[bytes], *, where: str
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Decode access units that are each decodable on their own to RGB images.

    Raises:
        CorruptDataError: an access unit that cannot be decoded.
    """
    for index, data in enumerate(access_units):
        decoder = av.CodecContext.create("h264", "r")
        try:
            frames = [*decoder.decode(av.Packet(data)), *decoder.decode(None)]
        except av.error.FFmpegError as error:
            raise CorruptDataError(f"{where}: entry point {index} is damaged ({error})") from error
        if len(frames) != 1:
            raise CorruptDataError(f"{where}: entry point {index} gives {len(frames)} images")
        yield frames[0].to_ndarray(format="rgb24", interpolation=TO_RGB)
