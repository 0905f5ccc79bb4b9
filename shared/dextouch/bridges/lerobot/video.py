"""Videos of a dataset: H.264 encoded, muxed into mp4 files, and read frame by frame."""

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, TypeVar

import av
import numpy as np
from av.bitstream import BitStreamFilterContext
from av.container import InputContainer, OutputContainer
from av.video.stream import VideoStream
from jaxtyping import UInt8

from dextouch.bridges.import_recording import remedy
from dextouch.bridges.lerobot.layout import VIDEO_FILE_MB, VIDEO_PATH, numbered_path
from dextouch.episodes import (
    EpisodeReader,
    GopEncoder,
    VideoSettings,
    disk_errors,
    is_keyframe,
    parameter_sets,
)
from dextouch.errors import CorruptDataError, LimitExceededError, NotFoundError, ShapeError

MAX_SIDE_PX: Final = 8192
# Images that H.264 and HEVC may decode before one that is shown earlier. A demuxer looks for the
# entry point by the time of decoding, and could choose one that is shown too late.
MAX_REORDERED: Final = 16
T = TypeVar("T")


@dataclass(frozen=True)
class VideoLocation:
    """Location of one episode's images: file number of the camera and seconds within it."""

    file_number: int
    from_timestamp_s: float
    to_timestamp_s: float


class CameraVideo:
    """The mp4 files of one camera, one episode after the other.

    Access units are muxed unchanged. A new file starts when the next episode, which is never split,
    would make the file larger than VIDEO_FILE_MB, or was encoded with other parameter sets than the
    file's header holds. `shape` is [height, width, 3].
    """

    def __init__(
        self, folder: Path, key: str, *, fps: int, shape: Sequence[int], first_file: int = 0
    ) -> None:
        self._folder, self._key, self._fps, self._shape = folder, key, fps, tuple(shape)
        self._file_number = first_file - 1
        self._num_images = self._num_bytes = 0
        self._parameters = b""
        self._file: tuple[OutputContainer, VideoStream] | None = None

    def append(self, access_units: Sequence[bytes], *, where: str) -> VideoLocation:
        """Mux the access units of one episode, one per image, without B-frames.

        Raises CorruptDataError if the first image is no entry point, ShapeError for images of
        another size, StorageError if the write failed.
        """
        parameters = parameter_sets(access_units[0]) if access_units else b""
        if not parameters:
            raise CorruptDataError(f"{where}: does not begin with an IDR image and its headers")
        size = sum(map(len, access_units))
        full = self._num_bytes + size > VIDEO_FILE_MB << 20
        if self._file is None or full or parameters != self._parameters:
            self._file = self._new_file(access_units[0], where=where)
            self._parameters = parameters
        output, stream = self._file
        first = self._num_images
        with disk_errors(f"write {where}"):
            for data in access_units:
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, Fraction(1, self._fps)
                packet.pts = packet.dts = self._num_images
                packet.duration, packet.is_keyframe = 1, is_keyframe(data)
                output.mux(packet)
                self._num_images += 1
        self._num_bytes += size
        return VideoLocation(self._file_number, first / self._fps, self._num_images / self._fps)

    def close(self) -> None:
        """Complete the file that is open."""
        if self._file is not None:
            with disk_errors(f"complete a video of {self._key}"):
                self._file[0].close()
        self._file = None

    def _new_file(self, access_unit: bytes, *, where: str) -> tuple[OutputContainer, VideoStream]:
        self.close()
        self._file_number += 1
        self._num_images = self._num_bytes = 0
        try:
            with av.open(io.BytesIO(access_unit), format="h264") as source:
                template = source.streams.video[0]
                size = (template.height, template.width)
                if size != self._shape[:2]:
                    raise ShapeError(f"{where}: got images {size}, expected {self._shape[:2]}")
                with disk_errors(f"create a video of {self._key}"):
                    path = numbered_path(
                        self._folder, VIDEO_PATH, self._file_number, video_key=self._key
                    )
                    output = av.open(path, "w", format="mp4")
                stream = output.add_stream_from_template(template)
        except (av.error.InvalidDataError, IndexError) as error:
            raise CorruptDataError(f"{where}: is not an H.264 stream ({error})") from error
        stream.time_base = Fraction(1, self._fps)
        return output, stream


@dataclass(frozen=True)
class VideoSpan:
    """The images of one episode in a file: `count` of them, 1 / `fps` s apart.

    `shape` is that of the images, [height, width, 3]; `from_s` the time of the first one.
    """

    path: Path
    from_s: float
    count: int
    fps: int | float
    shape: tuple[int, ...]


def read_images(span: VideoSpan) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Decode the images of a span one by one; any codec that PyAV's build supports.

    Raises NotFoundError without the file, CorruptDataError if it is damaged, truncated, of another
    size, or without an image in its place.
    """
    with _opened(span) as (container, stream):
        frames = ((frame.pts, frame) for frame in container.decode(stream))
        for frame in _in_place(span, stream, frames):
            if (frame.height, frame.width) != tuple(span.shape[:2]):
                raise CorruptDataError(
                    f"{span.path}: got an image of {frame.height} x {frame.width} pixels, "
                    f"expected {span.shape[0]} x {span.shape[1]}"
                )
            yield frame.to_ndarray(format="rgb24", interpolation="BICUBIC")


def read_units(span: VideoSpan) -> list[bytes] | None:
    """Copy the access units of a span (Annex B) without decoding, where possible.

    None where the video is not 4:2:0 H.264, begins in the middle of a GOP, or has B-frames: its
    packets come in the order of decoding, and `read_images` finds out whether an image is missing.
    Raises as that.
    """
    units: list[bytes] = []
    with _opened(span) as (container, stream):
        if stream.codec.canonical_name != "h264" or stream.pix_fmt != "yuv420p":
            return None
        for pts, (data, is_reordered) in _access_units(container, stream):
            place = _place(span, stream, pts)
            if place is None or is_reordered:
                return None
            if place > len(units):
                raise _missing(span, len(units), place)
            if place == len(units):
                if not units and not is_keyframe(data):
                    return None
                units.append(data)
                if len(units) == span.count:
                    return units
    raise _missing(span, len(units), span.count)


def _access_units(
    container: InputContainer, stream: VideoStream
) -> Iterator[tuple[int | None, tuple[bytes, bool]]]:
    """Time stamp, bytes, and whether it is decoded at another time than it is shown."""
    annexb = BitStreamFilterContext("h264_mp4toannexb", stream)
    for packet in container.demux(stream):
        # The filter consumes the packet, so its time stamps must be read first.
        pts, dts = packet.pts, packet.dts
        data = b"".join(bytes(part) for part in annexb.filter(packet)) if packet.size else b""
        if data:
            yield pts, (data, pts != dts)


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
            size = (stream.height, stream.width)
            if max(size) > MAX_SIDE_PX:
                raise LimitExceededError(
                    f"{span.path}: got images {size}, expected ≤ {MAX_SIDE_PX} pixels"
                )
            if size != tuple(span.shape[:2]):
                raise CorruptDataError(f"{span.path}: got images {size}, expected {span.shape[:2]}")
            if stream.time_base is None:
                raise CorruptDataError(f"{span.path}: has no timestamps")
            early = MAX_REORDERED if stream.codec_context.has_b_frames else 0.5
            start = max(0, round((span.from_s - early / span.fps) / stream.time_base))
            container.seek(start + (stream.start_time or 0), stream=stream)
            yield container, stream
    except (av.error.FFmpegError, ValueError) as error:
        raise CorruptDataError(
            f"{span.path}: is not a complete mp4 file ({error}); {remedy(span.path)}"
        ) from error


def _place(span: VideoSpan, stream: VideoStream, pts: int | None) -> int | None:
    """Number of the image in its span, by its time after the start of the video."""
    if pts is None:
        return None
    seconds = float((pts - (stream.start_time or 0)) * (stream.time_base or Fraction(1)))
    return round((seconds - span.from_s) * span.fps)


def _in_place(
    span: VideoSpan, stream: VideoStream, items: Iterable[tuple[int | None, T]]
) -> Iterator[T]:
    """The items of a span by their time stamps; refuses a gap.

    An item without a time stamp follows the one before, if that one's place is known.
    """
    done, place = 0, span.count
    found = None if span.from_s else -1
    for pts, item in items:
        stamped = _place(span, stream, pts)
        if stamped is None and found is not None:
            stamped = found + 1
        found = stamped
        if found is None:
            continue
        if found > done:
            place = found
            break
        if found == done:
            yield item
            done += 1
            if done == span.count:
                return
    raise _missing(span, done, place)


def _missing(span: VideoSpan, done: int, place: int) -> CorruptDataError:
    return CorruptDataError(
        f"{span.path}: image {done} of {span.count} after {span.from_s:.3f} s is missing "
        f"(the next one is {place}); copy the dataset again, or correct its fps ({span.fps:g}) if "
        "the video has another rate"
    )


def stored_units(reader: EpisodeReader, camera: str, indices: np.ndarray) -> list[bytes] | None:
    """The stored access units of a camera, where they can be remuxed without encoding, else None.

    They cannot where images are skipped or repeated, or the first one needs those before it.
    """
    consecutive = bool((np.diff(indices) == 1).all())
    if reader.streams[camera].unit != "h264" or not consecutive:
        return None
    units = reader.encoded_images(camera, int(indices[0]), int(indices[-1]) + 1)
    return units if is_keyframe(units[0]) else None


def encode_images(
    images: Iterable[UInt8[np.ndarray, "h w 3"]],
    fps: int,
    settings: VideoSettings,
    group_images: int,
) -> list[bytes]:
    """RGB images of one size as H.264, one access unit each; every n-th begins a group."""
    encoder: GopEncoder | None = None
    units = []
    for image in images:
        if encoder is None:
            size = image.shape[:2]
            encoder = GopEncoder(
                *size, rate_hz=float(fps), settings=settings, group_images=group_images
            )
        units.append(encoder.encode(image))
    return units
