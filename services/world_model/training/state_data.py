"""Episodes that a state model is trained and evaluated on, and their provenance."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import structlog

from dextouch.episodes import (
    SPLITS,
    EpisodeGrid,
    EpisodeStore,
    Split,
    scene_fraction,
    split_by_scene,
)
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import Domain, ObjectClicks, load_object_clicks
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.settings import StateTrainSettings
from services.world_model.state_checkpoints import scene_digest
from services.world_model.training.domains import check_tasks, subset_by_hash
from services.world_model.training.scene_episodes import SceneGrid, load_scene_episodes
from services.world_model.training.scene_table import vocabulary
from services.world_model.training.transfer import Base
from services.world_model.training_set import learned_tasks

logger = structlog.get_logger(__name__)


@dataclass(frozen=True)
class StateData:
    """Episodes of training, of robots and people, and held-out ones.

    Of data of both domains, those of robots alone are held out: rollouts are of robots.
    """

    training: Sequence[EpisodeGrid]
    heldout: Sequence[EpisodeGrid]

    @property
    def episodes(self) -> list[EpisodeGrid]:
        """All of them."""
        return [*self.training, *self.heldout]

    @property
    def has_both_domains(self) -> bool:
        """Whether people and robots act in the episodes of training."""
        return len({episode.domain for episode in self.training}) > 1


def load_state_data(settings: StateTrainSettings) -> StateData:
    """Read the episodes of a run.

    Robot episodes are split before a subset of them is taken, so that every subset has the same
    held-out episodes.

    Raises:
        NotFoundError: an empty store, none that can be used, or clicks on an unknown episode.
        ConflictError: an id is in two stores, two episodes are of one recording, or model rates
            differ.
        InvalidInputError: held-out scenes that are trained on, or too few episodes.
    """
    clicks = None if settings.clicks is None else load_object_clicks(settings.clicks)
    heldout_urls = () if settings.heldout is None else (settings.heldout,)
    _check_clicked(clicks, (*settings.episodes, *settings.human, *heldout_urls))
    load = partial(
        load_scene_episodes, tasks=settings.tasks, image_px=settings.image_px, clicks=clicks
    )
    domain: Domain | None = "robot" if settings.human else None
    training = load(*settings.episodes, splits=settings.splits, domain=domain)
    if settings.heldout is None:
        training, heldout = split_by_scene(training, held_out_share=settings.heldout_share)
    else:
        heldout = load(settings.heldout, domain=domain)
    training = subset_by_hash(training, settings.robot_episodes, what="robot")
    if settings.human and settings.human_episodes != 0:
        people = load(*settings.human, splits=settings.splits, domain="human")
        people = _elsewhere(people, heldout)
        training += subset_by_hash(people, settings.human_episodes, what="human")
    if len({episode.domain for episode in training}) > 1:
        heldout = [episode for episode in heldout if episode.domain == "robot"]
        if not heldout:
            raise InvalidInputError(
                "training: no robot is held out, and rollouts are of robots; choose another "
                "--heldout store, or a larger --heldout-share"
            )
    data = StateData(training, heldout)
    _check_together(data)
    return data


def _elsewhere(people: list[SceneGrid], heldout: Sequence[EpisodeGrid]) -> list[SceneGrid]:
    """People in scenes that are not held out of the robots' ones."""
    scenes = {episode.scene for episode in heldout}
    kept = [episode for episode in people if episode.scene not in scenes]
    if len(kept) < len(people):
        reason = "people in scenes that are held out of the robots'"
        logger.warning("skipped_episodes", reason=reason, count=len(people) - len(kept))
    return kept


def _check_together(data: StateData) -> None:
    """Check what holds for all stores of a run; each is read for itself."""
    both = {one.scene for one in data.training} & {one.scene for one in data.heldout}
    if both:
        raise InvalidInputError(
            f"training: scenes {sorted(both)[:3]} are trained on and held out, expected disjoint "
            "ones; use another --heldout store"
        )
    counts = Counter(episode.episode_id for episode in data.episodes)
    twice = [name for name, count in counts.items() if count > 1]
    rates_hz = sorted({episode.about.model_rate_hz for episode in data.episodes})
    if twice or len(rates_hz) > 1:
        raise ConflictError(
            f"training: the episodes have model rates of {rates_hz} Hz, and {twice[:3]} are in two "
            "stores; expected one rate, and each episode once"
        )


def check_new(data: StateData, settings: StateTrainSettings, base: Base | None) -> None:
    """Check tasks by domain, and that the initial checkpoint has not seen what is held out.

    Raises:
        InvalidInputError: it has, or as `check_tasks`.
    """
    if base is None:
        check_tasks(data.episodes, settings)
        return
    about = base.checkpoint.metadata
    check_tasks(data.episodes, settings, {*about.dynamics.tasks, *learned_tasks(about.sets)})
    if about.dynamics.has_humans and {one.domain for one in data.training} == {"human"}:
        raise InvalidInputError(
            "training: the initial checkpoint tells people from robots, and there are no robots "
            "among the episodes, of which rollouts are; add some"
        )
    seen = [one.episode_id for one in data.heldout if about.may_have_seen_episode(one.about)]
    if seen:
        raise InvalidInputError(
            f"training: the initial checkpoint may have been trained on {len(seen)} of the "
            f"held-out episodes {seen[:3]}; hold out others with --heldout STORE"
        )


def _check_clicked(clicks: ObjectClicks | None, urls: Sequence[str]) -> None:
    stores = [EpisodeStore(url) for url in urls]
    for name in () if clicks is None else clicks.episodes:
        if not any(store.exists(name) for store in stores):
            raise NotFoundError(f"clicks: episode {name!r} is in none of {', '.join(urls)}")


def configured(data: StateData, settings: StateTrainSettings) -> DynamicsConfig:
    """The configuration of a model of some episodes.

    Raises:
        InvalidInputError: images of several sizes, tasks whose episodes differ in their objects, or
            that no episode of training has.
    """
    episodes = data.episodes
    tasks, num_objects = vocabulary(episodes)
    untrained = set(tasks) - {episode.task for episode in data.training}
    if untrained:
        raise InvalidInputError(
            f"training: tasks {sorted(untrained)} are held out and not trained on; record more "
            "scenes of them, or leave them out with --tasks"
        )
    sides = {episode.image_size_px[0] for episode in episodes}
    if len(sides) != 1:
        raise InvalidInputError(
            f"state model: got episodes with images of {sorted(sides)} px, expected one size"
        )
    return DynamicsConfig(
        tasks=tasks,
        num_objects=num_objects,
        image_px=sides.pop(),
        width=settings.width,
        domains=("robot", "human") if data.has_both_domains else ("robot",),
    )


def drawn_episodes(data: StateData) -> Sequence[EpisodeGrid]:
    """Episodes that a renderer is trained on: of robots, as rollouts are, if there are any."""
    robots = [episode for episode in data.training if episode.domain == "robot"]
    return robots or data.training


def check_drawable(episodes: Sequence[EpisodeGrid]) -> None:
    """Refuse what no renderer can be trained on, before hours of training other parts.

    Raises:
        InvalidInputError: no episode shows its objects at two known poses.
    """
    for one in episodes:
        if one.objects is not None and one.objects.known[one.image_steps].all(axis=1).sum() > 1:
            return
    raise InvalidInputError(
        "state model: no episode shows all of its objects at known poses twice, which cores and "
        "the renderer learn from (clicks are poses of the first step alone); add --init PATH "
        "--learn readers, a trained state model whose cores and renderer are kept"
    )


def has_poses(episode: EpisodeGrid) -> bool:
    """Whether the pose of some object is known; true of tasks without objects."""
    track = episode.objects
    return not episode.object_names or (track is not None and bool(track.known.any()))


def labelled_episodes(episodes: Sequence[EpisodeGrid], settings: StateTrainSettings) -> list[bool]:
    """Mask of episodes whose object poses are trained on.

    Of a scene, these are all takes that have poses, or none.

    Raises:
        InvalidInputError: a task has none.
    """
    labelled = [has_poses(e) and scene_fraction(e.scene) <= _share(e, settings) for e in episodes]
    known = {episode.task for episode, yes in zip(episodes, labelled, strict=True) if yes}
    without = {episode.task for episode in episodes} - known
    if without:
        raise InvalidInputError(
            f"--labelled-share {settings.labelled_share:g}: leaves no scene with known objects of "
            f"{', '.join(sorted(without))} to train on; choose a larger share, a smaller "
            "--heldout-share, or click the objects of more episodes"
        )
    return labelled


def _share(episode: EpisodeGrid, settings: StateTrainSettings) -> float:
    """Fraction up to which scenes are labelled; held-out ones have the smallest fractions."""
    is_split = settings.heldout is None and not (settings.human and episode.domain == "human")
    least = settings.heldout_share if is_split else 0.0
    return least + (1 - least) * settings.labelled_share


def object_sources(episodes: Sequence[EpisodeGrid]) -> dict[str, int]:
    """Number of episodes with poses of objects from each source, and without any ("none")."""
    tracks = [one.objects for one in episodes if one.object_names and one.objects is not None]
    each = [{*track.sources} - {"none"} or {"none"} for track in tracks]
    return dict(sorted(Counter(source for sources in each for source in sources).items()))


def seed_ranges(episodes: Sequence[EpisodeGrid], base: Base | None) -> dict[str, tuple[int, int]]:
    """First and last seed of every task, the base's included; recordings have none."""
    known = {} if base is None else base.checkpoint.metadata.training_seeds
    seeds = {task: list(ends) for task, ends in known.items()}
    for episode in episodes:
        if episode.about.seed is not None:
            seeds.setdefault(episode.task, []).append(episode.about.seed)
    return {task: (min(found), max(found)) for task, found in sorted(seeds.items())}


def recorded_scenes(episodes: Sequence[EpisodeGrid], base: Base | None) -> tuple[str, ...]:
    """Digests of the scenes without a seed, the base's included."""
    known = set() if base is None else set(base.checkpoint.metadata.training_scenes)
    own = {scene_digest(episode.scene) for episode in episodes if episode.about.seed is None}
    return tuple(sorted(known | own))


def heldout_share(settings: StateTrainSettings, base: Base | None) -> float | None:
    """Share of scenes that neither the run nor its base was trained on, by hash; None without."""
    if settings.heldout is not None or settings.human:
        return None
    if base is None:
        return settings.heldout_share
    known = base.checkpoint.metadata.heldout_share
    return None if known is None else min(known, settings.heldout_share)


def trained_splits(settings: StateTrainSettings, base: Base | None) -> tuple[Split, ...]:
    """Splits that the run and its base were trained on; none means all."""
    if base is None:
        return settings.splits
    known = base.checkpoint.metadata.training_splits
    if not (settings.splits and known):
        return ()
    return tuple(split for split in SPLITS if split in {*settings.splits, *known})
