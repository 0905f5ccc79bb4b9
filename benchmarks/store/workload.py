"""Workload of the store benchmark: the streams of one take, each at its rate."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, Shaped

CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
IMAGE_SHAPE = (480, 640, 3)
IMAGE_RATE_HZ = 30
# Of every rival that keeps JPEG.
JPEG_QUALITY = 90
# A window: images of one camera with the touch and the actions of their time.
WINDOW_IMAGES = 17
WINDOW_TACTILE = 34
# Samples of a numeric stream in one second.
NUMERIC_RATES_HZ = {
    "tactile_left": 60,
    "tactile_right": 60,
    "keypoints_left": 120,
    "keypoints_right": 120,
    "wrist_left": 100,
    "wrist_right": 100,
    "head": 100,
    "action": 30,
}


@dataclass(frozen=True)
class TimedStream:
    """One stream: its samples, with strictly increasing timestamps."""

    values: Shaped[np.ndarray, "n ..."]
    t_ref_ns: Int64[np.ndarray, " n"]
    rate_hz: int

    def first(self, seconds: float) -> "TimedStream":
        """The samples of the first seconds."""
        stop = max(1, round(seconds * self.rate_hz))
        return TimedStream(self.values[:stop], self.t_ref_ns[:stop], self.rate_hz)


@dataclass(frozen=True)
class Workload:
    """One take: images uint8 [n, 480, 640, 3] per camera, and the streams of docs/benchmarks.md.

    Sample 2k of a tactile stream, image k and action k belong together: a window that starts at
    image k contains WINDOW_IMAGES images and actions from k on and WINDOW_TACTILE tactile samples
    per hand from 2k on.
    """

    seconds: float
    images: Mapping[str, TimedStream]
    numbers: Mapping[str, TimedStream]

    @property
    def num_images(self) -> int:
        """Images of one camera."""
        return len(self.images[CAMERAS[0]].t_ref_ns)

    @property
    def num_starts(self) -> int:
        """Windows start at 0 … num_starts - 1."""
        return self.num_images - WINDOW_IMAGES + 1

    def arrived_with(self, name: str, image_index: int) -> slice:
        """The samples of a numeric stream that arrive between an image and the one before it."""
        count = len(self.numbers[name].t_ref_ns)
        return slice(
            image_index * count // self.num_images, (image_index + 1) * count // self.num_images
        )

    def first(self, seconds: float) -> "Workload":
        """The first seconds of the take, for warm-up."""
        return Workload(
            seconds,
            {name: stream.first(seconds) for name, stream in self.images.items()},
            {name: stream.first(seconds) for name, stream in self.numbers.items()},
        )
