"""Pretrained tactile tokenizer of a training run, which stays frozen while the experts train."""

from collections import Counter
from collections.abc import Sequence

from dextouch.episodes import scene_fraction
from dextouch.errors import InvalidInputError
from services.world_model.settings import TrainSettings
from services.world_model.tokenizer_files import StoredTokenizer, read_tokenizer
from services.world_model.training.dataset import E, TrainingEpisode


def with_tokenizer(settings: TrainSettings) -> tuple[TrainSettings, StoredTokenizer | None]:
    """The settings with the network of `--tokenizer`, and that tokenizer if one is given.

    Raises:
        InvalidInputError: a learned tokenizer without a file or an initial checkpoint that holds
            it, both of these, or a tokenizer for a network without touch.
        ConflictError: the network settings name another tokenizer than the file.
    """
    if settings.tokenizer is None:
        if settings.network.tokenizer != "principal_axes" and settings.init is None:
            raise InvalidInputError(
                f"training: the tokenizer {settings.network.tokenizer} is learned; train it first "
                "(dextouch train tokenizer) and give its file as --tokenizer"
            )
        return settings, None
    if not settings.network.use_touch:
        raise InvalidInputError(
            "training: got a --tokenizer for a network without touch; leave it out"
        )
    if settings.init is not None:
        raise InvalidInputError(
            "training: got --init and --tokenizer, expected one of them; the initial checkpoint "
            "holds the tokenizer that its latents come from"
        )
    stored = read_tokenizer(settings.tokenizer)
    network = stored.metadata.network(settings.network)
    return settings.model_copy(update={"network": network}), stored


def split_unseen(
    episodes: Sequence[E], stored: StoredTokenizer, *, heldout_percent: int
) -> tuple[list[E], list[E]]:
    """Training and held-out episodes, the latter of scenes that the tokenizer has not seen.

    Raises:
        InvalidInputError: either side would be empty.
    """
    sizes = Counter(episode.scene for episode in episodes)
    heldout: set[str] = set()
    for scene in sorted(sizes.keys() - set(stored.metadata.train_scenes), key=scene_fraction):
        if 100 * sum(sizes[one] for one in heldout) >= heldout_percent * len(episodes):
            break
        heldout.add(scene)
    if not 0 < len(heldout) < len(sizes):
        raise InvalidInputError(
            f"split: got {len(heldout)} of {len(sizes)} scenes to hold out that the tokenizer has "
            "not seen, expected some; give a --heldout store"
        )
    return (
        [episode for episode in episodes if episode.scene not in heldout],
        [episode for episode in episodes if episode.scene in heldout],
    )


def check_unseen(heldout: Sequence[TrainingEpisode], stored: StoredTokenizer) -> None:
    """Raise if the tokenizer was trained on the scene of a held-out episode."""
    seen = set(stored.metadata.train_scenes)
    both = [episode.episode_id for episode in heldout if episode.scene in seen]
    if both:
        raise InvalidInputError(
            f"training: the tokenizer was trained on the scenes of {len(both)} held-out episodes "
            f"{both[:3]}; give a --heldout store that it has not seen",
            episodes=both,
        )
