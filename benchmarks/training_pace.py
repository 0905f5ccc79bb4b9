"""Throughput of data loading and training, in windows per second."""

import time
from collections.abc import Generator, Iterator
from itertools import islice

import torch

from services.world_model.paper_settings import TrainSettings
from services.world_model.training.dataset import WindowBatch, index_episodes, read_batches
from services.world_model.training.trainer import TrainingRun


class TrainingPace:
    """Windows per second of the loader and the training step, separately and together.

    All measurements use the same network, the same sampling of windows and one thread, and exclude
    one-time work: codecs are fitted and worker processes started beforehand.

    Args:
        url: URL of an episode store.
        fit_windows: windows the codecs are fitted on.
    """

    def __init__(self, url: str, *, fit_windows: int = 256) -> None:
        torch.set_num_threads(1)
        plain = TrainSettings(episodes=url, streaming=True, loader_workers=0)
        windows = plain.windows.model_copy(update={"fit_windows": fit_windows})
        self._settings = plain.model_copy(update={"windows": windows})
        self._episodes = index_episodes(url)
        self._run = TrainingRun(self._episodes, self._settings)
        self._run.fit_codecs()
        self._run.model.train()

    @property
    def num_episodes(self) -> int:
        """Episodes in the store."""
        return len(self._episodes)

    @property
    def batch(self) -> int:
        """Windows per step."""
        return self._settings.optimizer.batch

    def loading(self, num_batches: int, *, num_workers: int) -> float:
        """Windows per second of the loader alone."""
        batches = self._batches(num_workers)
        start_s = time.perf_counter()
        for _ in islice(batches, num_batches):
            pass
        elapsed_s = time.perf_counter() - start_s
        batches.close()
        return num_batches * self.batch / elapsed_s

    def learning(self, num_batches: int) -> float:
        """Windows per second of training on windows in memory."""
        ready = list(islice(self._batches(0), num_batches))
        return self._learn(iter(ready), num_batches)

    def both(self, num_batches: int, *, num_workers: int) -> float:
        """Windows per second of training on windows read from disk."""
        batches = self._batches(num_workers)
        rate = self._learn(batches, num_batches)
        batches.close()
        return rate

    def _batches(self, num_workers: int) -> Generator[WindowBatch, None, None]:
        batches = read_batches(self._episodes, self._run.places(), num_workers=num_workers)
        # Skip what was read ahead while the processes started: two batches each.
        for _ in islice(batches, 2 * num_workers + 1):
            pass
        return batches

    def _learn(self, batches: Iterator[WindowBatch], num_batches: int) -> float:
        start_s = time.perf_counter()
        for batch in islice(batches, num_batches):
            self._run.learn(batch)
        return num_batches * self.batch / (time.perf_counter() - start_s)
