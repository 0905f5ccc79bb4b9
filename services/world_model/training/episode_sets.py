"""Sets of episodes that either form is trained on: subsets, checks and provenance."""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import TypeAlias, TypeVar

from dextouch.episodes import EpisodeGrid, data_hash
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.schemas import Domain
from services.world_model.checkpoints import TrainingSet
from services.world_model.settings import DataSettings
from services.world_model.training.dataset import TrainingEpisode

# An episode of either form of the world model.
DomainEpisode: TypeAlias = EpisodeGrid | TrainingEpisode
D = TypeVar("D", bound=DomainEpisode)


def subset_by_hash(episodes: Sequence[D], count: int | None, *, what: str) -> list[D]:
    """A number of episodes chosen by their content, in their order; None for all.

    A larger subset of the same episodes contains every smaller one.

    Raises:
        InvalidInputError: there are fewer; `what` names them.
    """
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


def check_stores(urls: Iterable[str], ids: Iterable[str], rates_hz: Collection[float]) -> None:
    """Check that the episodes of a training have one model rate, and are in one store each.

    Raises:
        ConflictError: they are not.
    """
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice or len(rates_hz) > 1:
        raise ConflictError(
            f"training: the episodes of {', '.join(urls)} have model rates of {sorted(rates_hz)} "
            f"Hz, and {twice[:3]} are in two stores; expected one rate, and each episode once"
        )


def check_tasks(
    episodes: Iterable[DomainEpisode], settings: DataSettings, known: Collection[str] = ()
) -> None:
    """Check that tasks are of one domain (`disjoint_tasks`) and new (`new_tasks`).

    `known` are those that the initial checkpoint was trained on.

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

    `ancestor` is the digest of the initial checkpoint. `human_share` of what is drawn is human;
    None: as their number says. `image_px` is as for `data_hash`.
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
