"""Streaming dataset: reads windows from disk when they are needed.

For data larger than memory. A window is read through the store's reader, which decodes one camera
and only the span of the window.
"""

import multiprocessing
from collections.abc import Collection, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from dextouch.episodes import EpisodeGrid, EpisodeReader, EpisodeStore, Split, select_episodes
from dextouch.hands.actions import poses_from_actions, reanchor
from dextouch.schemas import ActionKind, Domain
from services.world_model.network.contact_geometry import ObjectsAtStart
from services.world_model.network.inputs import PredictionRequest
from services.world_model.training.dataset import (
    EpisodeArrays,
    TrainingEpisode,
    Window,
    WindowBatch,
    WindowPosition,
    stack_windows,
)
from services.world_model.training.episodes import (
    CUT,
    read_episode,
)

# Open readers per process; each holds an episode's timestamps and actions.
MAX_OPEN_READERS = 512
StartMethod = Literal["fork", "spawn", "forkserver"]


@lru_cache(maxsize=MAX_OPEN_READERS)
def _reader(url: str, episode_id: str) -> EpisodeReader:
    return EpisodeStore(url).open(episode_id)


@dataclass(frozen=True)
class StoredEpisode:
    """One episode that stays on disk; created by `index_episodes`."""

    url: str
    episode_id: str
    task: str
    scene: str
    num_steps: int
    action_kinds: tuple[ActionKind, ...]
    content_sha256: str
    print_sha256: str
    domain: Domain
    model_rate_hz: float
    image_px: int | None = None

    def __len__(self) -> int:
        return self.num_steps

    def fingerprint(self) -> str:
        """`fingerprint` of its arrays when it was indexed."""
        return self.print_sha256

    def load(self) -> EpisodeArrays:
        """Load the whole episode."""
        return read_episode(_reader(self.url, self.episode_id), image_px=self.image_px)

    def cut(self, place: WindowPosition) -> Window:
        """Read the window at a place in this episode.

        Raises:
            InvalidInputError: steps outside the episode.
            UnknownNameError: an action kind that it does not have.
            CorruptDataError: damaged bytes.
        """
        grid = EpisodeGrid(_reader(self.url, self.episode_id), self.image_px)
        read = grid.reader.window(
            place.start, place.num_steps, cameras=(), action_kind=place.action_kind
        )
        actions, anchor = read.actions, read.anchor
        if place.from_command and place.action_kind == "commanded":
            anchor = poses_from_actions(actions[:1], anchor).anchor(0)
            actions = reanchor(actions, 0)
        images = grid.images(range(place.start, place.start + place.num_steps))
        known = grid.boxed_objects(read.t_ref_ns[:1])
        objects = (
            None if known is None else ObjectsAtStart(known[0][0].astype(np.float64), known[1])
        )
        request = PredictionRequest(
            first_image=images[0],
            first_tactile_kpa=read.tactile_kpa[0],
            actions=actions,
            action_kind=place.action_kind,
            instruction=read.instruction,
            anchor=anchor,
            K_head=grid.K_head,
            objects=objects,
        )
        return Window(request, images, read.tactile_kpa, read.tactile_valid)


def index_episodes(
    url: str,
    *,
    splits: Collection[Split] = (),
    domain: Domain | None = None,
    image_px: int | None = None,
) -> list[StoredEpisode]:
    """`load_episodes`, for episodes that stay on disk; each is read once to be hashed."""
    # The episode of an id may have changed since it was last read.
    _reader.cache_clear()
    store, indexed = EpisodeStore(url), list[StoredEpisode]()
    for found in select_episodes([store], domain=domain, splits=splits, needs=CUT):
        # The cached reader, so that processes forked later inherit it open.
        arrays = read_episode(_reader(url, found.item_id), image_px=image_px)
        indexed.append(
            StoredEpisode(
                url=url,
                episode_id=arrays.episode_id,
                task=arrays.task,
                scene=arrays.scene,
                num_steps=len(arrays),
                action_kinds=arrays.action_kinds,
                content_sha256=arrays.content_sha256,
                print_sha256=arrays.fingerprint(),
                domain=arrays.domain,
                model_rate_hz=arrays.model_rate_hz,
                image_px=image_px,
            )
        )
    return indexed


class _Windows(Dataset[Window]):
    """Windows of episodes by their places; works in DataLoader workers, forked or spawned."""

    def __init__(self, episodes: Sequence[TrainingEpisode]) -> None:
        self._episodes = list(episodes)

    def __getitem__(self, place: WindowPosition) -> Window:
        return self._episodes[place.episode_index].cut(place)


def read_batches(
    episodes: Sequence[TrainingEpisode],
    places: Iterable[list[WindowPosition]],
    *,
    num_workers: int = 0,
    start_method: StartMethod | None = None,
) -> Generator[WindowBatch, None, None]:
    """Batches at these places, in order, independent of the number of processes.

    Args:
        episodes: episodes that the places refer to.
        places: places of each batch; may be endless and is read ahead.
        num_workers: reader processes, which end with the iterator; 0 reads in this process.
        start_method: start method of the processes; None for the platform's default.
    """
    loader = DataLoader(
        _Windows(episodes),
        batch_sampler=places,
        collate_fn=stack_windows,
        num_workers=num_workers,
        multiprocessing_context=_context(start_method) if num_workers else None,
        # Its own generator: otherwise the loader seeds its workers from the global one.
        generator=torch.Generator().manual_seed(0),
    )
    yield from loader


def _context(start_method: StartMethod | None) -> multiprocessing.context.BaseContext:
    return multiprocessing.get_context(start_method)
