"""Images of a camera: their quality, and their encoding to JPEG or H.264 in a separate thread.

The store takes an H.264 stream only in closed groups of GOP_IMAGES images, counted from the first
image of the take. Hence images are dropped before they are encoded, never after; an encoder goes
on with its group over a gap and over a reopened device; and a take begins with a new group.
"""

import concurrent.futures
import threading
import zlib
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from dextouch import episodes
from dextouch.errors import CorruptDataError, DeviceError, NotFoundError
from dextouch.images import encode_jpeg
from dextouch.streams import (
    ImageFault,
    Sample,
    encoded_values,
    image_faults,
    is_same_picture,
    thumbnail,
)
from services.acquisition.drivers.packets import DecoderStatistics

CHECK_EVERY = 3
# More than three equal images in a row: no sensor is that free of noise.
MAX_EQUAL_IMAGES = 3
# Cameras that send every image twice repeat half of them; the share is over some 30 images.
MAX_EQUAL_SHARE = 0.4
EQUAL_SHARE_IMAGES = 30
# So many images a buffer may repeat in turn.
MAX_LOOP, MAX_AGAIN = 30, 10
BLURRED_BELOW = 0.3
# Before that many checks there is no session to compare with.
MIN_SHARPNESSES = 10
MAX_SHARPNESSES = 512
CLIPPED_ABOVE = 0.2
DARK_LEVEL, BRIGHT_LEVEL = 5, 250
# A gap of the driver's stamps stays a current flag for this long.
GAP_PERIODS = 1.5
GAP_SHOWN_NS = 1_000_000_000
# Pictures that are judged together, as often as so many are new; the newest wait for what follows.
JUDGED_PICTURES, NEW_PICTURES, LATER_PICTURES = 60, 15, 5
_CHECKSUM_ROWS = 90
_QUARTER = 4
ImageEncoding = Literal["rgb8", "jpeg", "h264"]
MAX_WAITING_IMAGES = 8


@dataclass
class ImageQuality:
    """Quality of the newest images of one camera, and counters since the start.

    `frozen`: more than three images in a row were equal, more than ten were among the 30 before, or
    over 40 % equal the one before;
    `blurred`: sharpness is below 0.3 of the session's median; `clipped_ratio`: pixels at the dark
    or the bright end; `gap`: an image is missing in the driver's timestamps within the last second.
    Sharpness and exposure are those of the checked images; dropped ones found the encoder's queue
    full. `fault` is what no working camera sends, of the last half second; `still_s` how long the
    content has been the same but for noise.
    """

    frozen: bool = False
    fault: ImageFault | None = None
    still_s: float = 0.0
    blurred: bool = False
    clipped_ratio: float = 0.0
    gap: bool = False
    num_checked: int = 0
    num_images: int = 0
    num_frozen: int = 0
    num_blurred: int = 0
    num_clipped: int = 0
    num_gaps: int = 0
    num_dropped: int = 0
    num_faulty: int = 0

    @property
    def clipped(self) -> bool:
        """Whether the newest checked image is over- or under-exposed."""
        return self.clipped_ratio > CLIPPED_ABOVE

    def events(self) -> dict[str, int]:
        """The counters of what is wrong with images, by the codes that the health has for it."""
        return {
            "image_frozen": self.num_frozen,
            "image_blurred": self.num_blurred,
            "image_clipped": self.num_clipped,
            "image_gap": self.num_gaps,
            "image_content": self.num_faulty,
            "queue": self.num_dropped,
        }


class SessionMedian:
    """The median of a whole session in bounded memory: evenly thinned out when it gets full."""

    def __init__(self) -> None:
        self._values: list[float] = []
        self._every = 1
        self._num_seen = 0

    def add(self, value: float) -> None:
        """One more value."""
        if self._num_seen % self._every == 0:
            self._values.append(value)
        self._num_seen += 1
        if len(self._values) == MAX_SHARPNESSES:
            del self._values[1::2]
            self._every *= 2

    @property
    def value(self) -> float | None:
        """The median; None of fewer than 10 values."""
        return float(np.median(self._values)) if len(self._values) >= MIN_SHARPNESSES else None


class ImageChecker:
    """Checks the images of one camera in order of arrival; used by one thread."""

    def __init__(self, *, period_ns: int) -> None:
        self._period_ns = period_ns
        self._found = ImageQuality()
        self._checksums: deque[int] = deque(maxlen=MAX_LOOP)
        self._num_equal = self._num_again = 0
        self._equal_share = 0.0
        self._last_t_ns: int | None = None
        self._gap_seen_ns: int | None = None
        self._median = SessionMedian()
        self._pictures: deque[np.ndarray] = deque(maxlen=JUDGED_PICTURES)
        self._still: list[np.ndarray] = []
        self._num_new = 0

    @property
    def quality(self) -> ImageQuality:
        """What was found so far; a copy."""
        return replace(self._found)

    def check(self, image: UInt8[np.ndarray, "h w 3"], t_ns: int | None = None) -> None:
        """Look at the next image (RGB); the driver's stamps, if it gives any, must grow."""
        step = max(1, min(image.shape[:2]) // _CHECKSUM_ROWS)
        self.note(image[::step, ::step].tobytes(), t_ns)
        self.see(image)
        if (self._found.num_images - 1) % CHECK_EVERY == 0:
            self.look(image)

    def note(self, data: bytes, t_ns: int | None = None) -> None:
        """The next image as bytes that are equal only for equal images, such as its JPEG bytes."""
        self._found.num_images += 1
        checksum = zlib.crc32(data)
        recent = self._checksums
        is_equal = bool(recent) and checksum == recent[-1]
        # Those of a buffer come again in turn.
        self._num_again = self._num_again + 1 if checksum in recent else 0
        if not is_equal and self._num_equal > MAX_EQUAL_IMAGES:
            # What was frozen is no camera that repeats its images.
            self._equal_share = 0.0
        self._num_equal = self._num_equal + 1 if is_equal else 1
        self._checksums.append(checksum)
        self._equal_share += (is_equal - self._equal_share) / EQUAL_SHARE_IMAGES
        repeats = self._equal_share > MAX_EQUAL_SHARE
        is_held = self._num_equal > MAX_EQUAL_IMAGES
        self._found.frozen = is_held or repeats or self._num_again > MAX_AGAIN
        self._found.num_frozen += self._found.frozen
        if t_ns is not None:
            self._note_stamp(t_ns)

    def see(self, image: UInt8[np.ndarray, "h w c"]) -> None:
        """Judge the next image, or a small or gray copy of it, beside the others."""
        picture, found = thumbnail(image), self._found
        self._pictures.append(picture)
        if not self._still or not is_same_picture(picture, self._still[0]):
            self._still, found.still_s = [picture], 0.0
        found.still_s += self._period_ns * 1e-9
        self._num_new += 1
        if self._num_new < NEW_PICTURES or len(self._pictures) < JUDGED_PICTURES // 2:
            return
        stop, self._num_new = len(self._pictures) - LATER_PICTURES, 0
        faults, judged = image_faults(np.stack(self._pictures)), slice(stop - NEW_PICTURES, stop)
        new = {name: int(m[judged].sum()) for name, m in faults.items() if m[judged].any()}
        rising = sorted(new, key=new.__getitem__)
        found.fault = rising[-1] if rising else None
        found.num_faulty += sum(new.values())

    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Sharpness and exposure of an image."""
        gray = quarter_size(image)
        sharpness = laplacian_variance(gray)
        clipped = int(np.count_nonzero((gray <= DARK_LEVEL) | (gray >= BRIGHT_LEVEL)))
        median = self._median.value
        self._median.add(sharpness)
        found = self._found
        found.blurred = median is not None and sharpness < BLURRED_BELOW * median
        found.clipped_ratio = clipped / gray.size
        found.num_checked += 1
        found.num_blurred += found.blurred
        found.num_clipped += found.clipped

    def _note_stamp(self, t_ns: int) -> None:
        if self._last_t_ns is not None:
            gap_ns = t_ns - self._last_t_ns
            if gap_ns > GAP_PERIODS * self._period_ns:
                self._found.num_gaps += 1
                self._gap_seen_ns = t_ns
        self._last_t_ns = t_ns
        seen_ns = self._gap_seen_ns
        self._found.gap = seen_ns is not None and t_ns - seen_ns <= GAP_SHOWN_NS


def quarter_size(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "a b"]:
    """Green at a quarter of height and width: the mean of 4 of each 16 pixels, against noise.

    Images of less than 12 pixels are taken as they are.
    """
    green = image[..., 1]
    height, width = (size // _QUARTER * _QUARTER for size in green.shape)
    if min(height, width) < 3 * _QUARTER:
        return np.ascontiguousarray(green)
    every_other = green[:height:2, :width:2].astype(np.uint16)
    rows = every_other[::2] + every_other[1::2]
    return ((rows[:, ::2] + rows[:, 1::2]) >> 2).astype(np.uint8)


def laplacian_variance(gray: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian (4 neighbours), in counts squared; the smaller, the blurrier.

    The border is left out; an image without an inside has none: 0.
    """
    if min(gray.shape) < 3:
        return 0.0
    wide = gray.astype(np.int16)
    edges = wide[1:-1, :-2] + wide[1:-1, 2:]
    edges += wide[:-2, 1:-1]
    edges += wide[2:, 1:-1]
    edges -= wide[1:-1, 1:-1] << 2
    flat = edges.ravel().astype(np.float32)
    mean = float(flat.mean(dtype=np.float64))
    return float(np.dot(flat, flat)) / flat.size - mean * mean


class ImageEncoder:
    """Encodes the images of one camera in their order; used by one thread.

    `rgb8` leaves images as they are; for `h264` height and width must be even.

    Raises:
        InvalidInputError: a size that H.264 cannot have.
    """

    def __init__(
        self, encoding: ImageEncoding, size_px: tuple[int, int], *, rate_hz: float
    ) -> None:
        self.encoding: ImageEncoding = encoding
        self._size_px, self._rate_hz = size_px, rate_hz
        if encoding == "h264":
            episodes.check_video_size(*size_px)
            # Now, since it takes longer than the first images would wait.
            self._video = self._new_video()

    def encode(self, image: UInt8[np.ndarray, "h w 3"], *, begins: bool) -> np.ndarray:
        """The values of a sample: uint8 [h, w, 3] RGB, or bytes as a 0-d object array.

        `begins` says that the image must begin a group of pictures.
        """
        if self.encoding == "rgb8":
            return image
        if self.encoding == "jpeg":
            return encoded_values([encode_jpeg(image)]).reshape(())
        if begins:
            # A new encoder begins a new group; it costs no more than encoding an image.
            self._video = self._new_video()
        return encoded_values([self._video.encode(image)]).reshape(())

    def _new_video(self) -> episodes.GopEncoder:
        return episodes.GopEncoder(
            *self._size_px, rate_hz=self._rate_hz, settings=episodes.VideoSettings()
        )


class EncodingQueue:
    """Passes images to an encoder in a separate thread; what finds the queue full is dropped.

    `put` and `collect` belong to the reader thread, `begin_group` to any.
    """

    def __init__(self, encoder: ImageEncoder, *, name: str) -> None:
        self.num_dropped = 0
        self._encoder, self._name = encoder, name
        self._waiting: deque[concurrent.futures.Future[Sample]] = deque()
        self._thread: concurrent.futures.ThreadPoolExecutor | None = None
        self._is_group_wanted = False
        self._lock = threading.Lock()

    def begin_group(self) -> None:
        """The next image that is put begins a group."""
        with self._lock:
            self._is_group_wanted = True

    def put(self, image: Sample) -> bool:
        """Queue an image, uint8 [h, w, 3] RGB, which must not change any more; False if dropped."""
        num_waiting = sum(not future.done() for future in self._waiting)
        if num_waiting >= MAX_WAITING_IMAGES:
            self.num_dropped += 1
            return False
        if self._thread is None:
            self._thread = concurrent.futures.ThreadPoolExecutor(
                max_workers=1, thread_name_prefix=f"encode-{self._name}"
            )
        with self._lock:
            begins, self._is_group_wanted = self._is_group_wanted, False
        self._waiting.append(self._thread.submit(self._encode, image, begins))
        return True

    def collect(self, wait_s: float = 0.0) -> list[Sample]:
        """Samples that are ready, in order, after waiting so long for those that are not.

        Raises:
            DexTouchError: an image could not be encoded.
        """
        if wait_s > 0 and self._waiting:
            concurrent.futures.wait(self._waiting, timeout=wait_s)
        samples = []
        while self._waiting and self._waiting[0].done():
            samples.append(self._waiting.popleft().result())
        return samples

    def stop(self) -> None:
        """Encode what waits and end the thread; `collect` still gives it, `put` starts anew."""
        if self._thread is not None:
            self._thread.shutdown()
            self._thread = None

    def _encode(self, image: Sample, begins: bool) -> Sample:  # noqa: FBT001 - submitted
        return replace(image, values=self._encoder.encode(image.values, begins=begins))


class GroupPreview:
    """Keeps the H.264 images since the last key frame, so that the newest one can be looked at."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        self._size_px = size_px
        # Replaced, never changed: a viewer's thread may hold it.
        self._group: tuple[bytes, ...] = ()

    def add(self, access_unit: bytes) -> None:
        """The next image."""
        if episodes.is_keyframe(access_unit):
            self._group = (access_unit,)
        elif 0 < len(self._group) < episodes.GOP_IMAGES:
            self._group = (*self._group, access_unit)
        else:
            self._group = ()

    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The newest image, decoded now.

        Raises:
            NotFoundError: no key frame came yet.
            CorruptDataError: the bytes are no such images.
        """
        group = list(self._group)
        if not group:
            raise NotFoundError("H.264 preview: no key frame has come yet; ask again in a moment")
        pixels = np.empty((1, *self._size_px, 3), dtype=np.uint8)
        decoder = episodes.decoder_of_this_thread(*self._size_px)
        decoder.decode(group, [len(group) - 1], episodes.FULL_FORM, pixels)
        return pixels[0]


class WholeGroups:
    """Gives the H.264 samples of a device that encodes itself in whole groups only.

    A group that lost an image is dropped as a whole: the store could not take the rest of it. The
    images' own numbers tell what was lost before the device numbered its packets. Dropped images
    are counted as refused.
    """

    def __init__(self, stream: str, statistics: DecoderStatistics) -> None:
        self._stream, self._statistics = stream, statistics
        self._group: list[Sample] = []
        # The last complete group, after which one is expected to begin; empty where any may.
        self._complete: list[Sample] = []
        # Length of the group before; None of the first one.
        self._last_length: int | None = None

    def add(self, sample: Sample) -> list[Sample]:
        """The next sample; a whole group when it is the last one of it, [] before.

        Raises:
            DeviceError: the device's groups have another length.
        """
        begins = episodes.is_keyframe(sample.values.item())
        follows = _follow(self._group, sample)
        # Nothing is missing in either case: the device means its groups to be so long.
        is_too_short = begins and follows and self._is_meant_short()
        # A picture of a later group neither continues the last one nor repeats its last number.
        is_too_long = (
            not begins
            and _follow(self._complete, sample)
            and any(_is_complete([*self._complete[:end], sample]) for end in (None, -1))
        )
        if begins or not follows:
            self.reset()
        if is_too_short or is_too_long:
            self._statistics.refused += 1
            raise DeviceError(
                f"{self._stream}: its H.264 groups have another length than "
                f"{episodes.GOP_IMAGES} images; set the bridge's encoder, or send JPEG images"
            )
        if not (begins or follows):
            self._statistics.refused += 1
            return []
        self._group.append(sample)
        if len(self._group) < episodes.GOP_IMAGES:
            return []
        self._last_length = episodes.GOP_IMAGES
        self._complete, self._group = self._group, []
        return self._complete

    def reset(self) -> None:
        """Drop the unfinished group; the next sample need not follow."""
        self._statistics.refused += len(self._group)
        self._group, self._complete = [], []

    def _is_meant_short(self) -> bool:
        """Whether the group, which ends too early, is as long as the device's groups are.

        After a whole group, one short group has lost its last image before the device numbered it.
        """
        if not _is_complete(self._group):
            return False
        before, self._last_length = self._last_length, len(self._group)
        return before in {None, len(self._group)}


def _follow(samples: list[Sample], sample: Sample) -> bool:
    return bool(samples) and sample.sequence == samples[-1].sequence + 1


def _is_complete(samples: list[Sample]) -> bool:
    """Whether no picture is missing between these, by their own numbers."""
    try:
        return episodes.first_gap([one.values.item() for one in samples]) is None
    except CorruptDataError:
        return False
