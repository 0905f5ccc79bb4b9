"""Touch of single hands from episode stores, to train and evaluate tactile tokenizers."""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import Float32

from dextouch.episodes import EpisodeStore, Split, scene_fraction, scene_of
from dextouch.errors import InvalidInputError
from services.world_model.training.episodes import training_ids


@dataclass(frozen=True)
class TactileHands:
    """Measured touch of the hands of some scenes, at the model rate."""

    tactile_kpa: Float32[np.ndarray, "hands 320"]
    scenes: tuple[str, ...]

    def data_hash(self) -> str:
        """Hash of all pressures."""
        return hashlib.sha256(self.tactile_kpa.astype("<f4").tobytes()).hexdigest()


def load_hands(
    urls: Sequence[str], *, splits: Collection[Split] = (), heldout_share: float
) -> tuple[TactileHands, TactileHands]:
    """Training and held-out hands of all people and robots; a scene is on one side only.

    Hands of steps without a measurement and imagined episodes are left out.

    Raises:
        InvalidInputError: either side has no hand.
    """
    sides: tuple[dict[str, list[np.ndarray]], dict[str, list[np.ndarray]]] = ({}, {})
    for url in urls:
        store = EpisodeStore(url)
        for episode_id in sorted(training_ids(store, splits)):
            reader = store.open(episode_id)
            window = reader.window(0, reader.num_steps, cameras=())
            scene = scene_of(reader.attributes)
            side = sides[scene_fraction(scene) < heldout_share]
            side.setdefault(scene, []).append(window.tactile_kpa[window.tactile_valid])
    if not all(sides):
        raise InvalidInputError(
            f"tokenizer: got {len(sides[0])} scenes to train on and {len(sides[1])} held out, "
            "expected at least one each; add episodes or change --heldout-share"
        )
    training, heldout = (
        TactileHands(np.concatenate([*chain(*side.values())]), tuple(sorted(side)))
        for side in sides
    )
    return training, heldout
