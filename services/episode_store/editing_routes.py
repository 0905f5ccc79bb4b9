"""HTTP routes of the store that edit items, and of notes on their time ranges."""

from typing import Annotated

import structlog
from fastapi import APIRouter, Depends

from dextouch.episodes import EpisodeStore, Kind
from dextouch.episodes.editing import (
    EditOptions,
    add_note,
    relabel_item,
    remove_note,
    trim_episode,
)
from dextouch.errors import DexTouchError
from dextouch.schemas import (
    EditedItem,
    EditedItems,
    ItemKind,
    ItemNotes,
    NewNote,
    RefusedItem,
    RelabelItems,
    RemoveNote,
    StoredItem,
    TrimEpisode,
)
from dextouch.serving import JSON, KIB, JsonBody, takes
from services.episode_store.catalog import Catalog
from services.episode_store.keys import MAY_DELETE, MAY_READ

logger = structlog.get_logger(__name__)

MAX_NOTE_BYTES = 16 * KIB
# Room for the names of all items.
MAX_EDIT_BYTES = 256 * KIB


def editing_router(store: EpisodeStore, catalog: Catalog) -> APIRouter:
    """Create the routes of edits; with `dry_run` they say what would happen."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_DELETE])

    def done(kind: Kind, result: EditedItem, *, dry_run: bool) -> EditedItem:
        if not dry_run:
            # Their reviews have changed.
            for source in store.open_item(kind, result.id).attributes.lineage:
                if source.is_edit and source.kind == kind:
                    catalog.forget(StoredItem(kind=kind, id=source.id))
            logger.info("item_edited", kind=kind, id=result.id, source=result.source_id)
        return result

    @router.post("/episodes/{episode_id}/trim", tags=["episodes"])
    @takes({JSON: MAX_NOTE_BYTES})
    def trim_episode_steps(
        episode_id: str, body: Annotated[TrimEpisode, Depends(JsonBody(TrimEpisode))]
    ) -> EditedItem:
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
    @takes({JSON: MAX_EDIT_BYTES})
    def relabel_items(
        body: Annotated[RelabelItems, Depends(JsonBody(RelabelItems))],
    ) -> EditedItems:
        """Write items with other attributes as new ones, which take their places."""
        changes = body.model_dump(include={"task", "instruction", "operator"}, exclude_none=True)
        edited, refused = [], []
        for item in body.items:
            try:
                result = relabel_item(
                    store,
                    item.id,
                    changes,
                    kind=item.kind,
                    outcome=body.outcome,
                    options=EditOptions(keep=body.keep, dry_run=body.dry_run),
                )
            except DexTouchError as error:
                refused.append(RefusedItem(kind=item.kind, id=item.id, reason=error.message))
            else:
                edited.append(done(item.kind, result, dry_run=body.dry_run))
        return EditedItems(edited=tuple(edited), refused=tuple(refused))

    return router


def notes_router(store: EpisodeStore) -> APIRouter:
    """Create the routes of notes, whose times are those of the item's streams in its playback."""
    router = APIRouter(prefix="/v1/notes", tags=["notes"], responses={404: {}})

    @router.get("/{kind}/{item_id}", dependencies=[MAY_READ])
    def list_notes(kind: ItemKind, item_id: str) -> ItemNotes:
        """Notes on an item, in the order of their starts."""
        return store.notes(item_id, kind=kind)

    @router.post("/{kind}/{item_id}", dependencies=[MAY_DELETE])
    @takes({JSON: MAX_NOTE_BYTES})
    def save_note(
        kind: ItemKind, item_id: str, body: Annotated[NewNote, Depends(JsonBody(NewNote))]
    ) -> ItemNotes:
        """Add a note; the answer has all notes of the item."""
        add_note(store, item_id, body, kind=kind)
        return store.notes(item_id, kind=kind)

    @router.post("/{kind}/{item_id}/remove", dependencies=[MAY_DELETE])
    @takes({JSON: MAX_NOTE_BYTES})
    def delete_note(
        kind: ItemKind, item_id: str, body: Annotated[RemoveNote, Depends(JsonBody(RemoveNote))]
    ) -> ItemNotes:
        """Remove a note; the answer has those that are left."""
        return remove_note(store, item_id, body.number, kind=kind)

    return router
