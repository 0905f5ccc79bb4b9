"""HTTP route by which people without a shell get MCAP files of some items: one file, or a zip."""

import json
import os
import shutil
import threading
import uuid
import zipfile
from collections.abc import Generator, Iterator, Sequence
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final

import anyio.to_thread
import structlog
from fastapi import APIRouter, Depends
from pydantic import Field

from dextouch.episodes import (
    DOWNLOADS,
    EpisodeReader,
    EpisodeStore,
    RecordingReader,
    disk_errors,
    is_rejected,
    kind_of,
    make_held_folder,
)
from dextouch.errors import DexTouchError, LimitExceededError, NotFoundError, UnavailableError
from dextouch.frozen_model import FrozenModel, example
from dextouch.installation import install_command
from dextouch.schemas import StoredItem
from dextouch.serving import JSON, KIB, JsonBody, StreamedResponse, takes
from services.episode_store.keys import MAY_READ
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)

Reader = EpisodeReader | RecordingReader
ZIP, MCAP = "application/zip", "application/octet-stream"
PIECE_BYTES: Final = 1 << 20
BUSY_RETRY_S: Final = 5
# More than any limit of a service, so that its message about the limit is the one that is seen.
MAX_ITEMS: Final = 10_000
ESTIMATE: Final = "x-dextouch-estimated-bytes"
# Of those that the extra `export` brings, what MCAP files need.
_PACKAGES: Final = ("mcap", "foxglove_schemas_protobuf", "lz4")
COMMAND: Final = "`dextouch export --format mcap` on the store's computer has no limit"


class DownloadItems(FrozenModel):
    """Items to download; without `with_rejected`, those rejected in review are left out."""

    model_config = example(items=[{"kind": "episode", "id": "take-20260301-1"}])

    items: tuple[StoredItem, ...] = Field(min_length=1, max_length=MAX_ITEMS)
    with_rejected: bool = True


class _Collected:
    """File without a position, into which an archive is written piece by piece."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: bytes, /) -> int:
        self._pieces.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Nothing waits."""

    def take(self) -> bytes:
        taken, self._pieces = b"".join(self._pieces), []
        return taken


class _Folder:
    """Locked folder of one download in its store; a sweep removes those that a kill has left.

    A deletion finds in `items.json` whose data it holds. Raises StorageError.
    """

    def __init__(self, root: Path, readers: Sequence[Reader]) -> None:
        self.path = root / DOWNLOADS / uuid.uuid4().hex
        with disk_errors("begin a download"):
            self._lock = make_held_folder(self.path)
            try:
                (self.path / "items.json").write_text(json.dumps([one.item_id for one in readers]))
            except BaseException:
                self.remove()
                raise

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


class Downloads:
    """Makes downloads, of limited size and a few at a time."""

    def __init__(self, store: EpisodeStore, settings: EpisodeStoreSettings) -> None:
        self._store, self._settings = store, settings
        self._free = threading.Semaphore(settings.max_downloads)

    def begin(self, wanted: DownloadItems) -> StreamedResponse:
        """Open the items and begin; nothing is exported yet.

        Raises NotFoundError if an item is missing or all were rejected, LimitExceededError for too
        many items, bytes or downloads at once, UnavailableError without the extra `export`, and
        StorageError if an item is damaged or the disk is full.
        """
        absent = [name for name in _PACKAGES if find_spec(name) is None]
        if absent:
            raise UnavailableError(
                "downloads need packages that this store was installed without, such as "
                f"{absent[0]}: {install_command('export')}"
            )
        most = self._settings.max_download_items
        items = list(dict.fromkeys(wanted.items))
        if len(items) > most:
            raise LimitExceededError(
                f"download: got {len(items)} items, expected at most {most}; {COMMAND}"
            )
        readers = [self._store.open_item(item.kind, item.id) for item in items]
        if not wanted.with_rejected:
            readers = [one for one in readers if not is_rejected(self._store, one.attributes)]
        if not readers:
            raise NotFoundError(f"download: all {len(items)} items were rejected in review")
        sizes = [
            self._store.num_bytes(one.item_id, kind=kind_of(one.attributes)) for one in readers
        ]
        most = self._settings.max_download_bytes
        if sum(sizes) > most:
            raise LimitExceededError(
                f"download: got {len(readers)} items of {sum(sizes) / 1e6:.0f} MB, expected at "
                f"most {most / 1e6:.0f} MB; {COMMAND}"
            )
        if not self._free.acquire(blocking=False):
            raise LimitExceededError(
                f"store is busy with {self._settings.max_downloads} downloads; try again in "
                f"{BUSY_RETRY_S} s",
                reason="busy",
                retry_after_s=BUSY_RETRY_S,
            )
        try:
            return self._response(readers, sum(sizes))
        except BaseException:
            self._free.release()
            raise

    def _response(self, readers: Sequence[Reader], num_bytes: int) -> StreamedResponse:
        folder = _Folder(self._store.root, readers)
        pieces = (_archive if len(readers) > 1 else _single)(readers, folder.path)
        name = f"{readers[0].item_id}.mcap"
        if len(readers) > 1:
            name = f"dextouch-{datetime.now(UTC):%Y-%m-%d}-{len(readers)}.zip"
        logger.info("download_begun", ids=[one.item_id for one in readers], num_bytes=num_bytes)

        def end() -> None:
            try:
                pieces.close()
            finally:
                folder.remove()
                self._free.release()

        async def end_in_thread() -> None:
            # Also for a client that left, whose task is being cancelled.
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(end)

        headers = {
            "content-type": ZIP if len(readers) > 1 else MCAP,
            "content-disposition": f'attachment; filename="{name}"',
            "cache-control": "no-store",
            ESTIMATE: str(num_bytes),
        }
        return StreamedResponse(pieces, headers=headers, on_end=end_in_thread)


def _export(reader: Reader, path: Path) -> dict[str, object]:
    from dextouch.bridges.mcap import export_mcap

    try:
        num_messages = export_mcap(reader, path, overwrite=True)
    except DexTouchError as error:
        # The response has begun, so that only the log can tell.
        logger.error("download_failed", id=reader.item_id, reason=error.message)  # noqa: TRY400
        raise
    lost = {name: reader.damaged_images(name).tolist() for name in reader.streams}
    return {
        "kind": kind_of(reader.attributes),
        "id": reader.item_id,
        "num_messages": num_messages,
        "damaged_images": {name: images for name, images in lost.items() if images},
    }


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            yield piece


def _single(readers: Sequence[Reader], folder: Path) -> Generator[bytes, None, None]:
    path = folder / "item.mcap"
    _export(readers[0], path)
    yield from _pieces(path)


def _archive(readers: Sequence[Reader], folder: Path) -> Generator[bytes, None, None]:
    """A zip of MCAP files, which are compressed already, a layout for Foxglove and a list."""
    from dextouch.bridges.foxglove import LAYOUT_FILE, foxglove_layout

    made, contents = _Collected(), []
    kinds = {kind_of(reader.attributes) for reader in readers}
    with zipfile.ZipFile(made, "w", zipfile.ZIP_STORED) as archive:  # type: ignore[call-overload]
        for reader in readers:
            path = folder / "item.mcap"
            about = _export(reader, path)
            # A recording and its episode may have one id.
            name = f"{reader.item_id}.mcap"
            name = name if len(kinds) == 1 else f"{kind_of(reader.attributes)}s/{name}"
            contents.append({"file": name} | about)
            with archive.open(name, "w", force_zip64=True) as entry:
                for piece in _pieces(path):
                    entry.write(piece)
                    yield made.take()
        streams = [stream for reader in readers for stream in reader.attributes.streams]
        archive.writestr(LAYOUT_FILE, json.dumps(foxglove_layout(streams), indent=1))
        archive.writestr("contents.json", json.dumps(contents, indent=1))
    yield made.take()


def downloads_router(downloads: Downloads) -> APIRouter:
    """Create the route below /v1/downloads."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])

    @router.post(
        "/downloads",
        tags=["catalog"],
        response_class=StreamedResponse,
        responses={200: {"content": {ZIP: {}, MCAP: {}}}},
    )
    @takes({JSON: 1024 * KIB})
    def download_items(
        wanted: Annotated[DownloadItems, Depends(JsonBody(DownloadItems))],
    ) -> StreamedResponse:
        """MCAP files of episodes and recordings: of one item its file, of several one zip."""
        return downloads.begin(wanted)

    return router
