"""Images and video in files of other tools: JPEG kept, PNG, raw pixels and video decoded.

Sizes are read from headers and checked before anything is decoded.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from dextouch.episodes import GOP_IMAGES, MOST_STEPS, FrameNumbers, parameter_sets
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError
from dextouch.images import jpeg_size
from dextouch.streams import JPEG_UNIT

MAX_SIDE_PX: Final = 8192
MAX_PIXELS: Final = 1 << 25
JPEG_START: Final = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
PNG_START: Final = b"\x89PNG\r\n\x1a\n"
# ROS' compressed_depth_image_transport puts a header of this size before the PNG.
_DEPTH_HEADER_BYTES = 12
# Colour types of PNG (ISO/IEC 15948, 11.2.2) with 8 bits and what they become.
_PNG_GRAY, _PNG_RGB, _PNG_PALETTE, _PNG_RGBA = 0, 2, 3, 6
# Raw encodings: dtype, channels, and which channels are red, green and blue.
RAW: Final[Mapping[str, tuple[str, int, tuple[int, ...]]]] = {
    "rgb8": ("uint8", 3, (0, 1, 2)),
    "bgr8": ("uint8", 3, (2, 1, 0)),
    "8UC3": ("uint8", 3, (2, 1, 0)),
    "rgba8": ("uint8", 4, (0, 1, 2)),
    "bgra8": ("uint8", 4, (2, 1, 0)),
    "mono8": ("uint8", 1, ()),
    "8UC1": ("uint8", 1, ()),
    "mono16": ("uint16", 1, ()),
    "16UC1": ("uint16", 1, ()),
    "32FC1": ("float32", 1, ()),
}
# Names of Foxglove for the codecs of PyAV.
VIDEO_CODECS: Final = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}


def check_pixels(height_px: int, width_px: int) -> None:
    """Raise for an image without pixels, or with more than MAX_SIDE_PX or MAX_PIXELS."""
    if height_px < 1 or width_px < 1:
        raise InvalidInputError(f"image of {height_px} x {width_px} pixels")
    if max(height_px, width_px) > MAX_SIDE_PX or height_px * width_px > MAX_PIXELS:
        raise LimitExceededError(
            f"image of {height_px} x {width_px} pixels, expected at most {MAX_SIDE_PX} a side and "
            f"{MAX_PIXELS} in all"
        )


def compressed_form(data: bytes) -> tuple[str, str, tuple[int, ...], bytes]:
    """Unit, dtype and shape of a compressed image, and the image without a header of ROS.

    Raises InvalidInputError for formats other than JPEG and PNG.
    """
    if data[_DEPTH_HEADER_BYTES : _DEPTH_HEADER_BYTES + 8] == PNG_START:
        data = data[_DEPTH_HEADER_BYTES:]
    if data.startswith(JPEG_START):
        height_px, width_px = jpeg_size(data)
        check_pixels(height_px, width_px)
        if data.rfind(_JPEG_END, -4096) < 0:
            raise CorruptDataError("JPEG image without its end marker: it was cut")
        return JPEG_UNIT, "uint8", (height_px, width_px, 3), data
    if data.startswith(PNG_START) and len(data) > 26:
        width_px, height_px, bits, color = struct.unpack_from(">IIBB", data, 16)
        check_pixels(height_px, width_px)
        if color == _PNG_GRAY and bits in {8, 16}:
            return f"mono{bits}", f"uint{bits}", (height_px, width_px), data
        if bits == 8 and color in {_PNG_RGB, _PNG_PALETTE, _PNG_RGBA}:
            return "rgb8", "uint8", (height_px, width_px, 3), data
        raise InvalidInputError(
            f"PNG image of colour type {color} with {bits} bits; expected gray of 8 or 16 bits, or "
            "RGB, RGBA or a palette of 8"
        )
    raise InvalidInputError(f"image that begins with {data[:4].hex()}; expected JPEG or PNG")


def decode_png(data: bytes, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """Decode a PNG without loss to the shape and dtype of `compressed_form`; alpha is left out.

    Raises CorruptDataError if it is damaged.
    """
    form = "rgb24" if len(shape) == 3 else "gray" if dtype == "uint8" else "gray16be"
    context: Any = av.CodecContext.create("png", "r")
    context.thread_count = 1
    context.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "crccheck+explode"}
    try:
        frames = [*context.decode(av.Packet(data)), *context.decode(None)]
    except (av.FFmpegError, ValueError) as error:
        raise CorruptDataError(f"PNG image is damaged ({error})") from error
    if len(frames) != 1 or (frames[0].height, frames[0].width) != shape[:2]:
        raise CorruptDataError(f"PNG image is damaged: {len(frames)} images")
    frame = frames[0]
    if frame.is_corrupt:
        raise CorruptDataError("PNG image is damaged")
    return frame.to_ndarray(format=form).astype(dtype, copy=False)


def raw_form(
    encoding: str, height_px: int, width_px: int, step: int, data: bytes
) -> tuple[str, str, tuple[int, ...]]:
    """Unit, dtype and shape of a raw image.

    Raises InvalidInputError for other pixel formats than those of RAW, or a size that does not fit.
    """
    if encoding not in RAW:
        raise InvalidInputError(f"pixel format {encoding!r}; expected one of {', '.join(RAW)}")
    check_pixels(height_px, width_px)
    dtype, channels, colours = RAW[encoding]
    row_bytes = width_px * channels * np.dtype(dtype).itemsize
    # The last row may end without its padding.
    if step < row_bytes or len(data) < step * (height_px - 1) + row_bytes:
        raise CorruptDataError(
            f"{encoding} image of {height_px} x {width_px} pixels with rows of {step} bytes, "
            f"and {len(data)} bytes in all"
        )
    if colours:
        return "rgb8", dtype, (height_px, width_px, 3)
    unit = {"uint8": "mono8", "uint16": "mono16", "float32": "m"}[dtype]
    return unit, dtype, (height_px, width_px)


def decode_raw(
    encoding: str, shape: tuple[int, ...], step: int, data: bytes, *, big_endian: bool
) -> np.ndarray:
    """Pixels of a raw image that `raw_form` accepted."""
    name, channels, colours = RAW[encoding]
    dtype = np.dtype(name).newbyteorder(">" if big_endian else "<")
    height_px, width_px = shape[:2]
    whole = np.zeros(height_px * step, dtype=np.uint8)
    given = np.frombuffer(data, dtype=np.uint8)[: len(whole)]
    whole[: len(given)] = given
    rows = whole.reshape(height_px, step)[:, : width_px * channels * dtype.itemsize]
    pixels = np.ascontiguousarray(rows).view(dtype).astype(name)
    if not colours:
        return pixels.reshape(shape)
    return np.ascontiguousarray(pixels.reshape(height_px, width_px, channels)[..., colours])


def check_codec(codec: str) -> None:
    """Raise InvalidInputError for a video format that this reader does not decode."""
    if codec not in VIDEO_CODECS:
        raise InvalidInputError(
            f"video format {codec!r}; expected one of {', '.join(VIDEO_CODECS)}"
        )


# Packets of a video that are tried until one shows an image.
MAX_TRIED: Final = 300


class VideoDecoder:
    """Decoder of one camera's video, packet by packet; a packet is one image, without B-frames."""

    def __init__(self, codec: str) -> None:
        self._context: Any = av.CodecContext.create(VIDEO_CODECS[codec], "r")
        self._context.thread_count = 1
        # Without low_delay: images come in the order in which they are shown.
        self._context.options = {"max_pixels": str(MAX_PIXELS)}
        self._reformatter = VideoReformatter()
        self._sent = self.num_corrupt = 0

    def decode(self, data: bytes | None) -> Iterator[tuple[int, VideoFrame]]:
        """Images that a packet completes, with the number of their packet; None ends the video.

        Raises CorruptDataError if a packet cannot be decoded.
        """
        packet = None
        if data is not None:
            packet = av.Packet(data)
            packet.pts = packet.dts = self._sent
            self._sent += 1
        try:
            for frame in self._context.decode(packet):
                self.num_corrupt += bool(frame.is_corrupt)
                if frame.pts is not None and not frame.is_corrupt:
                    yield frame.pts, frame
        except (av.FFmpegError, ValueError) as error:
            raise CorruptDataError(f"video packet cannot be decoded ({error})") from error

    def is_delayed(self) -> bool:
        """Whether images wait for later packets, as B-frames need it."""
        return bool(self._context.has_b_frames)

    def to_rgb(self, frame: VideoFrame) -> np.ndarray:
        """Pixels of a decoded image, uint8 [h, w, 3]."""
        return self._reformatter.reformat(
            frame, format="rgb24", interpolation="BICUBIC"
        ).to_ndarray()


def check_order(codec: str, packets: Sequence[bytes]) -> bool:
    """Whether the first packets of a video are 4:2:0 and need no later ones.

    Raises InvalidInputError for images that are shown in another order than they are sent.
    """
    decoder, numbers, is_plain = VideoDecoder(codec), [-1], True
    try:
        for data in (*packets, None):
            for number, frame in decoder.decode(data):
                numbers.append(number)
                is_plain = is_plain and frame.format.name in {"yuv420p", "yuvj420p"}
    except CorruptDataError:
        is_plain = False
    if numbers != sorted(numbers):
        raise InvalidInputError(
            "video with B-frames, whose images are shown in another order than they are sent; "
            "encode it without them"
        )
    return is_plain and not decoder.is_delayed()


def video_size(codec: str, packet: bytes) -> tuple[int, int] | None:
    """Height and width of the image in a packet; None if it does not begin a video."""
    decoder = VideoDecoder(codec)
    try:
        for data in (packet, None):
            for _, frame in decoder.decode(data):
                check_pixels(frame.height, frame.width)
                return frame.height, frame.width
    except CorruptDataError:
        return None
    return None


@dataclass
class Video:
    """What the first pass learns of a video."""

    codec: str
    size_px: tuple[int, int] | None = None
    num_packets: int = 0
    num_before: int = 0
    in_groups: bool = True
    parameters: bytes = b""
    first_packets: list[bytes] = field(default_factory=list)

    def add(self, data: bytes) -> None:
        """Learn from the next packet."""
        if self.size_px is None and self.num_before < MAX_TRIED:
            self.size_px = video_size(self.codec, data)
        if self.size_px is None:
            self.num_before += 1
            return
        if self.in_groups:
            sets = parameter_sets(data) if self.codec == "h264" else b""
            is_in_place = bool(sets) == (self.num_packets % GOP_IMAGES == 0)
            is_same = sets in {b"", self.parameters} or video_size("h264", data) == self.size_px
            self.in_groups, self.parameters = is_in_place and is_same, sets or self.parameters
        if self.num_packets < 4 * GOP_IMAGES:
            self.first_packets.append(data)
        self.num_packets += 1

    def is_kept(self) -> bool:
        """Whether its packets are the store's already: closed groups of 8 images in 4:2:0.

        Raises InvalidInputError for B-frames.
        """
        is_plain = check_order(self.codec, self.first_packets)
        if not (is_plain and self.in_groups) or self.size_px is None or self.num_before:
            return False
        return self.size_px[0] % 2 == 0 == self.size_px[1] % 2


class Losses:
    """Tells which images of a video are wrong, since packets before them are missing.

    Of H.264 the numbers of the pictures tell it, of others and beside them the times.
    """

    def __init__(self, codec: str, step_ns: float) -> None:
        self._codec, self._step_ns = codec, step_ns
        self._frame_numbers = FrameNumbers()
        self._num_packets = self._last_ns = 0
        # Since packets were lost, until the next key frame; packets of then without their image.
        self._is_broken = False
        self._broken: set[int] = set()

    def add(self, data: bytes, t_ns: int) -> None:
        """Note whether the image of a packet can be right: it may refer to one that is missing."""
        num_steps = (t_ns - self._last_ns) / self._step_ns if self._num_packets else 1.0
        self._last_ns = t_ns
        if self._codec == "h264":
            try:
                self._is_broken = not self._frame_numbers.is_whole(data, num_steps)
            except CorruptDataError:
                self._is_broken = True
        else:
            self._is_broken = self._is_broken or num_steps >= MOST_STEPS
        if self._is_broken:
            self._broken.add(self._num_packets)
        self._num_packets += 1

    def is_right(self, number: int, *, is_keyframe: bool) -> bool:
        """Whether no packets were lost since the last key frame before an image."""
        is_broken = number in self._broken
        self._broken.discard(number)
        if is_broken and is_keyframe and self._codec != "h264":
            self._is_broken, self._broken = False, set()
            return True
        return not is_broken

    def lose(self) -> None:
        """Say that a packet could not be decoded."""
        self._frame_numbers.lose()
        self._is_broken = True
