"""Who may go on with an upload: the key that began it, or a key that is bound to its station."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Final

from fastapi import Depends, Request
from pydantic import ValidationError

from dextouch.episodes import disk_errors
from dextouch.errors import AccessDeniedError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import AccessControl

# In the folder of an upload; without it, the upload was begun without keys or by a release that
# did not keep the name.
SENDER_FILE: Final = "sender.json"


class Sender(FrozenModel):
    """Who sends an upload: the name of the key (None in a store without keys), and its station.

    `station` is None unless the key is bound to one.
    """

    name: str | None = None
    station: str | None = None

    def check_station(self, station: str) -> None:
        """Raise AccessDeniedError unless the key may upload and ask for this station."""
        if self.station not in {None, station}:
            raise AccessDeniedError(
                f"key {self.name!r} is of station {self.station!r} only, got takes of station "
                f"{station!r}; name the station {self.station!r} in its settings, or enrol it as "
                f"{station!r}",
                reason="other_station",
                station=station,
            )

    def may_continue(self, owner: str | None, station: str) -> bool:
        """Whether an upload of a station that the key `owner` began may be continued.

        A key that is bound to the station may, whatever key the station had before.
        """
        if self.station is not None:
            return self.station == station
        return self.name is None or owner is None or self.name == owner

    def check_upload(self, folder: Path, station: str) -> None:
        """Raise AccessDeniedError unless the upload in a folder may be continued."""
        self.check_station(station)
        if not self.may_continue(owner_of(folder), station):
            raise AccessDeniedError(
                f"upload {folder.name!r}: it was begun by another key than {self.name!r}; only the "
                "key that begins an upload may continue it, and one that is bound to its station",
                reason="other_key",
            )

    def as_files(self) -> dict[str, bytes]:
        """What the folder of a new upload keeps; nothing without keys."""
        if self.name is None:
            return {}
        return {SENDER_FILE: self.model_dump_json(include={"name"}).encode()}


# In a store without keys, and for callers in this process.
ANYONE: Final = Sender()


def _sender(scope: str) -> Callable[[Request], Awaitable[Sender]]:
    """Dependency that tells who sends a request that needs a scope."""

    async def sender(request: Request) -> Sender:
        access: AccessControl = request.app.state.access
        if not access.has_keys:
            return ANYONE
        grant = access.granted(request.headers.get("authorization"), scope)
        return Sender(name=grant.name, station=grant.station)

    return sender


Writer = Annotated[Sender, Depends(_sender("store_write"))]
Reader = Annotated[Sender, Depends(_sender("store_read"))]


def owner_of(folder: Path) -> str | None:
    """Name of the key that began an upload; None if none is kept.

    Raises:
        StorageError: the file is damaged.
    """
    with disk_errors(f"read the sender of upload {folder.name!r}"):
        try:
            text = (folder / SENDER_FILE).read_bytes()
        except FileNotFoundError:
            return None
    try:
        return Sender.model_validate_json(text).name
    except ValidationError as error:
        raise StorageError(
            f"upload {folder.name!r}: {SENDER_FILE} is damaged; expire the upload, so that its "
            "station sends it again"
        ) from error
