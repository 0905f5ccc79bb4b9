"""Video in files of other tools: decoded packet by packet, and what lost packets make of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from dextouch.bridges.foreign_images import MAX_PIXELS, VIDEO_CODECS, check_pixels
from dextouch.episodes import GOP_IMAGES, MOST_STEPS, FrameNumbers, is_keyframe
from dextouch.errors import CorruptDataError, InvalidInputError

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
        frame = self._reformatter.reformat(frame, format="rgb24", interpolation="BICUBIC")
        plane = frame.planes[0]
        rows = np.frombuffer(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
        pixels = rows[: frame.height, : 3 * frame.width]
        return np.ascontiguousarray(pixels).reshape(frame.height, frame.width, 3)


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
    first_packets: list[bytes] = field(default_factory=list)

    def add(self, data: bytes) -> None:
        """Learn from the next packet."""
        if self.size_px is None and self.num_before < MAX_TRIED:
            self.size_px = video_size(self.codec, data)
        if self.size_px is None:
            self.num_before += 1
            return
        begins = self.num_packets % GOP_IMAGES == 0
        self.in_groups = self.in_groups and self.codec == "h264" and is_keyframe(data) == begins
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
