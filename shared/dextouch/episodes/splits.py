"""Scenes of episodes, and splits that keep every scene on one side, the same in every store.

All episodes of one scene (task and seed) belong together: those of people and robots, of every
demonstrator, and what was imagined from them. As in the paper's protocol, world models are trained
on some of the splits A, B and C and imagine episodes of another.
"""

import hashlib
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Final, Literal, Protocol, TypeVar, get_args, runtime_checkable

from dextouch.errors import InvalidInputError

if TYPE_CHECKING:
    from dextouch.schemas import EpisodeAttributes

Split = Literal["A", "B", "C"]
SPLITS: Final[tuple[Split, ...]] = get_args(Split)


@runtime_checkable
class InScene(Protocol):
    """Anything that belongs to a scene."""

    @property
    def scene(self) -> str:
        """Name of the scene, from `scene_of`."""


InSceneT = TypeVar("InSceneT", bound=InScene)


def scene_of(attributes: "EpisodeAttributes") -> str:
    """Name of an episode's scene, TASK/SEED.

    Without a seed (recordings of people and real robots), a recording is a scene of its own, which
    it shares with all that is made of it: TASK/RECORDING, or TASK/EPISODE where none is known.
    """
    if attributes.seed is not None:
        return f"{attributes.task}/{attributes.seed}"
    found = recording_of(attributes)
    if not found and attributes.origin == "imagined":
        # Of the episode that this one was imagined from.
        found = next((entry.id for entry in attributes.lineage if entry.kind == "episode"), None)
    return f"{attributes.task}/{found or attributes.episode_id}"


def recording_of(attributes: "EpisodeAttributes") -> str | None:
    """The recording that an episode was aligned from, by a digest of its content or its id."""
    for entry in attributes.lineage:
        if entry.kind == "recording":
            return entry.id if entry.sha256 is None else entry.sha256[:16]
    return None


def split_of(attributes: "EpisodeAttributes") -> Split:
    """Split of an episode: a third of all scenes each, by a hash of the scene's name."""
    return _split_of(scene_of(attributes))


def split_of_scene(task: str, scene: int | str) -> Split:
    """Split of a task's scene, given by its seed."""
    return _split_of(f"{task}/{scene}")


def is_in(attributes: "EpisodeAttributes", splits: Collection[Split]) -> bool:
    """Whether an episode is in one of these splits; all are if none is given."""
    return not splits or split_of(attributes) in splits


def scene_fraction(scene: str, *, salt: str = "") -> float:
    """A number in 0 … 1 for every name of a scene, evenly spread: a hash of it, and of the salt."""
    digest = hashlib.sha256(f"{salt}{scene}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


def split_by_scene(
    items: Iterable[InSceneT], *, held_out_share: float, salt: str = ""
) -> tuple[list[InSceneT], list[InSceneT]]:
    """Training and held-out items; all of a scene are on one side, whatever else there is.

    `held_out_share` is that of the scenes; another salt holds out other ones.

    Raises InvalidInputError for an empty side.
    """
    training: list[InSceneT] = []
    held_out: list[InSceneT] = []
    for item in items:
        is_held_out = scene_fraction(item.scene, salt=salt) < held_out_share
        (held_out if is_held_out else training).append(item)
    if not training or not held_out:
        raise InvalidInputError(
            f"split: got {len(training)} training and {len(held_out)} held-out episodes with a "
            f"share of {held_out_share:g}, expected at least one each; record more scenes"
        )
    return training, held_out


def _split_of(scene: str) -> Split:
    digest = hashlib.sha256(f"split/{scene}".encode()).digest()
    return SPLITS[int.from_bytes(digest[:8], "big") % len(SPLITS)]
