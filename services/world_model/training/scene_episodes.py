"""Labelled episodes of stores as arrays on the model grid, with their object poses.

Training data of the state model: whole episodes with the outcome and the poses of their objects,
from the twin, measured at a station or clicked (docs/objects.md); where others of their task have
poses, those without are taken, too. Imagined episodes, truncated ones, those with an unknown
outcome and those that were rejected in review are skipped and counted.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
import structlog
from jaxtyping import Bool, Float16, Float32, Float64, Int64, UInt8

from dextouch.episodes import (
    ClickedPoses,
    EpisodeReader,
    EpisodeStore,
    ObjectSource,
    ObjectTrack,
    Split,
    clicked_poses,
    has_object_poses,
    is_in,
    is_rejected,
    listed_objects,
    object_track,
    recording_of,
    scene_of,
)
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.images import square_of_at_most
from dextouch.schemas import ActionKind, ObjectClicks, SceneObject
from services.world_model.starts import CAMERA

logger = structlog.get_logger(__name__)

_WITHOUT_POSES = "without poses of the objects"


@dataclass(frozen=True)
class SceneEpisode:
    """One whole episode.

    `actions` are the commanded ones where the episode has them (see `action_kind`), and
    `measured_actions` the measured ones; both are relative to `anchor`, the poses of left wrist,
    right wrist and head camera. `tactile_kpa` is the mean over each step, `object_poses` are
    x y z (m), qw qx qy qz in the world, `objects_known` the steps at which they are known;
    `object_sources` and `clicked_sd_m` are those of an `ObjectTrack`. `images` are the head camera
    images at the grid steps `image_steps`, and `K_head` (px) is of their size.
    """

    episode_id: str
    task: str
    scene: str
    seed: int | None
    success: bool
    object_names: tuple[str, ...]
    object_boxes_m: Float64[np.ndarray, "objects 6"]
    action_kind: ActionKind
    actions: Float64[np.ndarray, "steps 67"]
    measured_actions: Float64[np.ndarray, "steps 67"]
    anchor: Float64[np.ndarray, "3 4 4"]
    K_head: Float64[np.ndarray, "3 3"]
    tactile_kpa: Float16[np.ndarray, "steps 2 320"]
    object_poses: Float32[np.ndarray, "steps objects 7"]
    objects_known: Bool[np.ndarray, "steps objects"]
    object_sources: tuple[ObjectSource, ...]
    clicked_sd_m: Float32[np.ndarray, " objects"]
    images: UInt8[np.ndarray, "shown h w 3"]
    image_steps: Int64[np.ndarray, " shown"]
    content_sha256: str

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def is_measured(self) -> bool:
        """Whether poses have the errors of a measurement."""
        return bool(set(self.object_sources) - {"twin"})

    @property
    def is_posed(self) -> bool:
        """Whether the pose of some object is known; true of tasks without objects."""
        return not self.object_names or bool(self.objects_known.any())


def load_scene_episodes(
    *urls: str,
    tasks: Collection[str] | None = None,
    splits: Collection[Split] = (),
    image_px: int | None = None,
    clicks: ObjectClicks | None = None,
) -> list[SceneEpisode]:
    """Load the labelled episodes of stores, in the order of their ids.

    The number of skipped episodes is logged by reason.

    Args:
        urls: URLs of the stores.
        tasks: tasks to load; None for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to; None leaves images as
            they are.
        clicks: objects of tasks, and clicks on them; those in the stores are used as well.

    Raises:
        NotFoundError: clicks on an episode that no store has.
        InvalidInputError: no episode remains, or as `clicked_poses`.
    """
    stores = [EpisodeStore(url) for url in urls]
    for name in () if clicks is None else clicks.episodes:
        if not any(store.exists(name) for store in stores):
            raise NotFoundError(f"clicks: episode {name!r} is in none of {', '.join(urls)}")
    skipped: Counter[str] = Counter()
    found = [
        one
        for store in stores
        for one in _usable(store, skipped, tasks=tasks, splits=splits, clicks=clicks)
    ]
    posed = [one for one in found if one.is_posed]
    posed_tasks = {one.reader.attributes.task for one in posed}
    posed_recordings = {one.recording for one in posed} - {None}
    recordings: dict[str, str] = {}
    taken: list[SceneEpisode] = []
    for one in found:
        task = one.reader.attributes.task
        if one.is_posed or (task in posed_tasks and one.recording not in posed_recordings):
            _check_aligned_once(one, recordings)
            taken.append(_read(one, image_px))
        else:
            skipped[_WITHOUT_POSES] += 1
    for reason, count in sorted(skipped.items()):
        logger.warning("skipped_episodes", stores=urls, reason=reason, count=count)
    if not taken:
        raise InvalidInputError(
            f"scene episodes: {', '.join(urls)} have none to train on (skipped: {dict(skipped)}); "
            "episodes need an outcome, touch, actions, images and the poses of their objects "
            "(docs/objects.md)"
        )
    return taken


@dataclass(frozen=True)
class _Usable:
    """An episode that can be trained on, its objects as a file lists them, and clicks on them."""

    reader: EpisodeReader
    listed: tuple[SceneObject, ...]
    clicked: ClickedPoses | None

    @property
    def is_posed(self) -> bool:
        """Whether the pose of an object may be known at some step."""
        is_clicked = self.clicked is not None and bool(self.clicked.known.any())
        return is_clicked or has_object_poses(self.reader)

    @property
    def recording(self) -> str | None:
        """What it was aligned from, at a station."""
        about = self.reader.attributes
        return recording_of(about) if about.origin == "recorded" else None


def _usable(
    store: EpisodeStore,
    skipped: Counter[str],
    *,
    tasks: Collection[str] | None,
    splits: Collection[Split],
    clicks: ObjectClicks | None,
) -> Iterator[_Usable]:
    """Episodes of a store whose objects have names; others are counted in `skipped`."""
    for episode_id in sorted(store.list()):
        reader = store.open(episode_id)
        about = reader.attributes
        if (tasks is not None and about.task not in tasks) or not is_in(about, splits):
            continue
        reason = "rejected in review" if is_rejected(store, about) else _unfit(reader)
        if reason is not None:
            skipped[reason] += 1
        elif clicks is not None and about.task in clicks.tasks:
            yield _with_clicks(store, reader, clicks)
        elif has_object_poses(reader) or about.object_names:
            yield _Usable(reader, (), None)
        else:
            skipped[_WITHOUT_POSES] += 1


def _with_clicks(store: EpisodeStore, reader: EpisodeReader, clicks: ObjectClicks) -> _Usable:
    """An episode whose objects a file lists; unfinished clicks of the store are left out."""
    listed = listed_objects(reader.attributes, clicks)
    given = clicks.episodes.get(reader.item_id)
    stored = store.clicks(reader.item_id) if given is None else None
    clicked = None
    if (one := given or stored) is not None:
        clicked = clicked_poses(reader.attributes, clicks, one, may_lack_headings=given is None)
        unfinished = [
            name
            for name, known in zip((o.name for o in listed), clicked.known.tolist(), strict=True)
            if not known and name in one.objects and one.objects[name].state == "seen"
        ]
        if unfinished:
            logger.warning("clicks_without_heading", episode=reader.item_id, objects=unfinished)
    return _Usable(reader, listed, clicked)


def _check_aligned_once(one: _Usable, recordings: dict[str, str]) -> None:
    """Refuse a second episode of one recording, as another file of objects gives."""
    if one.recording is None:
        return
    own = one.reader.item_id
    other = recordings.setdefault(one.recording, own)
    if other != own:
        raise InvalidInputError(
            f"episodes {other!r} and {own!r}: are of one recording, aligned with different "
            "options; expected one; delete the other with `dextouch store delete`"
        )


def _unfit(reader: EpisodeReader) -> str | None:
    """Reason why an episode is not usable as ground truth, or None."""
    attributes = reader.attributes
    if attributes.origin == "imagined":
        return "origin imagined"
    if attributes.recovered:
        return "recovered after its writer died"
    if attributes.success is None:
        return "success unknown"
    missing = {"action", "tactile_left", "tactile_right"} - set(reader.streams)
    if not missing and CAMERA in reader.streams and 0 not in reader.shown_steps(CAMERA)[0]:
        missing.add("an image of its first step")
    return f"without {', '.join(sorted(missing))}" if missing else None


def _read(one: _Usable, image_px: int | None) -> SceneEpisode:
    reader = one.reader
    attributes = reader.attributes
    window = reader.window(0, reader.num_steps, cameras=())
    actions = window.actions
    kind: ActionKind = "commanded" if "action_commanded" in reader.streams else "measured"
    if kind == "commanded":
        actions = reader.read("action_commanded").values.astype(np.float64)
    images, image_steps = _images(reader)
    images, K_head = square_of_at_most(images, window.K_head, image_px)
    names = attributes.object_names or tuple(each.name for each in one.listed)
    track = object_track(reader, window.t_ref_ns)
    track = ObjectTrack.unknown(reader.num_steps, len(names)) if track is None else track
    track = track if one.clicked is None else one.clicked.fill(track)
    boxes = attributes.object_boxes_m or tuple(each.box_m for each in one.listed)
    return SceneEpisode(
        episode_id=attributes.episode_id,
        task=attributes.task,
        scene=scene_of(attributes),
        seed=attributes.seed,
        success=bool(attributes.success),
        object_names=names,
        object_boxes_m=np.array(boxes, dtype=np.float64).reshape(-1, 6),
        action_kind=kind,
        actions=actions,
        measured_actions=window.actions,
        anchor=np.stack(window.anchor.as_tuple()),
        K_head=K_head,
        tactile_kpa=window.tactile_kpa.astype(np.float16),
        object_poses=track.poses,
        objects_known=track.known,
        object_sources=track.sources,
        clicked_sd_m=track.clicked_sd_m,
        images=images,
        image_steps=image_steps,
        content_sha256=reader.content_sha256,
    )


def _images(reader: EpisodeReader) -> tuple[np.ndarray, np.ndarray]:
    """Images of the grid steps that have one, and these steps."""
    if CAMERA not in reader.streams or not reader.num_samples(CAMERA):
        return np.zeros((0, 0, 0, 3), dtype=np.uint8), np.zeros(0, dtype=np.int64)
    steps, images = reader.shown_steps(CAMERA)
    return reader.images_at(CAMERA, images), steps
