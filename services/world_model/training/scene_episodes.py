"""Labelled episodes of a store as arrays on the model grid, with their object poses.

Training data of the state model: whole episodes with the poses of their objects and the outcome,
from the twin or measured at a station (docs/objects.md). Imagined episodes, truncated ones, those
with an unknown outcome and those that were rejected in review are skipped and counted.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import structlog
from jaxtyping import Bool, Float16, Float32, Float64, Int64, UInt8

from dextouch.episodes import (
    EpisodeReader,
    EpisodeStore,
    Split,
    has_object_poses,
    is_in,
    is_rejected,
    object_track,
    recording_of,
    scene_of,
)
from dextouch.errors import InvalidInputError
from dextouch.images import square_of_at_most
from dextouch.schemas import ActionKind, EpisodeAttributes
from services.world_model.starts import CAMERA

logger = structlog.get_logger(__name__)


@dataclass(frozen=True)
class SceneEpisode:
    """One whole episode.

    `actions` are the commanded ones where the episode has them (see `action_kind`), and
    `measured_actions` the measured ones; both are relative to `anchor`, the poses of left wrist,
    right wrist and head camera. `tactile_kpa` is the mean over each step, `object_poses` are
    x y z (m), qw qx qy qz in the world, `objects_known` the steps at which they are known, and
    `objects_measured` says that they have the errors of a measurement. `images` are the head camera
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
    objects_measured: bool
    images: UInt8[np.ndarray, "shown h w 3"]
    image_steps: Int64[np.ndarray, " shown"]
    content_sha256: str

    def __len__(self) -> int:
        return len(self.actions)


def load_scene_episodes(
    url: str,
    *,
    tasks: Collection[str] | None = None,
    splits: Collection[Split] = (),
    image_px: int | None = None,
) -> list[SceneEpisode]:
    """Load the labelled episodes of a store, in the order of their ids.

    The number of skipped episodes is logged by reason.

    Args:
        url: URL of the store.
        tasks: tasks to load; None for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to; None leaves images as
            they are.

    Raises:
        InvalidInputError: no episode remains.
    """
    store = EpisodeStore(url)
    taken: list[SceneEpisode] = []
    skipped: Counter[str] = Counter()
    recordings: dict[str, str] = {}
    for episode_id in sorted(store.list()):
        reader = store.open(episode_id)
        about = reader.attributes
        if (tasks is not None and about.task not in tasks) or not is_in(about, splits):
            continue
        reason = "rejected in review" if is_rejected(store, about) else _unfit(reader)
        if reason is None:
            _check_aligned_once(about, recordings)
            taken.append(read_scene_episode(reader, image_px=image_px))
        else:
            skipped[reason] += 1
    for reason, count in sorted(skipped.items()):
        logger.warning("skipped_episodes", store=url, reason=reason, count=count)
    if not taken:
        raise InvalidInputError(
            f"scene episodes: the store {url} has none to train on (skipped: {dict(skipped)}); "
            "episodes need an outcome, touch, actions, images and the poses of their objects "
            "(docs/objects.md)"
        )
    return taken


def _check_aligned_once(about: EpisodeAttributes, recordings: dict[str, str]) -> None:
    """Refuse a second episode of one recording, as another file of objects gives."""
    recording = recording_of(about) if about.origin == "recorded" else None
    if recording is None:
        return
    other = recordings.setdefault(recording, about.episode_id)
    if other != about.episode_id:
        raise InvalidInputError(
            f"episodes {other!r} and {about.episode_id!r}: are of one recording, aligned with "
            "different options; expected one; delete the other with `dextouch store delete`"
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
    if not has_object_poses(reader):
        missing.add("poses of the objects")
    if not missing and CAMERA in reader.streams and 0 not in reader.shown_steps(CAMERA)[0]:
        missing.add("an image of its first step")
    return f"without {', '.join(sorted(missing))}" if missing else None


def read_scene_episode(reader: EpisodeReader, *, image_px: int | None = None) -> SceneEpisode:
    """Read one episode of known success.

    Args:
        reader: the episode.
        image_px: side that the middle square of larger images is scaled to.

    Raises:
        InvalidInputError: success is unknown, or there are no poses of the objects.
        UnknownNameError: a stream is missing.
        CorruptDataError: damaged bytes.
    """
    attributes = reader.attributes
    if attributes.success is None:
        raise InvalidInputError(
            f"episode {attributes.episode_id!r}: its outcome is unknown, expected success or "
            "failure, as operators enter it after a take"
        )
    window = reader.window(0, reader.num_steps, cameras=())
    actions = window.actions
    kind: ActionKind = "commanded" if "action_commanded" in reader.streams else "measured"
    if kind == "commanded":
        actions = reader.read("action_commanded").values.astype(np.float64)
    images, image_steps = _images(reader)
    images, K_head = square_of_at_most(images, window.K_head, image_px)
    track = object_track(reader, window.t_ref_ns)
    if track is None:
        raise InvalidInputError(
            f"episode {attributes.episode_id!r}: has no poses of its objects; docs/objects.md says "
            "how they are measured"
        )
    boxes = np.array(attributes.object_boxes_m, dtype=np.float64).reshape(-1, 6)
    return SceneEpisode(
        episode_id=attributes.episode_id,
        task=attributes.task,
        scene=scene_of(attributes),
        seed=attributes.seed,
        success=attributes.success,
        object_names=attributes.object_names,
        object_boxes_m=boxes,
        action_kind=kind,
        actions=actions,
        measured_actions=window.actions,
        anchor=np.stack(window.anchor.as_tuple()),
        K_head=K_head,
        tactile_kpa=window.tactile_kpa.astype(np.float16),
        object_poses=track.poses,
        objects_known=track.known,
        objects_measured=bool(set(track.sources) - {"twin"}),
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
