"""Interface of storage designs under comparison: write a take, open it, read windows."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from benchmarks.store.workload import WINDOW_IMAGES, WINDOW_TACTILE, Workload


@dataclass(frozen=True)
class StoreWindow:
    """17 images of one camera with the touch and actions of the same interval."""

    images: UInt8[np.ndarray, "17 480 640 3"]
    tactile_left: UInt16[np.ndarray, "34 360"]
    tactile_right: UInt16[np.ndarray, "34 360"]
    actions: Float32[np.ndarray, "17 67"]


class OpenStore(ABC):
    """A written take, open for reading.

    `window` may be called concurrently for different cameras, never for the same one.
    """

    @abstractmethod
    def window(self, camera: str, start: int) -> StoreWindow:
        """The window that starts at image `start` of a camera; only that camera is decoded."""

    def windows(self, cameras: Sequence[str], start: int, *, threaded: bool) -> list[StoreWindow]:
        """The same span of several cameras, sequentially or in one thread each.

        A design may override it with a faster implementation.
        """
        if not threaded:
            return [self.window(camera, start) for camera in cameras]
        with ThreadPoolExecutor(len(cameras)) as threads:
            return list(threads.map(lambda camera: self.window(camera, start), cameras))


class StreamStore(OpenStore):
    """An open store whose streams are read one by one, so touch also without images."""

    @abstractmethod
    def images(self, camera: str, start: int) -> np.ndarray:
        """The images of a window."""

    @abstractmethod
    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        """Samples of a numeric stream."""

    def touch(self, start: int) -> tuple[np.ndarray, np.ndarray]:
        """34 samples of the left and of the right hand, those of the window at image `start`."""
        left, right = (
            self.numbers(name, 2 * start, WINDOW_TACTILE)
            for name in ("tactile_left", "tactile_right")
        )
        return left, right

    def window(self, camera: str, start: int) -> StoreWindow:
        """From single streams."""
        images = self.images(camera, start)
        left, right = self.touch(start)
        return StoreWindow(images, left, right, self.numbers("action", start, WINDOW_IMAGES))


@runtime_checkable
class Design(Protocol):
    """A storage design."""

    @property
    def name(self) -> str:
        """Short, unique name for `--designs` and tables."""

    @property
    def reads(self) -> str | None:
        """Name of the design whose files this one reads; None if it writes its own."""

    def missing(self) -> str | None:
        """Missing dependency (package or codec); None if the design is available."""

    def write(self, workload: Workload, folder: Path) -> None:
        """Write the take into a new folder as a station would, image by image in order of time."""

    def open(self, folder: Path) -> OpenStore:
        """Open the files of `write`."""
