"""Training and held-out episodes, and the checks that keep them disjoint."""

from collections.abc import Sequence

from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import Checkpoint
from services.world_model.settings import TrainSettings
from services.world_model.training.dataset import EpisodeArrays, TrainingEpisode
from services.world_model.training.episodes import load_episodes, split_by_hash
from services.world_model.training.streaming import index_episodes


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    """Training and held-out episodes of the settings' stores; held-out ones are in memory."""
    if settings.streaming:
        return _stream_split(settings)
    episodes = load_episodes(settings.episodes, splits=settings.splits)
    if settings.heldout is None:
        return split_by_hash(episodes, heldout_percent=settings.heldout_percent)
    return episodes, load_episodes(settings.heldout)


def _stream_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    episodes = index_episodes(settings.episodes, splits=settings.splits)
    if settings.heldout is not None:
        return episodes, load_episodes(settings.heldout)
    trained, heldout = split_by_hash(episodes, heldout_percent=settings.heldout_percent)
    return trained, [episode.load() for episode in heldout]


def check_not_learned(heldout: Sequence[TrainingEpisode], ancestor: Checkpoint) -> None:
    """Raise if the initial checkpoint was trained on a held-out episode."""
    learned = set(ancestor.metadata.train_fingerprints)
    both = [episode.episode_id for episode in heldout if episode.content_hash() in learned]
    if both:
        raise InvalidInputError(
            f"training: the initial checkpoint was trained on {len(both)} of the held-out "
            f"episodes {both[:3]}; use a held-out store that it has not seen",
            episodes=both,
        )


def check_disjoint(trained: Sequence[TrainingEpisode], heldout: Sequence[TrainingEpisode]) -> None:
    """Raise if a held-out episode, or a seed of its task, is also trained on."""
    prints = {episode.content_hash() for episode in trained}
    seeds = {(e.task, e.seed) for e in trained if e.seed is not None}
    both = [
        episode.episode_id
        for episode in heldout
        if episode.content_hash() in prints or (episode.task, episode.seed) in seeds
    ]
    if both:
        raise InvalidInputError(
            f"training: {len(both)} held-out episodes are also trained on {both[:3]} (same content "
            "or same task and seed); expected disjoint sets",
            episodes=both,
        )
