"""Splits A, B and C of episodes by scene, the same in every store.

As in the paper's protocol, world models are trained on some splits and imagine episodes of another.
All episodes of one scene (task and seed) are in one split: those of people and robots, of every
demonstrator, and what was imagined from them.
"""

import hashlib
from collections.abc import Collection
from typing import Final, Literal, get_args

from dextouch.schemas import EpisodeAttributes

Split = Literal["A", "B", "C"]
SPLITS: Final[tuple[Split, ...]] = get_args(Split)


def split_of(attributes: EpisodeAttributes) -> Split:
    """Split of an episode: a third of all scenes each, by a hash of task and seed.

    Without a seed (recordings of people and real robots), an episode is a scene of its own, which
    it shares with episodes imagined from it.
    """
    scene = attributes.seed if attributes.seed is not None else _first_episode(attributes)
    return split_of_scene(attributes.task, scene)


def split_of_scene(task: str, scene: int | str) -> Split:
    """Split of a task's scene, given by its seed."""
    digest = hashlib.sha256(f"split/{task}/{scene}".encode()).digest()
    return SPLITS[int.from_bytes(digest[:8], "big") % len(SPLITS)]


def is_in(attributes: EpisodeAttributes, splits: Collection[Split]) -> bool:
    """Whether an episode is in one of these splits; all are if none is given."""
    return not splits or split_of(attributes) in splits


def _first_episode(attributes: EpisodeAttributes) -> str:
    """Id of the episode that this one was imagined from, or its own."""
    if attributes.origin == "imagined":
        for entry in attributes.lineage:
            if entry.kind == "episode":
                return entry.id
    return attributes.episode_id
