"""Frame-exact reading of a span of an mp4 file, as images or as access units."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import av
import numpy as np
from av.bitstream import BitStreamFilterContext
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import UInt8

from dextouch.episodes import is_keyframe
from dextouch.errors import CorruptDataError, LimitExceededError, NotFoundError

MAX_SIDE_PX: Final = 8192


@dataclass(frozen=True)
class VideoSpan:
    """The images of one episode in a file: `count` of them, 1 / `fps` s apart.

    `shape` is that of the images, [height, width, 3]; `from_s` the time of the first one.
    """

    path: Path
    from_s: float
    count: int
    fps: int
    shape: tuple[int, ...]


def read_images(span: VideoSpan) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Decode the images of a span one by one; any codec that PyAV's build supports.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: damaged, truncated, of another size, or without an image in its place.
    """
    done = 0
    with _opened(span) as (container, stream):
        for frame in container.decode(stream):
            place = _place(span, stream, frame.pts)
            if place < done:
                continue
            _check_place(span, place, done)
            if (frame.height, frame.width) != tuple(span.shape[:2]):
                raise CorruptDataError(
                    f"{span.path}: got an image of {frame.height} x {frame.width} pixels, "
                    f"expected {span.shape[0]} x {span.shape[1]}"
                )
            yield frame.to_ndarray(format="rgb24", interpolation="BICUBIC")
            done += 1
            if done == span.count:
                return
    _check_place(span, span.count, done)


def read_units(span: VideoSpan) -> list[bytes] | None:
    """Copy the access units of a span (Annex B) without decoding, where possible.

    None where the video is not 4:2:0 H.264, begins in the middle of a GOP, or has B-frames.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: damaged, truncated, of another size, or without an image in its place.
    """
    units: list[bytes] = []
    with _opened(span) as (container, stream):
        if stream.codec.canonical_name != "h264" or stream.pix_fmt != "yuv420p":
            return None
        annexb = BitStreamFilterContext("h264_mp4toannexb", stream)
        for packet in container.demux(stream):
            # The filter consumes the packet, so its time stamps must be read first.
            times = packet.pts, packet.dts
            data = b"".join(bytes(part) for part in annexb.filter(packet)) if packet.size else b""
            place = _place(span, stream, times[0]) if data else -1
            if place < len(units):
                continue
            _check_place(span, place, len(units))
            if times[0] != times[1] or (not units and not is_keyframe(data)):
                return None
            units.append(data)
            if len(units) == span.count:
                return units
    _check_place(span, span.count, len(units))
    return units


@contextmanager
def _opened(span: VideoSpan) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container, at the last entry point before the span."""
    if not span.path.is_file():
        raise NotFoundError(f"{span.path}: is missing from the dataset")
    try:
        # A playlist or a network address must never be followed from a dataset's file.
        with av.open(span.path, format="mp4", options={"protocol_whitelist": "file"}) as container:
            if not container.streams.video:
                raise CorruptDataError(f"{span.path}: holds no video")
            stream = container.streams.video[0]
            stream.thread_count = 1
            _check_size(span, stream)
            base = stream.time_base
            if base is None:
                raise CorruptDataError(f"{span.path}: has no timestamps")
            container.seek(max(0, round((span.from_s - 0.5 / span.fps) / base)), stream=stream)
            yield container, stream
    except (av.error.FFmpegError, ValueError) as error:
        raise CorruptDataError(
            f"{span.path}: is not a complete mp4 file ({error}); copy the dataset again"
        ) from error


def _check_size(span: VideoSpan, stream: VideoStream) -> None:
    size: Sequence[int] = (stream.height, stream.width)
    if max(size) > MAX_SIDE_PX:
        raise LimitExceededError(f"{span.path}: got images {size}, expected ≤ {MAX_SIDE_PX} pixels")
    if tuple(size) != tuple(span.shape[:2]):
        raise CorruptDataError(f"{span.path}: got images {size}, expected {span.shape[:2]}")


def _place(span: VideoSpan, stream: VideoStream, pts: int | None) -> int:
    """Which image of the span a time stamp belongs to; negative before the span."""
    if pts is None or stream.time_base is None:
        return -1
    return round((float(pts * stream.time_base) - span.from_s) * span.fps)


def _check_place(span: VideoSpan, place: int, expected: int) -> None:
    if place != expected:
        raise CorruptDataError(
            f"{span.path}: image {expected} of {span.count} after {span.from_s:.3f} s is missing "
            f"(the next one is {place}); copy the dataset again"
        )
