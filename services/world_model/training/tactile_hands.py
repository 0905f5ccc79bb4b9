"""Touch of single hands from episode stores, to train and evaluate tactile tokenizers."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import Float32

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    Split,
    data_hash,
    scene_fraction,
    select_episodes,
)
from dextouch.errors import InvalidInputError

# By scene: the touch of each episode, and its content.
_Side = dict[str, list[tuple[np.ndarray, str]]]


@dataclass(frozen=True)
class TactileHands:
    """Measured touch of the hands of some scenes, at the model rate.

    `data_hash` is that of their episodes.
    """

    tactile_kpa: Float32[np.ndarray, "hands 320"]
    scenes: tuple[str, ...]
    data_hash: str


def load_hands(
    urls: Sequence[str], *, splits: Collection[Split] = (), heldout_share: float
) -> tuple[TactileHands, TactileHands]:
    """Training and held-out hands of all people and robots; a scene is on one side only.

    Hands of steps without a measurement and imagined episodes are left out.

    Raises:
        InvalidInputError: either side has no scene.
        NotFoundError, ConflictError: as `select_episodes`.
    """
    sides: tuple[_Side, _Side] = ({}, {})
    for reader in select_episodes([EpisodeStore(url) for url in urls], splits=splits):
        grid = EpisodeGrid(reader)
        touch_kpa, is_measured = grid.touch()
        side = sides[scene_fraction(grid.scene) < heldout_share]
        side.setdefault(grid.scene, []).append((touch_kpa[is_measured], grid.content_sha256))
    if not all(sides):
        raise InvalidInputError(
            f"tokenizer: got {len(sides[0])} scenes to train on and {len(sides[1])} held out, "
            "expected at least one each; add episodes or change --heldout-share"
        )
    training, heldout = (_hands(side) for side in sides)
    return training, heldout


def _hands(side: _Side) -> TactileHands:
    touch_kpa, contents = zip(*chain(*side.values()), strict=True)
    return TactileHands(np.concatenate(touch_kpa), tuple(sorted(side)), data_hash(contents))
