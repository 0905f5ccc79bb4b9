"""Bounded queue with a worker thread that encodes blocks of images in order, with backpressure."""

from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from dextouch.episodes.write_options import WhenFull

MAX_WAITING_IMAGES = 32
Work = Callable[[np.ndarray, Mapping[str, np.ndarray]], None]


class ImageQueue:
    """Passes blocks (images and their stamps) to `work` in order, in a background thread."""

    def __init__(self, work: Work, *, name: str, when_full: WhenFull) -> None:
        self.num_dropped = 0
        self._work, self._when_full = work, when_full
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._spare: deque[np.ndarray] = deque(maxlen=MAX_WAITING_IMAGES)
        self._num_images = 0
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix=f"encode-{name}")

    def put(self, values: np.ndarray, stamps: Mapping[str, np.ndarray]) -> None:
        """Queue a copy of a block; re-raises the exception of an earlier block."""
        while self._waiting and self._waiting[0][0].done():
            self._take_oldest()
        # A block larger than the queue is accepted when the queue is empty.
        while self._waiting and self._num_images + len(values) > MAX_WAITING_IMAGES:
            if self._when_full == "drop":
                self.num_dropped += len(values)
                return
            self._take_oldest()
        kept = {name: column.copy() for name, column in stamps.items()}
        work = self._thread.submit(self._hand_on, self._copy(values), kept)
        self._waiting.append((work, len(values)))
        self._num_images += len(values)

    def drain(self) -> None:
        """Wait until the queue is empty; raises as `put`."""
        while self._waiting:
            self._take_oldest()

    def stop(self, *, drop: bool) -> None:
        """End the thread, after discarding or writing the queued blocks."""
        self._thread.shutdown(cancel_futures=drop)

    def _copy(self, values: np.ndarray) -> np.ndarray:
        if values.dtype == object:
            return values.copy()
        # Reused buffers: page faults of fresh memory cost more than copying the image.
        while self._spare:
            spare = self._spare.pop()
            if spare.shape == values.shape:
                np.copyto(spare, values)
                return spare
        return values.copy()

    def _hand_on(self, values: np.ndarray, stamps: Mapping[str, np.ndarray]) -> None:
        self._work(values, stamps)
        if values.dtype != object:
            self._spare.append(values)

    def _take_oldest(self) -> None:
        done, num_images = self._waiting.popleft()
        self._num_images -= num_images
        done.result()
