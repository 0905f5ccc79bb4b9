"""Sets of episodes that either form is trained on: subsets, checks and provenance."""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from typing import TypeAlias, TypeVar

import structlog

from dextouch.episodes import EpisodeGrid, data_hash, split_by_scene
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.schemas import Domain
from services.world_model.checkpoints import TrainingSet, read_tokenizer
from services.world_model.paper_settings import TrainSettings
from services.world_model.settings import DataSettings
from services.world_model.training import joint_dataset, tokenizer_trainer
from services.world_model.training.joint_dataset import StoredEpisode, TrainingEpisode

# An episode of either form of the world model.
DomainEpisode: TypeAlias = EpisodeGrid | TrainingEpisode
D = TypeVar("D", bound=DomainEpisode)
logger = structlog.get_logger(__name__)


def subset_by_hash(episodes: Sequence[D], count: int | None, *, what: str) -> list[D]:
    """Episodes by content, in their order, more contain fewer; None: all. `what` is for errors."""
    if count is None:
        return list(episodes)
    if count > len(episodes):
        raise InvalidInputError(
            f"training: got {count} as the number of {what} episodes, expected at most the "
            f"{len(episodes)} there are; record more, or ask for fewer"
        )

    def place(index: int) -> str:
        return hashlib.sha256(f"subset/{episodes[index].content_sha256}".encode()).hexdigest()

    chosen = sorted(range(len(episodes)), key=place)[:count]
    return [episodes[index] for index in sorted(chosen)]


def outside_scenes(people: Sequence[D], heldout: Sequence[DomainEpisode]) -> list[D]:
    """Episodes of people in other scenes than the held-out ones; the others are counted."""
    scenes = {episode.scene for episode in heldout}
    kept = [episode for episode in people if episode.scene not in scenes]
    if len(kept) < len(people):
        reason = "people in scenes that are held out of the robots'"
        logger.warning("skipped_episodes", reason=reason, count=len(people) - len(kept))
    return kept


def check_stores(urls: Iterable[str], ids: Iterable[str], rates_hz: Collection[float]) -> None:
    """Raise ConflictError unless episodes have one model rate, and are in one store each."""
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice or len(rates_hz) > 1:
        raise ConflictError(
            f"training: the episodes of {', '.join(urls)} have model rates of {sorted(rates_hz)} "
            f"Hz, and {twice[:3]} are in two stores; expected one rate, and each episode once"
        )


def check_tasks(
    episodes: Iterable[DomainEpisode], settings: DataSettings, known: Collection[str] = ()
) -> None:
    """Check that tasks are of one domain (`disjoint_tasks`) and new (`new_tasks`), not `known`.

    Raises:
        InvalidInputError: a task is both human and robot, or is known already.
    """
    tasks: dict[Domain, set[str]] = {"human": set(), "robot": set()}
    for episode in episodes:
        tasks[episode.domain].add(episode.task)
    again = sorted(set(known) & (tasks["human"] | tasks["robot"]))
    if settings.new_tasks and again:
        raise InvalidInputError(
            f"training: the initial checkpoint was trained on tasks {again}, expected new ones; "
            "use other stores, or allow it with --no-new-tasks",
            tasks=again,
        )
    both = sorted(tasks["human"] & tasks["robot"])
    if settings.human and settings.disjoint_tasks and both:
        raise InvalidInputError(
            f"training: tasks {both} are in the human and in the robot episodes, expected disjoint "
            "sets; use other stores, or allow it with --no-disjoint-tasks",
            tasks=both,
        )


def training_sets(
    trained: Sequence[DomainEpisode],
    heldout: Sequence[DomainEpisode],
    *,
    human_share: float | None,
    image_px: int | None,
    inherited: Sequence[TrainingSet] = (),
    ancestor: str | None = None,
) -> tuple[TrainingSet, ...]:
    """The episodes of a run by domain, after the inherited ones of its ancestors.

    `ancestor` is the digest of the initial checkpoint; `human_share` None: as their number says.
    """
    found = [
        one if one.checkpoint else one.model_copy(update={"checkpoint": ancestor})
        for one in inherited
    ]
    domains = {episode.domain for episode in trained}
    shares: dict[Domain, float] = {}
    if human_share is not None and len(domains) > 1:
        shares = {"human": human_share, "robot": 1 - human_share}
    for episodes, is_heldout in ((trained, False), (heldout, True)):
        for domain in sorted({episode.domain for episode in episodes}):
            mine = [episode for episode in episodes if episode.domain == domain]
            found.append(
                TrainingSet(
                    domain=domain,
                    heldout=is_heldout,
                    tasks=dict(sorted(Counter(episode.task for episode in mine).items())),
                    data_hash=data_hash((e.content_sha256 for e in mine), image_px=image_px),
                    window_share=None if is_heldout else shares.get(domain),
                )
            )
    return tuple(found)


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[joint_dataset.EpisodeArrays]]:
    """Training and held-out episodes; the latter, in memory, are the same for every subset.

    They are never human if human stores are given.
    """
    px, views = settings.network.image_px, settings.network.further_views
    how = joint_dataset.index_episodes if settings.streaming else joint_dataset.load_episodes
    read = partial(how, splits=settings.splits, image_px=px, further_views=views)
    domain: Domain | None = "robot" if settings.human else None
    trained: Sequence[TrainingEpisode] = read(settings.episodes, domain=domain)
    if settings.heldout is not None:
        heldout = joint_dataset.load_episodes(
            settings.heldout, domain=domain, image_px=px, further_views=views
        )
    else:
        trained, stored = _split(trained, settings)
        heldout = [one.load() if isinstance(one, StoredEpisode) else one for one in stored]
    trained = subset_by_hash(trained, settings.robot_episodes, what="robot")
    people: list[TrainingEpisode] = []
    for url in settings.human if settings.human_episodes != 0 else ():
        people += read(url, domain="human")
    together = [
        *trained,
        *subset_by_hash(outside_scenes(people, heldout), settings.human_episodes, what="human"),
    ]
    rates_hz = {episode.model_rate_hz for episode in (*together, *heldout)}
    ids = [episode.episode_id for episode in together]
    check_stores([settings.episodes, *settings.human], ids, rates_hz)
    _check_views([*together, *heldout], settings)
    return together, heldout


def _check_views(episodes: Sequence[TrainingEpisode], settings: TrainSettings) -> None:
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
    episodes: Sequence[joint_dataset.E], settings: TrainSettings
) -> tuple[list[joint_dataset.E], list[joint_dataset.E]]:
    if settings.tokenizer is None:
        return split_by_scene(episodes, held_out_share=settings.heldout_percent / 100)
    stored = read_tokenizer(settings.tokenizer)
    return tokenizer_trainer.split_unseen(
        episodes, stored, heldout_percent=settings.heldout_percent
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
