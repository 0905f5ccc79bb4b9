"""Episodes that a state model is trained and evaluated on, and their provenance."""

import hashlib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np
import structlog
from jaxtyping import Bool, Float64

from dextouch.episodes import (
    SPLITS,
    ClickedPoses,
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    ObjectTrack,
    Split,
    clicked_poses,
    has_object_poses,
    listed_objects,
    needs,
    recording_of,
    scene_fraction,
    select_episodes,
    split_by_scene,
    touched_objects,
)
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import invert, pose_from_transform, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import Domain, ObjectClicks, SceneObjects
from dextouch.tactile.layout import DEXTOUCH_V1, common_layout
from services.world_model.checkpoints import learned_tasks
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.settings import StateTrainSettings
from services.world_model.training.episode_sets import (
    check_stores,
    check_tasks,
    outside_scenes,
    subset_by_hash,
)
from services.world_model.training.scene_table import usual_boxes_m, vocabulary
from services.world_model.training.transfer import Base

logger = structlog.get_logger(__name__)
# Fewer takes with clicks and touch correct no grip: their median would hardly be better than it.
_LEAST_GRIPS: Final = 5
# Larger corrections are made with a warning: the file may describe another grip or object.
_LARGE_SHIFT_MM, _LARGE_TURN_DEG = 100.0, 45.0
_NEEDED: Final = (needs.EVERY_PART, needs.WHOLE, needs.OUTCOME, needs.TOUCH, needs.FIRST_IMAGE)


class SceneGrid(EpisodeGrid):
    """An episode whose objects a file may list, and people may have clicked at the first step."""

    def __init__(
        self,
        reader: EpisodeReader,
        image_px: int | None = None,
        *,
        objects: SceneObjects | None = None,
        clicked: ClickedPoses | None = None,
    ) -> None:
        super().__init__(reader, image_px)
        self._file, self._clicked = objects, clicked
        self._listed = () if objects is None else listed_objects(self.about, objects)
        self._Ts_touched_object: Float64[np.ndarray, "objects 4 4"] | None = None

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects, its own or the file's."""
        return super().object_names or tuple(one.name for one in self._listed)

    @cached_property
    def boxes_m(self) -> Float64[np.ndarray, "objects 6"]:
        """Boxes of the objects in their own frames, its own or the file's."""
        own_m = super().boxes_m
        if len(own_m):
            return own_m
        return np.array([one.box_m for one in self._listed], dtype=np.float64).reshape(-1, 6)

    @cached_property
    def objects(self) -> ObjectTrack:
        """Poses of the objects at every step, where they are known."""
        track = super().objects
        if track is None:
            track = ObjectTrack.unknown(len(self), len(self.object_names))
        if not track.known.any(axis=0).all() and self._touched is not None:
            track = track.filled(self._touched)
        return track if self._clicked is None else track.filled(self._clicked.track(len(self)))

    @cached_property
    def _touched(self) -> ObjectTrack | None:
        """Poses from touch, corrected by clicks; None where touch says nothing."""
        track = self._touched_alone
        if track is None:
            return None
        errors, is_clicked = self.grip_errors()
        others = np.eye(4) if self._Ts_touched_object is None else self._Ts_touched_object
        Ts = transform_from_pose(track.poses.astype(np.float64))
        Ts = Ts @ np.where(is_clicked[:, None, None], errors, others)
        return replace(track, poses=pose_from_transform(Ts).astype(np.float32))

    @cached_property
    def _touched_alone(self) -> ObjectTrack | None:
        is_held = self._file is not None and self._may_be_touched
        return touched_objects(self, self._file) if is_held and self._file else None

    @property
    def _may_be_touched(self) -> bool:
        return self.success and any(one.touch is not None for one in self._listed)

    def grip_errors(
        self,
    ) -> tuple[Float64[np.ndarray, "objects 4 4"], Bool[np.ndarray, " objects"]]:
        """T_touched_object at the first step, of objects that were clicked and touched, too."""
        count = len(self.object_names)
        touched = self._touched_alone
        if self._clicked is None or touched is None:
            return np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, dtype=np.bool_)
        # Objects that are absent have no error.
        is_seen = np.logical_and(self._clicked.known, self._clicked.sd_m > 0)
        before = transform_from_pose(touched.poses[0].astype(np.float64))
        errors = invert(before) @ transform_from_pose(self._clicked.poses)
        return errors, np.logical_and(is_seen, touched.known[0])

    def correct_grips(self, Ts_touched_object: Float64[np.ndarray, "objects 4 4"]) -> None:
        """Correct poses from touch by what grips of the task are off, before they are used."""
        self._Ts_touched_object = Ts_touched_object
        for name in ("_touched", "objects", "content_sha256"):
            self.__dict__.pop(name, None)

    @cached_property
    def content_sha256(self) -> str:
        """Digest of what the store holds of it, and of what a file or clicks add to that."""
        digest = super().content_sha256
        if not set(self.objects.sources) & {"clicks", "touch", "none"}:
            return digest
        added = (self.objects.poses, self.objects.known, self.boxes_m)
        return digest + hashlib.sha256(b"".join(array.tobytes() for array in added)).hexdigest()

    @property
    def may_have_poses(self) -> bool:
        """Whether the pose of an object may be known at some step, as seen without reading it."""
        is_clicked = self._clicked is not None and bool(self._clicked.known.any())
        return is_clicked or self._may_be_touched or has_object_poses(self.reader)


def load_scene_episodes(
    *urls: str,
    tasks: Collection[str] = (),
    splits: Collection[Split] = (),
    image_px: int | None = None,
    clicks: ObjectClicks | None = None,
    domain: Domain | None = None,
) -> list[SceneGrid]:
    """Episodes of stores that a state model can learn from, store by store.

    The middle square of images larger than `image_px` is scaled to it. Clicks in the stores are
    used beside `clicks`. Where others of their task have poses, episodes without teach touch and
    outcome.

    Raises:
        NotFoundError, ConflictError: as `select_episodes`.
        InvalidInputError: as `clicked_poses`.
    """
    stores = [EpisodeStore(url) for url in urls]
    grids: dict[str, SceneGrid] = {}

    def has_poses(reader: EpisodeReader) -> bool:
        grid = _grid(stores, reader, image_px, clicks)
        grids[grid.episode_id] = grid
        return grid.may_have_poses

    posed = needs.Need(needs.OBJECTS.lack, needs.OBJECTS.remedy, has_poses, is_choice=True)
    selected = select_episodes(
        stores, domain=domain, tasks=tasks, splits=splits, needs=(*_NEEDED, posed)
    )
    with_poses = {reader.item_id for reader in selected}
    without = grids.keys() - with_poses
    tasks_posed = {grids[name].task for name in with_poses}
    recordings = {_recording(grids[name]) for name in with_poses} - {None}
    of_task = [n for n in without if grids[n].task in tasks_posed and grids[n].object_names]
    used = {name for name in of_task if _recording(grids[name]) not in recordings}
    if len(used) < len(without):
        reason = f"{needs.OBJECTS.lack} ({needs.OBJECTS.remedy})"
        logger.warning("skipped_episodes", reason=reason, count=len(without) - len(used))
    if not used:
        return [grids[name] for name in grids if name in with_poses]
    both = replace(posed, is_met=lambda reader: reader.item_id in used | with_poses)
    again = select_episodes(stores, domain=domain, tasks=tasks, splits=splits, needs=(both,))
    return [grids[reader.item_id] for reader in again]


def _recording(grid: EpisodeGrid) -> str | None:
    return recording_of(grid.about) if grid.about.origin == "recorded" else None


def _grid(
    stores: Sequence[EpisodeStore],
    reader: EpisodeReader,
    image_px: int | None,
    clicks: ObjectClicks | None,
) -> SceneGrid:
    """An episode with what a file says of its objects; unfinished stored clicks are left out."""
    about = reader.attributes
    if clicks is None or about.task not in clicks.tasks:
        return SceneGrid(reader, image_px)
    given = one = clicks.episodes.get(reader.item_id)
    if one is None:
        held = (store for store in stores if store.exists(reader.item_id))
        one = next((store.clicks(reader.item_id) for store in held), None)
    if one is None:
        return SceneGrid(reader, image_px, objects=clicks)
    clicked = clicked_poses(about, clicks, one, may_lack_headings=given is None)
    each = zip(clicked.objects, clicked.known.tolist(), strict=True)
    missing = [found.name for found, known in each if not known and found.name in one.objects]
    unfinished = [name for name in missing if one.objects[name].state == "seen"]
    if unfinished:
        logger.warning("clicks_without_heading", episode=reader.item_id, objects=unfinished)
    return SceneGrid(reader, image_px, objects=clicks, clicked=clicked)


@dataclass(frozen=True)
class StateData:
    """Episodes of training, and held-out ones: of robots alone if there are both domains."""

    training: Sequence[EpisodeGrid]
    heldout: Sequence[EpisodeGrid]

    @property
    def episodes(self) -> list[EpisodeGrid]:
        """All of them."""
        return [*self.training, *self.heldout]


def load_state_data(settings: StateTrainSettings) -> StateData:
    """Read the episodes of a run; the held-out ones are the same for all subsets.

    Raises:
        NotFoundError: an empty store, none that can be used, or clicks on an unknown episode.
        ConflictError: an id in two stores, two episodes of one recording, or several model rates.
        InvalidInputError: held-out scenes that are trained on, or too few episodes.
    """
    clicks = None if settings.clicks is None else ObjectClicks.load(settings.clicks)
    heldout_urls = () if settings.heldout is None else (settings.heldout,)
    urls = (*settings.episodes, *settings.human, *heldout_urls)
    stores = [EpisodeStore(url) for url in urls]
    for name in () if clicks is None else clicks.episodes:
        if not any(store.exists(name) for store in stores):
            raise NotFoundError(f"clicks: episode {name!r} is in none of {', '.join(urls)}")
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
        people = outside_scenes(people, heldout)
        training += subset_by_hash(people, settings.human_episodes, what="human")
    if len({episode.domain for episode in training}) > 1:
        heldout = [episode for episode in heldout if episode.domain == "robot"]
        if not heldout:
            raise InvalidInputError(
                "training: no robot is held out, and rollouts are of robots; choose another "
                "--heldout store, or a larger --heldout-share"
            )
    data = StateData(training, heldout)
    both = {one.scene for one in data.training} & {one.scene for one in data.heldout}
    if both:
        raise InvalidInputError(
            f"training: scenes {sorted(both)[:3]} are trained on and held out, expected disjoint "
            "ones; use another --heldout store"
        )
    ids = [episode.episode_id for episode in data.episodes]
    check_stores(urls, ids, {episode.about.model_rate_hz for episode in data.episodes})
    _correct_grips(data.episodes)
    return data


def _correct_grips(episodes: Sequence[EpisodeGrid]) -> None:
    """Correct poses from touch by takes of the task and domain with clicks: grips are off alike."""
    groups: dict[tuple[str, str, tuple[str, ...]], list[SceneGrid]] = {}
    for one in episodes:
        if isinstance(one, SceneGrid):
            groups.setdefault((one.task, one.domain, one.object_names), []).append(one)
    for (task, domain, names), of_both in sorted(groups.items()):
        errors = [one.grip_errors() for one in of_both]
        Ts, known = np.stack([T for T, _ in errors]), np.stack([is_known for _, is_known in errors])
        corrections = np.tile(np.eye(4), (known.shape[1], 1, 1))
        for index in np.flatnonzero(known.sum(axis=0) >= _LEAST_GRIPS):
            own = Ts[known[:, index], index]
            R, shift_m = own[:, :3, :3], np.median(own[:, :3, 3], axis=0)
            # The turn that is nearest to all others; a mean of turns far apart is none of them.
            distances_rad = rotation_angle(np.swapaxes(R, 1, 2)[:, None] @ R)
            turn = R[distances_rad.sum(axis=1).argmin()]
            corrections[index] = transform(turn, shift_m)
            shift_mm = 1e3 * float(np.linalg.norm(shift_m))
            turn_deg = float(np.rad2deg(rotation_angle(turn)))
            is_large = shift_mm > _LARGE_SHIFT_MM or turn_deg > _LARGE_TURN_DEG
            (logger.warning if is_large else logger.info)(
                "touch_corrected_by_clicks", task=task, domain=domain, object=names[index],
                shift_mm=round(shift_mm, 1), turn_deg=round(turn_deg, 1), takes=len(own),
            )  # fmt: skip
        for one in of_both:
            one.correct_grips(corrections)


def check_new(data: StateData, settings: StateTrainSettings, base: Base | None) -> None:
    """Check rate, and tasks as `check_tasks`; the initial checkpoint has seen none held out."""
    if base is None:
        check_tasks(data.episodes, settings)
        return
    about, rate_hz = base.checkpoint.metadata, data.training[0].about.model_rate_hz
    if rate_hz != about.model_rate_hz:
        raise InvalidInputError(
            f"training: the initial checkpoint has steps at {about.model_rate_hz:g} Hz, the "
            f"episodes at {rate_hz:g} Hz; align them at its rate (`--options.model-rate-hz`)"
        )
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


def configured(
    data: StateData, settings: StateTrainSettings, base: Base | None = None
) -> DynamicsConfig:
    """The configuration of a model of some episodes, which may start from another model.

    Raises:
        InvalidInputError: several image sizes or lists of objects, objects of unknown size, or
            tasks that are not trained.
    """
    episodes = data.episodes
    tasks, num_objects = vocabulary(episodes)
    boxes_m = usual_boxes_m(episodes)
    counts = zip(tasks, num_objects, strict=True)
    if boxless := [task for task, count in counts if len(boxes_m[task]) != count]:
        raise InvalidInputError(
            f"training: the sizes of the objects of tasks {boxless} are not known; give their "
            "boxes by --clicks FILE (docs/objects.md), or in the episodes (`object_boxes_m`)"
        )
    domains = {episode.domain for episode in data.training}
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
    layout = common_layout([one.tactile_layout for one in episodes], what="training episodes")
    usual = DynamicsConfig.model_fields["touch_channels"].default
    return DynamicsConfig(
        tasks=tasks,
        num_objects=num_objects,
        image_px=sides.pop(),
        width=settings.width,
        domains=("robot", "human") if len(domains) > 1 else ("robot",),
        instructions=_instructions(episodes, settings, base),
        touch_channels=min(usual, layout.num_taxels),
        layout=None if layout == DEXTOUCH_V1 else layout,
    )


def _instructions(
    episodes: Sequence[EpisodeGrid], settings: StateTrainSettings, base: Base | None
) -> tuple[str, ...]:
    """Sentences that cores read: none if each set of objects has but one, as the scene says it."""
    sentences = {one.about.instruction for one in episodes}
    base_reads = base is not None and bool(base.checkpoint.metadata.dynamics.instructions)
    scenes = {(one.object_names, one.about.instruction) for one in episodes}
    if not base_reads and len(scenes) == len({objects for objects, _ in scenes}):
        return ()
    if base is not None and not base_reads and settings.learn != "all":
        logger.warning("instructions_not_read", reason="cores of --init do not; use --learn all")
        return ()
    return tuple(sorted(sentences))


def drawn_episodes(data: StateData, settings: StateTrainSettings) -> list[EpisodeGrid]:
    """Labelled episodes that a renderer is trained on: of robots, as rollouts are, if any are."""
    mask = labelled_episodes(data.training, settings)
    known = [one for one, is_labelled in zip(data.training, mask, strict=True) if is_labelled]
    return [episode for episode in known if episode.domain == "robot"] or known


def check_drawable(episodes: Sequence[EpisodeGrid]) -> None:
    """Raise InvalidInputError, hours early, if no episode shows its objects at two known poses."""
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
    """Mask of episodes whose object poses are trained on: of a scene all takes with poses, or none.

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
            "--heldout-share, or click the objects of more episodes (`dextouch store clicks` lists "
            "what clicks and touch give)"
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
    return _together(settings.splits, base.checkpoint.metadata.training_splits)


def splits_by_task(
    episodes: Sequence[EpisodeGrid], settings: StateTrainSettings, base: Base | None
) -> dict[str, tuple[Split, ...]]:
    """Splits by task, where a run has other tasks or splits than its base; empty without a base."""
    if base is None:
        return {}
    known, splits = base.checkpoint.metadata, settings.splits
    found = {task: known.splits_of(task) for task in known.training_seeds}
    for task in {episode.task for episode in episodes}:
        found[task] = _together(splits, found[task]) if task in found else splits
    usual = trained_splits(settings, base)
    return {task: own for task, own in sorted(found.items()) if own != usual}


def _together(some: tuple[Split, ...], others: tuple[Split, ...]) -> tuple[Split, ...]:
    """Splits that are in either; none means all."""
    return tuple(one for one in SPLITS if one in {*some, *others}) if some and others else ()
