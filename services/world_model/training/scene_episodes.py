"""Episodes that a state model learns from, with the poses of their objects or clicks on these.

Poses are those of the twin, of markers or trackers, or clicked in the first image
(docs/objects.md). Where others of their task have poses, episodes without are taken, too: touch and
outcome are learned from them.
"""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np
import structlog
from jaxtyping import Float64

from dextouch.episodes import (
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
    select_episodes,
)
from dextouch.schemas import Domain, ObjectClicks, SceneObject

logger = structlog.get_logger(__name__)

_NEEDED: Final = (needs.WHOLE, needs.OUTCOME, needs.TOUCH, needs.FIRST_IMAGE)


class SceneGrid(EpisodeGrid):
    """An episode on the model grid whose objects a file may list, and people may have clicked.

    Args:
        reader: the episode.
        image_px: as of `EpisodeGrid`.
        listed: its objects as the file lists them; empty if it does not.
        clicked: poses at the first step from clicks; None without any.
    """

    def __init__(
        self,
        reader: EpisodeReader,
        image_px: int | None = None,
        *,
        listed: tuple[SceneObject, ...] = (),
        clicked: ClickedPoses | None = None,
    ) -> None:
        super().__init__(reader, image_px)
        self._listed, self._clicked = listed, clicked

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
        return track if self._clicked is None else self._clicked.fill(track)

    @cached_property
    def content_sha256(self) -> str:
        """Digest of what the store holds of it, and of what a file or clicks add to that."""
        digest = super().content_sha256
        if not set(self.objects.sources) & {"clicks", "none"}:
            return digest
        added = (self.objects.poses, self.objects.known, self.boxes_m)
        return digest + hashlib.sha256(b"".join(array.tobytes() for array in added)).hexdigest()

    @property
    def may_have_poses(self) -> bool:
        """Whether the pose of an object may be known at some step, as seen without reading it."""
        is_clicked = self._clicked is not None and bool(self._clicked.known.any())
        return is_clicked or has_object_poses(self.reader)


def load_scene_episodes(
    *urls: str,
    tasks: Collection[str] = (),
    splits: Collection[Split] = (),
    image_px: int | None = None,
    clicks: ObjectClicks | None = None,
    domain: Domain | None = None,
) -> list[SceneGrid]:
    """Episodes of stores that a state model can learn from, store by store.

    Args:
        urls: URLs of the stores.
        tasks: tasks to load; empty for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to; None leaves images as
            they are.
        clicks: objects of tasks, and clicks on them; those in the stores are used as well.
        domain: whose hands act; None for people and robots.

    Raises:
        NotFoundError: as `select_episodes`.
        ConflictError: as `select_episodes`.
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
    used = {
        name
        for name in without
        if grids[name].task in tasks_posed
        and grids[name].object_names
        and _recording(grids[name]) not in recordings
    }
    if len(used) < len(without):
        reason, count = needs.OBJECTS.lack, len(without) - len(used)
        logger.warning("skipped_episodes", reason=f"{reason} ({needs.OBJECTS.remedy})", count=count)
    if not used:
        return [grids[name] for name in grids if name in with_poses]
    both = replace(posed, is_met=lambda reader: reader.item_id in used | with_poses)
    again = select_episodes(stores, domain=domain, tasks=tasks, splits=splits, needs=(both,))
    return [grids[reader.item_id] for reader in again]


def _recording(grid: EpisodeGrid) -> str | None:
    """What an episode was aligned from at a station."""
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
    listed = listed_objects(about, clicks)
    given = clicks.episodes.get(reader.item_id)
    stored = None
    if given is None:
        held = (store for store in stores if store.exists(reader.item_id))
        stored = next((store.clicks(reader.item_id) for store in held), None)
    one = given or stored
    if one is None:
        return SceneGrid(reader, image_px, listed=listed)
    clicked = clicked_poses(about, clicks, one, may_lack_headings=given is None)
    unfinished = [
        each.name
        for each, known in zip(listed, clicked.known.tolist(), strict=True)
        if not known and each.name in one.objects and one.objects[each.name].state == "seen"
    ]
    if unfinished:
        logger.warning("clicks_without_heading", episode=reader.item_id, objects=unfinished)
    return SceneGrid(reader, image_px, listed=listed, clicked=clicked)
