"""Training and held-out episodes of both domains, and the checks that keep them disjoint."""

from collections import Counter
from collections.abc import Sequence

from dextouch.episodes import split_by_scene
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.schemas import Domain
from services.world_model.checkpoints import Checkpoint
from services.world_model.settings import TrainSettings
from services.world_model.tokenizer_files import read_tokenizer
from services.world_model.training.dataset import (
    E,
    EpisodeArrays,
    TrainingEpisode,
    index_episodes,
    load_episodes,
)
from services.world_model.training.domains import subset_by_hash
from services.world_model.training.tokenizer_trainer import split_unseen


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    """Training and held-out episodes of the settings' stores; held-out ones are in memory.

    Robot episodes are split before a subset of them is taken, so that every subset has the same
    held-out episodes. These are never human if human stores are given.
    """
    trained, heldout = _load_robot(settings)
    trained = subset_by_hash(trained, settings.robot_episodes, what="robot")
    together = [*trained, *_load_human(settings)]
    rates_hz = {episode.model_rate_hz for episode in (*together, *heldout)}
    counts = Counter(episode.episode_id for episode in together)
    if len(rates_hz) > 1 or len(counts) < len(together):
        twice = [name for name, count in counts.items() if count > 1]
        raise ConflictError(
            f"training: the episodes of {', '.join([settings.episodes, *settings.human])} have "
            f"model rates of {sorted(rates_hz)} Hz, and {twice[:3]} are in two stores; expected "
            "one rate, and each episode once"
        )
    return together, heldout


def _load_robot(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    domain: Domain | None = "robot" if settings.human else None
    url, splits, px = settings.episodes, settings.splits, settings.network.image_px
    if settings.streaming:
        stored = index_episodes(url, splits=splits, domain=domain, image_px=px)
        if settings.heldout is not None:
            return stored, load_episodes(settings.heldout, domain=domain, image_px=px)
        trained, heldout = _split(stored, settings)
        return trained, [episode.load() for episode in heldout]
    episodes = load_episodes(url, splits=splits, domain=domain, image_px=px)
    if settings.heldout is not None:
        return episodes, load_episodes(settings.heldout, domain=domain, image_px=px)
    return _split(episodes, settings)


def _split(episodes: Sequence[E], settings: TrainSettings) -> tuple[list[E], list[E]]:
    if settings.tokenizer is None:
        return split_by_scene(episodes, held_out_share=settings.heldout_percent / 100)
    stored = read_tokenizer(settings.tokenizer)
    return split_unseen(episodes, stored, heldout_percent=settings.heldout_percent)


def _load_human(settings: TrainSettings) -> Sequence[TrainingEpisode]:
    if settings.human_episodes == 0:
        return []
    read = index_episodes if settings.streaming else load_episodes
    found: list[TrainingEpisode] = []
    for url in settings.human:
        px = settings.network.image_px
        found += read(url, splits=settings.splits, domain="human", image_px=px)
    return subset_by_hash(found, settings.human_episodes, what="human")


def check_not_learned(heldout: Sequence[TrainingEpisode], ancestor: Checkpoint) -> None:
    """Raise if the initial checkpoint was trained on a held-out episode."""
    learned = set(ancestor.metadata.train_fingerprints)
    both = [episode.episode_id for episode in heldout if episode.fingerprint() in learned]
    if both:
        raise InvalidInputError(
            f"training: the initial checkpoint was trained on {len(both)} of the held-out "
            f"episodes {both[:3]}; use a held-out store that it has not seen",
            episodes=both,
        )


def check_disjoint(trained: Sequence[TrainingEpisode], heldout: Sequence[TrainingEpisode]) -> None:
    """Raise if a held-out episode, or its scene, is also trained on."""
    prints = {episode.fingerprint() for episode in trained}
    scenes = {episode.scene for episode in trained}
    both = [
        episode.episode_id
        for episode in heldout
        if episode.fingerprint() in prints or episode.scene in scenes
    ]
    if both:
        raise InvalidInputError(
            f"training: {len(both)} held-out episodes are also trained on {both[:3]} (same content "
            "or same scene); expected disjoint sets",
            episodes=both,
        )
