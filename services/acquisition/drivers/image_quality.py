"""Checks of a camera's images: frozen, blurred, badly exposed or missing.

Cheap enough for every image of a 720p camera: a checksum of a few pixels of each image, and of
every third image sharpness and exposure at a quarter of the size.
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from dextouch.errors import InvalidInputError

CHECK_EVERY = 3
# More than three equal images in a row: no sensor is that free of noise.
MAX_EQUAL_IMAGES = 3
BLURRED_BELOW = 0.3
# Before that many checks there is no session to compare with.
MIN_SHARPNESSES = 10
MAX_SHARPNESSES = 512
CLIPPED_ABOVE = 0.2
DARK_LEVEL, BRIGHT_LEVEL = 5, 250
# A gap of the driver's stamps stays a current flag for this long.
GAP_PERIODS = 1.5
GAP_SHOWN_NS = 1_000_000_000
_CHECKSUM_ROWS = 90
_QUARTER = 4


@dataclass
class ImageQuality:
    """Quality of the newest images of one camera, and counters since the start.

    Attributes:
        frozen: more than three images in a row were equal.
        blurred: sharpness below 0.3 of the session's median.
        clipped_ratio: share of pixels at the dark or the bright end, 0 … 1.
        gap: at least one image is missing in the driver's timestamps within the last second.
        num_checked: images whose sharpness and exposure were checked.
        num_images: all images seen.
        num_frozen: images that were equal to at least three before them.
        num_blurred: of the checked ones.
        num_clipped: of the checked ones, those with more than 20 % clipped pixels.
        num_gaps: gaps of the driver's stamps.
        num_dropped: images that found the encoder's queue full.
    """

    frozen: bool = False
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
    """Checks the images of one camera in order of arrival; used by one thread.

    Args:
        period_ns: nominal distance of two images.
        check_every: of how many images one has its sharpness and exposure checked.
    """

    def __init__(self, *, period_ns: int, check_every: int = CHECK_EVERY) -> None:
        if period_ns <= 0 or check_every < 1:
            raise InvalidInputError(
                f"image checker: got period {period_ns} ns and every {check_every}, expected a "
                "positive period and at least 1"
            )
        self._period_ns = period_ns
        self._check_every = check_every
        self._found = ImageQuality()
        self._checksum: int | None = None
        self._num_equal = 0
        self._last_t_ns: int | None = None
        self._gap_seen_ns: int | None = None
        self._median = SessionMedian()

    @property
    def quality(self) -> ImageQuality:
        """What was found so far; a copy."""
        return replace(self._found)

    def check(self, image: UInt8[np.ndarray, "h w 3"], t_ns: int | None = None) -> None:
        """Look at the next image.

        Args:
            image: RGB.
            t_ns: the driver's stamp, if it gives one; must grow.
        """
        step = max(1, min(image.shape[:2]) // _CHECKSUM_ROWS)
        self.note(image[::step, ::step].tobytes(), t_ns)
        if (self._found.num_images - 1) % self._check_every == 0:
            self.look(image)

    def note(self, data: bytes, t_ns: int | None = None) -> None:
        """The next image as bytes that are equal only for equal images, such as its JPEG bytes."""
        self._found.num_images += 1
        checksum = zlib.crc32(data)
        self._num_equal = self._num_equal + 1 if checksum == self._checksum else 1
        self._checksum = checksum
        self._found.frozen = self._num_equal > MAX_EQUAL_IMAGES
        self._found.num_frozen += self._found.frozen
        if t_ns is not None:
            self._note_stamp(t_ns)

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
    height, width = image.shape[0] // _QUARTER * _QUARTER, image.shape[1] // _QUARTER * _QUARTER
    if min(height, width) < 3 * _QUARTER:
        return np.ascontiguousarray(green)
    rows, columns = slice(0, height, _QUARTER), slice(0, width, _QUARTER)
    lower, right = slice(2, height, _QUARTER), slice(2, width, _QUARTER)
    total = green[rows, columns].astype(np.uint16)
    total += green[rows, right]
    total += green[lower, columns]
    total += green[lower, right]
    return (total >> 2).astype(np.uint8)


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
