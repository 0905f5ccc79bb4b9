"""What a store must do to be measured: write one take, open it, give windows of it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from services.cli.bench.store.workload import Workload


@dataclass(frozen=True)
class StoreWindow:
    """17 images of one camera with the touch of both hands and the actions of their time."""

    images: UInt8[np.ndarray, "17 480 640 3"]
    tactile_left: UInt16[np.ndarray, "34 360"]
    tactile_right: UInt16[np.ndarray, "34 360"]
    actions: Float32[np.ndarray, "17 67"]


class OpenStore(ABC):
    """A written take, open for reading.

    `window` is called for different cameras from different threads at once, never for one camera
    from two.
    """

    @abstractmethod
    def window(self, camera: str, start: int) -> StoreWindow:
        """The window that starts at image `start` of a camera; only that camera is decoded."""

    def windows(self, cameras: Sequence[str], start: int, *, threaded: bool) -> list[StoreWindow]:
        """The same span of several cameras, one after the other or a thread each.

        A design that has a better way of its own for this overrides it.
        """
        if not threaded:
            return [self.window(camera, start) for camera in cameras]
        with ThreadPoolExecutor(len(cameras)) as threads:
            return list(threads.map(lambda camera: self.window(camera, start), cameras))


@runtime_checkable
class ReadsTouch(Protocol):
    """An open store that can give the touch of a window without its images."""

    def touch(self, start: int) -> tuple[np.ndarray, np.ndarray]:
        """34 samples of the left and of the right hand, those of the window at image `start`."""


@runtime_checkable
class Design(Protocol):
    """One way to keep a take on disk."""

    @property
    def name(self) -> str:
        """Short and unique; what `--designs` takes and the table shows."""

    @property
    def reads(self) -> str | None:
        """Name of the design whose files this one only reads otherwise; None: it writes its own."""

    def missing(self) -> str | None:
        """Why this design cannot run here (a package, a codec); None when it can."""

    def write(self, workload: Workload, folder: Path) -> None:
        """Write the take as a station would: image by image, in the order of time.

        Args:
            workload: the take.
            folder: does not exist yet; everything that is written goes below it.
        """

    def open(self, folder: Path) -> OpenStore:
        """Open what `write` left in the folder."""
