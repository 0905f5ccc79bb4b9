"""HTTP routes of the store: uploads by stations, lists, changes of items, and clicks on objects."""

import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from functools import partial
from typing import Annotated

import anyio
import anyio.to_thread
import numpy as np
import structlog
from fastapi import APIRouter, Depends, Path, Query, Request

from dextouch import schemas
from dextouch.episodes import KINDS, EpisodeStore, Kind, clicked_poses, first_camera
from dextouch.episodes.editing import EditOptions, add_note, relabel_item, remove_note, trim_episode
from dextouch.errors import DexTouchError, NotFoundError, StorageFullError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import box_pixels, transform_from_pose
from dextouch.serving import AS_SET, JSON, KIB, OCTETS, JsonBody, takes
from dextouch.streams import HEAD_CAMERA, MAX_BATCH_BYTES
from services.episode_store.catalog import Catalog
from services.episode_store.filters import EpisodeFilter, EpisodeQuery, ItemQuery, RecordingQuery
from services.episode_store.ingest import Ingest
from services.episode_store.intake import Admission, StorageLimits, UploadMetrics
from services.episode_store.items import HoursField, HoursFilter
from services.episode_store.keys import MAY_DELETE, MAY_EXPIRE, MAY_READ, MAY_WRITE, Reader, Writer

logger = structlog.get_logger(__name__)

Attributes = Annotated[schemas.NewRecording, Depends(JsonBody(schemas.NewRecording))]
Finish = Annotated[schemas.FinishRecording, Depends(JsonBody(schemas.FinishRecording))]
Status = schemas.RecordingStatus
# Room for the calibration and descriptors of a station, the ledger of a take, or names of items.
MAX_ATTRIBUTES_BYTES = 256 * KIB
MAX_NOTE_BYTES = 16 * KIB


async def _check_unless(
    is_stored: Callable[[], bool], check: Callable[[], None], *, limiter: anyio.CapacityLimiter
) -> None:
    """As `_unless`; whether a batch is stored is looked up on the disk, in a thread."""
    try:
        check()
    except StorageFullError:
        if not await anyio.to_thread.run_sync(is_stored, limiter=limiter):
            raise


def uploads_router(
    ingest: Ingest, limits: StorageLimits, admission: Admission, metrics: UploadMetrics
) -> APIRouter:
    """Create the routes by which stations upload recordings, below /v1/recordings."""
    router = APIRouter(prefix="/v1")

    @router.post("/recordings", status_code=201, tags=["recordings"], dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def create_recording(given: Attributes, sender: Writer) -> Status:
        """Begin an upload, or return the status of an existing one."""
        attributes = given.attributes()
        sender.check_station(attributes.station)
        with (
            metrics.counting_refusals(),
            _unless(partial(ingest.is_begun, attributes.recording_id)),
        ):
            limits.check_new(attributes.station)
        status = ingest.create(attributes, sender)
        if status.state == "open":
            limits.begin(attributes)
        return status

    @router.post(
        "/recordings/{recording_id}/streams/{stream}/batches/{number}",
        tags=["recordings"],
        dependencies=[MAY_WRITE],
    )
    @takes({OCTETS: AS_SET})
    async def upload_batch(
        recording_id: str,
        stream: str,
        number: Annotated[int, Path(ge=0)],
        request: Request,
        sender: Writer,
    ) -> schemas.BatchReceipt:
        """Store batch n of a stream (wire format v2), exactly once even if repeated."""
        announced = request.headers.get("content-length", "")
        # A body of unknown length may be as large as the largest batch.
        num_bytes = int(announced) if announced.isdecimal() else MAX_BATCH_BYTES
        with ExitStack() as admitted:
            # A refused body is not read.
            with metrics.counting_refusals():
                admitted.enter_context(admission.admitted(num_bytes))
                is_stored = partial(ingest.is_stored, recording_id, stream, number)
                check = partial(limits.check_batch, recording_id, num_bytes)
                await _check_unless(is_stored, check, limiter=admission.threads)
            started = time.perf_counter()
            data = await request.body()
            receipt = await anyio.to_thread.run_sync(
                partial(ingest.put_batch, recording_id, stream, number, data, sender),
                limiter=admission.threads,
            )
        metrics.count(receipt, num_bytes=len(data), took_s=time.perf_counter() - started)
        if not receipt.replayed:
            limits.add(recording_id, len(data))
        return receipt

    @router.post("/recordings/{recording_id}/finish", tags=["recordings"], dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def finish_recording(recording_id: str, body: Finish, sender: Writer) -> Status:
        """Commit a complete upload."""
        started = time.perf_counter()
        with metrics.counting_refusals(), _unless(partial(ingest.is_finished, recording_id)):
            limits.check_finish(recording_id)
        status = ingest.finish(recording_id, body, sender)
        limits.end(recording_id)
        metrics.finish_seconds.observe(time.perf_counter() - started)
        return status

    @router.get("/recordings/{recording_id}", tags=["recordings"], dependencies=[MAY_READ])
    def get_recording(recording_id: str, sender: Reader) -> Status:
        """Status of an upload, for those who may continue it, or of a finished recording."""
        return ingest.status(recording_id, sender)

    return router


def idle_uploads_router(ingest: Ingest, limits: StorageLimits) -> APIRouter:
    """Create the routes of unfinished uploads, below /v1/uploads."""
    router = APIRouter(prefix="/v1")

    @router.get("/uploads", tags=["uploads"], dependencies=[MAY_READ])
    def list_uploads(idle_s: Annotated[float, Query(ge=0)] = 0.0) -> schemas.UploadList:
        """List unfinished uploads that have been idle for `idle_s`."""
        return limits.idle(idle_s=idle_s)

    @router.post("/uploads/expire", tags=["uploads"], dependencies=[MAY_EXPIRE])
    def expire_uploads(body: schemas.ExpireUploads) -> schemas.UploadList:
        """Drop such uploads with their data; the response lists them."""
        gone = []
        for upload in limits.idle(idle_s=body.idle_s).uploads:
            if ingest.expire(upload.recording_id, idle_s=body.idle_s):
                limits.end(upload.recording_id)
                gone.append(upload)
        return schemas.UploadList(uploads=tuple(gone))

    return router


@contextmanager
def _unless(is_known: Callable[[], bool]) -> Iterator[None]:
    """Refuse for lack of space, unless the request repeats what was acknowledged before.

    A station that missed the acknowledgement must get it on a full disk too.
    """
    try:
        yield
    except StorageFullError:
        if not is_known():
            raise


def catalog_router(catalog: Catalog, *, max_page: int) -> APIRouter:
    """Create the routes that list recordings and episodes, and sum up their hours."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])

    @router.get("/recordings", tags=["recordings"])
    def list_recordings(query: Annotated[RecordingQuery, Query()]) -> schemas.RecordingList:
        """List finished recordings that match all filters."""
        return catalog.recordings(query, limit=query.num_rows(max_page), page=query)

    @router.get("/episodes", tags=["episodes"])
    def list_episodes(query: Annotated[EpisodeQuery, Query()]) -> schemas.EpisodeList:
        """List episodes that match all filters."""
        return catalog.episodes(query, limit=query.num_rows(max_page), page=query)

    @router.get("/catalog/hours", tags=["catalog"])
    def get_hours(query: Annotated[EpisodeFilter, Query()]) -> schemas.CatalogHours:
        """Hours and counts of the matching episodes by task, domain and origin."""
        return catalog.hours(query)

    @router.get("/catalog/hours/{field}", tags=["catalog"])
    def get_hours_by_field(
        field: HoursField, query: Annotated[HoursFilter, Query()]
    ) -> schemas.HoursByField:
        """Hours of the matching episodes by the values of one field, and by their reviews."""
        return catalog.hours_by(field, query)

    @router.get("/catalog/items", tags=["catalog"])
    def list_items(query: Annotated[ItemQuery, Query()]) -> schemas.CatalogItems:
        """List recordings and episodes in one list; both as takes by default."""
        return catalog.items(query, limit=query.num_rows(max_page), page=query)

    @router.get("/catalog/groups", tags=["catalog"])
    def list_compared_groups() -> schemas.ComparedGroups:
        """Groups of items that are compared to find outliers, and whether they are large enough."""
        return catalog.groups()

    @router.get("/catalog/values", tags=["catalog"])
    def list_values() -> schemas.CatalogValues:
        """Tasks, operators and stations that occur in the store."""
        return catalog.values()

    @router.get("/catalog/lineage/{kind}/{item_id}", tags=["catalog"])
    def get_lineage(kind: schemas.ItemKind, item_id: str) -> schemas.Lineage:
        """What an item was made from, and what was made from it."""
        return catalog.lineage(kind, item_id)

    return router


def reviews_router(catalog: Catalog) -> APIRouter:
    """Create the route that keeps reviews."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_DELETE])

    @router.post("/catalog/reviews", tags=["catalog"])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def review_items(
        body: Annotated[schemas.ReviewItems, Depends(JsonBody(schemas.ReviewItems))],
    ) -> schemas.ReviewedItems:
        """Accept or reject items, or remove their reviews; rejected ones are not trained on."""
        review = None
        if body.verdict is not None:
            review = schemas.Review(
                verdict=body.verdict,
                reason=body.reason,
                reviewer=body.reviewer,
                reviewed_at=datetime.now(UTC),
            )
        reviewed, refused = _each(body.items, lambda item: catalog.review(item, review))
        logger.info("items_reviewed", verdict=body.verdict, ids=[item.id for item in reviewed])
        return schemas.ReviewedItems(reviewed=reviewed, refused=refused)

    return router


def trash_router(store: EpisodeStore, *, max_page: int) -> APIRouter:
    """Create the routes below /v1/trash."""
    router = APIRouter(prefix="/v1/trash", tags=["trash"])

    @router.get("", dependencies=[MAY_READ])
    def list_trash(limit: Annotated[int, Query(ge=1)] = 100) -> schemas.TrashContents:
        """Deleted episodes and recordings, newest first; refused for a store in a bucket."""
        entries = [entry for entry in store.trash_list() if entry.kind in KINDS]
        newest = entries[::-1][: min(limit, max_page)]
        items = []
        for entry in newest:
            at = datetime.fromtimestamp(entry.deleted_at_ns / 1_000_000_000, UTC)
            about = {"kind": entry.kind, "id": entry.item_id, "num_bytes": entry.num_bytes}
            items.append(schemas.TrashedItem.model_validate(about | {"deleted_at": at}))
        return schemas.TrashContents(items=tuple(items), num_items=len(entries))

    @router.post("", dependencies=[MAY_DELETE])
    def delete_items(body: schemas.MoveItems) -> schemas.MovedItems:
        """Move items to the trash; refused for a store in a bucket, which has none."""
        store.require_trash()
        return _move(body, lambda item: store.delete(item.id, kind=item.kind))

    @router.post("/restore", dependencies=[MAY_DELETE])
    def restore_items(body: schemas.MoveItems) -> schemas.MovedItems:
        """Restore items from the trash, each the one that was deleted last."""
        store.require_trash()
        return _move(body, lambda item: store.restore(item.id, kind=item.kind))

    return router


def _move(
    body: schemas.MoveItems, move: Callable[[schemas.StoredItem], None]
) -> schemas.MovedItems:
    moved, refused = _each(body.items, move)
    logger.info("items_moved", moved=[item.id for item in moved], num_refused=len(refused))
    return schemas.MovedItems(moved=moved, refused=refused)


def _each(
    items: Iterable[schemas.StoredItem], change: Callable[[schemas.StoredItem], None]
) -> tuple[tuple[schemas.StoredItem, ...], tuple[schemas.RefusedItem, ...]]:
    """Change items, each on its own; those that were changed, and those that were refused."""
    changed, refused = [], []
    for item in items:
        try:
            change(item)
        except DexTouchError as error:
            refused.append(schemas.RefusedItem(kind=item.kind, id=item.id, reason=error.message))
        else:
            changed.append(item)
    return tuple(changed), tuple(refused)


class ClickableEpisode(FrozenModel):
    """An episode whose objects can be clicked, and clicks that there are."""

    episode_id: str
    clicks: schemas.EpisodeClicks | None


class ClickQueue(FrozenModel):
    """Episodes of a task to mark: those that were marked, and others in an order without meaning.

    `num_matching` is the number of all episodes of the task that could be marked.
    """

    tasks: tuple[str, ...]
    task: str
    objects: tuple[schemas.SceneObject, ...]
    episodes: tuple[ClickableEpisode, ...]
    num_matching: int


class ClickedEpisode(FrozenModel):
    """The first image of an episode, clicks in it, and the boxes of the poses that they give.

    `boxes_px` are the eight corners of each box (bit 0, 1, 2 of a corner's number: x, y, z);
    `problem` is why the clicks give no poses, with the objects as they are described now.
    """

    episode_id: str
    image_t_ns: int
    clicks: schemas.EpisodeClicks
    boxes_px: dict[str, tuple[tuple[float, float], ...]]
    problem: str = ""


def clicks_router(
    store: EpisodeStore, catalog: Catalog, objects: schemas.ObjectClicks | None
) -> APIRouter:
    """Create the routes of clicks; without a description of the objects they are refused."""
    router = APIRouter(prefix="/v1", tags=["clicks"], responses={404: {}})

    def described() -> schemas.ObjectClicks:
        if objects is None:
            raise NotFoundError(
                "clicks: no objects are described; start the store with --objects FILE, or "
                "DEXTOUCH_EPISODE_STORE_OBJECTS (docs/objects.md)"
            )
        return objects

    @router.get("/catalog/clicks", dependencies=[MAY_READ])
    def list_episodes_to_click(
        task: Annotated[str | None, Query(max_length=128)] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 20,
    ) -> ClickQueue:
        """Episodes of a task (by default the first) whose objects no stream and no person knows."""
        return _queue(catalog, described(), task, limit)

    @router.get("/catalog/clicks/file", dependencies=[MAY_READ])
    def get_clicks_file() -> schemas.ObjectClicks:
        """The described objects and all clicks in the store, for `train world-model --clicks`."""
        known = described()
        stored = {name: one.clicks for name, one in catalog.clickable().items() if one.clicks}
        return known.model_copy(update={"episodes": known.episodes | stored})

    @router.get("/episodes/{episode_id}/clicks", dependencies=[MAY_READ])
    def get_episode_clicks(episode_id: str) -> ClickedEpisode:
        """Clicks on the objects of an episode, and what its first image is."""
        clicks = store.clicks(episode_id) or schemas.EpisodeClicks(objects={})
        try:
            return _clicked(store, described(), episode_id, clicks)
        except DexTouchError as error:
            about = _clicked(store, described(), episode_id, schemas.EpisodeClicks(objects={}))
            return about.model_copy(update={"clicks": clicks, "problem": error.message})

    @router.post("/episodes/{episode_id}/clicks", dependencies=[MAY_DELETE])
    @takes({JSON: MAX_NOTE_BYTES})
    def save_episode_clicks(
        episode_id: str,
        clicks: Annotated[schemas.EpisodeClicks, Depends(JsonBody(schemas.EpisodeClicks))],
    ) -> ClickedEpisode:
        """Keep clicks in place of earlier ones, none to remove them; wrong ones are refused."""
        found = _clicked(store, described(), episode_id, clicks)
        catalog.set_clicks(episode_id, clicks if clicks.objects else None)
        return found

    return router


def _queue(
    catalog: Catalog, objects: schemas.ObjectClicks, task: str | None, limit: int
) -> ClickQueue:
    tasks = tuple(objects.tasks)
    chosen = tasks[0] if task is None and tasks else task or ""
    if chosen not in objects.tasks:
        raise NotFoundError(f"clicks: task {chosen!r} has no objects; {', '.join(tasks)} have")
    found = {name: one for name, one in catalog.clickable().items() if one.task == chosen}
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
    store: EpisodeStore,
    objects: schemas.ObjectClicks,
    episode_id: str,
    clicks: schemas.EpisodeClicks,
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


def editing_router(store: EpisodeStore, catalog: Catalog) -> APIRouter:
    """Create the routes of edits; with `dry_run` they say what would happen."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_DELETE])

    def done(kind: Kind, result: schemas.EditedItem, *, dry_run: bool) -> schemas.EditedItem:
        if not dry_run:
            # Their reviews have changed.
            for source in store.open_item(kind, result.id).attributes.lineage:
                if source.is_edit and source.kind == kind:
                    catalog.index.reread(kind, source.id)
            logger.info("item_edited", kind=kind, id=result.id, source=result.source_id)
        return result

    @router.post("/episodes/{episode_id}/trim", tags=["episodes"])
    @takes({JSON: MAX_NOTE_BYTES})
    def trim_episode_steps(
        episode_id: str,
        body: Annotated[schemas.TrimEpisode, Depends(JsonBody(schemas.TrimEpisode))],
    ) -> schemas.EditedItem:
        """Write steps of an episode as a new one, which takes its place."""
        result = trim_episode(
            store,
            episode_id,
            (body.first_step, body.stop_step),
            outcome=body.outcome,
            exact=body.exact,
            options=EditOptions(keep=body.keep, dry_run=body.dry_run),
        )
        return done("episode", result, dry_run=body.dry_run)

    @router.post("/catalog/relabel", tags=["catalog"])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def relabel_items(
        body: Annotated[schemas.RelabelItems, Depends(JsonBody(schemas.RelabelItems))],
    ) -> schemas.EditedItems:
        """Write items with other attributes as new ones, which take their places."""
        changes = body.model_dump(include={"task", "instruction", "operator"}, exclude_none=True)
        options = EditOptions(keep=body.keep, dry_run=body.dry_run)
        edited = []

        def relabel(item: schemas.StoredItem) -> None:
            result = relabel_item(
                store, item.id, changes, kind=item.kind, outcome=body.outcome, options=options
            )
            edited.append(done(item.kind, result, dry_run=body.dry_run))

        _, refused = _each(body.items, relabel)
        return schemas.EditedItems(edited=tuple(edited), refused=refused)

    return router


def notes_router(store: EpisodeStore) -> APIRouter:
    """Create the routes of notes, whose times are those of the item's streams in its playback."""
    router = APIRouter(prefix="/v1/notes", tags=["notes"], responses={404: {}})

    @router.get("/{kind}/{item_id}", dependencies=[MAY_READ])
    def list_notes(kind: schemas.ItemKind, item_id: str) -> schemas.ItemNotes:
        """Notes on an item, in the order of their starts."""
        return store.notes(item_id, kind=kind)

    @router.post("/{kind}/{item_id}", dependencies=[MAY_DELETE])
    @takes({JSON: MAX_NOTE_BYTES})
    def save_note(
        kind: schemas.ItemKind,
        item_id: str,
        body: Annotated[schemas.NewNote, Depends(JsonBody(schemas.NewNote))],
    ) -> schemas.ItemNotes:
        """Add a note; the answer has all notes of the item."""
        add_note(store, item_id, body, kind=kind)
        return store.notes(item_id, kind=kind)

    @router.post("/{kind}/{item_id}/remove", dependencies=[MAY_DELETE])
    @takes({JSON: MAX_NOTE_BYTES})
    def delete_note(
        kind: schemas.ItemKind,
        item_id: str,
        body: Annotated[schemas.RemoveNote, Depends(JsonBody(schemas.RemoveNote))],
    ) -> schemas.ItemNotes:
        """Remove a note; the answer has those that are left."""
        return remove_note(store, item_id, body.number, kind=kind)

    return router
