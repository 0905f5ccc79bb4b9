"""Training and held-out episodes of the paper's form, as its settings say."""

from collections.abc import Sequence
from functools import partial

from dextouch.episodes import split_by_scene
from dextouch.errors import InvalidInputError
from dextouch.schemas import Domain
from services.world_model import checkpoints
from services.world_model.paper_settings import TrainSettings
from services.world_model.training import dataset, episode_sets, tokenizer_trainer


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[dataset.TrainingEpisode], list[dataset.EpisodeArrays]]:
    """Training and held-out episodes of the settings' stores; held-out ones are in memory.

    Robot episodes are split before a subset of them is taken, so that every subset has the same
    held-out episodes. These are never human if human stores are given.
    """
    px, views = settings.network.image_px, settings.network.further_views
    how = dataset.index_episodes if settings.streaming else dataset.load_episodes
    read = partial(how, splits=settings.splits, image_px=px, further_views=views)
    domain: Domain | None = "robot" if settings.human else None
    trained: Sequence[dataset.TrainingEpisode] = read(settings.episodes, domain=domain)
    if settings.heldout is not None:
        heldout = dataset.load_episodes(
            settings.heldout, domain=domain, image_px=px, further_views=views
        )
    else:
        trained, stored = _split(trained, settings)
        heldout = [one.load() if isinstance(one, dataset.StoredEpisode) else one for one in stored]
    trained = episode_sets.subset_by_hash(trained, settings.robot_episodes, what="robot")
    people: list[dataset.TrainingEpisode] = []
    for url in settings.human if settings.human_episodes != 0 else ():
        people += read(url, domain="human")
    together = [
        *trained,
        *episode_sets.subset_by_hash(people, settings.human_episodes, what="human"),
    ]
    rates_hz = {episode.model_rate_hz for episode in (*together, *heldout)}
    ids = [episode.episode_id for episode in together]
    episode_sets.check_stores([settings.episodes, *settings.human], ids, rates_hz)
    _check_views([*together, *heldout], settings)
    return together, heldout


def _check_views(episodes: Sequence[dataset.TrainingEpisode], settings: TrainSettings) -> None:
    """Raise unless every further view is in an episode, or in all if none may be left out."""
    share = settings.windows.view_dropout
    for index, view in enumerate(settings.network.further_views):
        without = [episode.episode_id for episode in episodes if episode.missing[index]]
        if len(without) == len(episodes) or (without and not share):
            raise InvalidInputError(
                f"training: {len(without)} of {len(episodes)} episodes have no images of {view} at "
                f"nearly every step {without[:3]}, expected it in "
                f"{'some' if share else 'all'}; record that camera (in the twin by `dextouch train "
                "data --wrist-cameras`), leave it out of --network.further-views, or, where some "
                "have it, train with --windows.view-dropout above 0"
            )


def _split(
    episodes: Sequence[dataset.E], settings: TrainSettings
) -> tuple[list[dataset.E], list[dataset.E]]:
    if settings.tokenizer is None:
        return split_by_scene(episodes, held_out_share=settings.heldout_percent / 100)
    stored = checkpoints.read_tokenizer(settings.tokenizer)
    return tokenizer_trainer.split_unseen(
        episodes, stored, heldout_percent=settings.heldout_percent
    )


def check_disjoint(
    trained: Sequence[dataset.TrainingEpisode], heldout: Sequence[dataset.TrainingEpisode]
) -> None:
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
