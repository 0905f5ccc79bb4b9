"""HTTP routes of clicks on objects: which episodes to mark, what was clicked, and what it gives."""

import zlib
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query

from dextouch.episodes import EpisodeStore, clicked_poses, first_camera
from dextouch.errors import DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import box_pixels, transform_from_pose
from dextouch.schemas import EpisodeClicks, ObjectClicks, SceneObject
from dextouch.serving import JSON, KIB, JsonBody, takes
from dextouch.streams import HEAD_CAMERA
from services.episode_store.catalog import Catalog
from services.episode_store.keys import MAY_DELETE, MAY_READ


class ClickableEpisode(FrozenModel):
    """An episode whose objects can be clicked, and clicks that there are."""

    episode_id: str
    clicks: EpisodeClicks | None


class ClickQueue(FrozenModel):
    """Episodes of a task to mark: those that were marked, and others in an order without meaning.

    `num_matching` is the number of all episodes of the task that could be marked.
    """

    tasks: tuple[str, ...]
    task: str
    objects: tuple[SceneObject, ...]
    episodes: tuple[ClickableEpisode, ...]
    num_matching: int


class ClickedEpisode(FrozenModel):
    """The first image of an episode, clicks in it, and the boxes of the poses that they give.

    `boxes_px` are the eight corners of each box (bit 0, 1, 2 of a corner's number: x, y, z);
    `problem` is why the clicks give no poses, with the objects as they are described now.
    """

    episode_id: str
    image_t_ns: int
    clicks: EpisodeClicks
    boxes_px: dict[str, tuple[tuple[float, float], ...]]
    problem: str = ""


def clicks_router(store: EpisodeStore, catalog: Catalog, objects: ObjectClicks | None) -> APIRouter:
    """Create the routes of clicks; without a description of the objects they are refused."""
    router = APIRouter(prefix="/v1", tags=["clicks"], responses={404: {}})

    def described() -> ObjectClicks:
        if objects is None:
            raise NotFoundError(
                "clicks: no objects are described; start the store with --objects FILE, or "
                "DEXTOUCH_EPISODE_STORE_OBJECTS (docs/objects.md)"
            )
        return objects

    @router.get("/catalog/clicks", dependencies=[MAY_READ])
    def queue(
        task: Annotated[str | None, Query(max_length=128)] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 20,
    ) -> ClickQueue:
        """Episodes of a task (by default the first) whose objects no stream and no person knows."""
        return _queue(catalog, described(), task, limit)

    @router.get("/catalog/clicks/file", dependencies=[MAY_READ])
    def file() -> ObjectClicks:
        """The described objects and all clicks in the store, for `train world-model --clicks`."""
        known = described()
        stored = {name: one.clicks for name, one in catalog.clickable().items() if one.clicks}
        return known.model_copy(update={"episodes": known.episodes | stored})

    @router.get("/episodes/{episode_id}/clicks", dependencies=[MAY_READ])
    def clicked(episode_id: str) -> ClickedEpisode:
        """Clicks on the objects of an episode, and what its first image is."""
        clicks = store.clicks(episode_id) or EpisodeClicks(objects={})
        try:
            return _clicked(store, described(), episode_id, clicks)
        except DexTouchError as error:
            about = _clicked(store, described(), episode_id, EpisodeClicks(objects={}))
            return about.model_copy(update={"clicks": clicks, "problem": error.message})

    @router.post("/episodes/{episode_id}/clicks", dependencies=[MAY_DELETE])
    @takes({JSON: 16 * KIB})
    def click(
        episode_id: str, clicks: Annotated[EpisodeClicks, Depends(JsonBody(EpisodeClicks))]
    ) -> ClickedEpisode:
        """Keep clicks in place of earlier ones, none to remove them; wrong ones are refused."""
        found = _clicked(store, described(), episode_id, clicks)
        catalog.set_clicks(episode_id, clicks if clicks.objects else None)
        return found

    return router


def _queue(catalog: Catalog, objects: ObjectClicks, task: str | None, limit: int) -> ClickQueue:
    tasks = tuple(objects.tasks)
    chosen = tasks[0] if task is None and tasks else task or ""
    if chosen not in objects.tasks:
        raise NotFoundError(f"clicks: task {chosen!r} has no objects; {', '.join(tasks)} have")
    found = {name: one for name, one in catalog.clickable().items() if one.item.task == chosen}
    # In the order of recording, the first takes would be those of one person and one day.
    names = sorted(found, key=lambda name: (zlib.crc32(name.encode()), name))
    marked = [name for name in names if found[name].clicks]
    others = [name for name in names if not found[name].clicks][: max(limit - len(marked), 0)]
    listed = sorted({*marked, *others}, key=names.index)
    return ClickQueue(
        tasks=tasks,
        task=chosen,
        objects=objects.tasks[chosen],
        episodes=tuple(
            ClickableEpisode(episode_id=name, clicks=found[name].clicks) for name in listed
        ),
        num_matching=len(found),
    )


def _clicked(
    store: EpisodeStore, objects: ObjectClicks, episode_id: str, clicks: EpisodeClicks
) -> ClickedEpisode:
    """An episode with clicks; raises as `clicked_poses`."""
    reader = store.open(episode_id)
    about = reader.attributes
    found = clicked_poses(about, objects, clicks, may_lack_headings=True)
    camera, T_world_camera = first_camera(about)
    boxes_px = {}
    for one, pose, is_known in zip(found.objects, found.poses, found.known.tolist(), strict=True):
        if is_known and clicks.objects[one.name].state == "seen":
            T = transform_from_pose(pose)
            corners_px = box_pixels(np.array(one.box_m), T, camera, T_world_camera)
            if np.isfinite(corners_px).all():
                boxes_px[one.name] = tuple((u, v) for u, v in corners_px.tolist())
    nearest = reader.nearest_images(HEAD_CAMERA, reader.stamps_ns("action")[:1])
    return ClickedEpisode(
        episode_id=episode_id,
        image_t_ns=int(reader.stamps_ns(HEAD_CAMERA)[nearest[0]]),
        clicks=clicks,
        boxes_px=boxes_px,
    )
