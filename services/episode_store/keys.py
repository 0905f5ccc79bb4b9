"""Keys: what they may do, which uploads they may continue, and how stations get theirs.

An upload may be continued by the key that began it, and by a key that is bound to its station.
Stations exchange one-time tokens for such keys. Only hashes of tokens and keys are kept: of tokens
in memory, so that a restart invalidates them, of keys in a file.
"""

import hmac
import secrets
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Final, Literal

import structlog
from fastapi import APIRouter, Depends, Request, Response
from pydantic import ValidationError

from dextouch.episodes import disk_errors, replace_file
from dextouch.errors import AccessDeniedError, ConflictError, NotFoundError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import (
    EnrolmentToken,
    EnrolStation,
    StationEnrolment,
    StationEnrolments,
    StationKey,
    UseToken,
    first_problems,
)
from dextouch.serving import (
    JSON,
    KIB,
    AccessControl,
    Grant,
    RequireScope,
    WrongKeys,
    secret_digest,
    takes,
)

logger = structlog.get_logger(__name__)

# Dependencies of routes on the scope of a key.
MAY_READ: Final = Depends(RequireScope("store_read"))
MAY_WRITE: Final = Depends(RequireScope("store_write"))
MAY_DELETE: Final = Depends(RequireScope("store_delete"))
MAY_EXPIRE: Final = Depends(RequireScope("store_expire"))
MAY_ENROL: Final = Depends(RequireScope("enrol"))
# In the folder of an upload; without it, the upload was begun without keys or by a release that
# did not keep the name.
SENDER_FILE: Final = "sender.json"
STATION_SCOPES: Final = ("store_write",)
TOKEN_LIFETIME_S: Final = 15 * 60
NUM_SECRET_BYTES: Final = 32
# Used and expired tokens are remembered, so that a refusal can give the reason.
MAX_TOKENS: Final = 256
ASK_AGAIN: Final = "ask an administrator for a new one"


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

    Raises StorageError: the file is damaged.
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


class StoredEnrolment(StationEnrolment):
    """An enrolment that led to a key, of which the file holds the SHA-256 in hexadecimal."""

    state: Literal["enrolled", "revoked"]
    key_sha256: str


class StoredEnrolments(FrozenModel):
    """Contents of the file, oldest first."""

    format_version: Literal[1] = 1
    enrolments: tuple[StoredEnrolment, ...] = ()


@dataclass
class Token:
    """An issued token, by its digest."""

    digest: bytes
    enrolment: StationEnrolment
    end_s: float
    is_used: bool = False


class Enrolments:
    """Issues tokens and keys of stations, which a file keeps; thread-safe, for one process.

    Raises StorageError if the file cannot be read.
    """

    def __init__(self, path: Path, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock_s = path, clock_s
        self._access = AccessControl(())
        self._lock = threading.Lock()
        self._tokens: list[Token] = []
        self._kept = _read(path)
        self._is_saved = True

    def connect(self, access: AccessControl) -> None:
        """Add the keys of stations to those that a service accepts, now and at every change."""
        self._access = access
        self._accept(self._kept)

    def listing(self) -> StationEnrolments:
        """All enrolments, newest first."""
        with self._lock:
            fields = [one.model_dump(exclude={"key_sha256"}) for one in self._kept]
            listed = [StationEnrolment.model_validate(one) for one in fields]
            for token in self._tokens:
                if not token.is_used:
                    state = "waiting" if token.end_s > self._clock_s() else "expired"
                    listed.append(token.enrolment.model_copy(update={"state": state}))
        listed.sort(key=lambda one: one.requested_at, reverse=True)
        return StationEnrolments(enrolments=tuple(listed), needs_key=self._access.has_keys)

    def issue(self, station: str, *, by: str, renew: bool = False) -> EnrolmentToken:
        """Issue a token for a station, in place of an earlier unused one.

        With `renew` the key that the station has stays valid beside the new one. Raises
        ConflictError: the store needs no keys, or has a key of this name.
        """
        if not self._access.has_keys:
            raise ConflictError(
                "the store has no api_keys, so that stations need no key either; set api_keys "
                "before enrolling stations (docs/access.md)"
            )
        with self._lock:
            is_enrolled = any(
                (one.station, one.state) == (station, "enrolled") for one in self._kept
            )
            if station in self._access.names and not (renew and is_enrolled):
                raise ConflictError(
                    f"station {station!r}: the store has a key of this name; renew or revoke it, "
                    "or choose another name",
                    station=station,
                )
            token, now = secrets.token_urlsafe(NUM_SECRET_BYTES), datetime.now(UTC)
            enrolment = StationEnrolment(
                station=station,
                state="waiting",
                requested_at=now,
                requested_by=by,
                expires_at=now + timedelta(seconds=TOKEN_LIFETIME_S),
            )
            end_s = self._clock_s() + TOKEN_LIFETIME_S
            self._forget_unused(station)
            self._tokens.append(Token(secret_digest(token), enrolment, end_s))
            self._tokens = self._tokens[-MAX_TOKENS:]
        logger.info("issue_enrolment_token", station=station, by=by)
        return EnrolmentToken(station=station, token=token, expires_at=enrolment.expires_at)

    def exchange(self, text: str, *, client: str) -> StationKey:
        """Exchange a token for a key, once; `client` is the address of the station.

        Raises AccessDeniedError for an unknown, used or expired token, StorageError if the key
        cannot be stored; the token stays valid then.
        """
        with self._lock:
            token = self._valid(secret_digest(text))
            key = secrets.token_urlsafe(NUM_SECRET_BYTES)
            changed = {
                "state": "enrolled",
                "enrolled_at": datetime.now(UTC),
                "enrolled_from": client,
                "key_sha256": secret_digest(key).hex(),
            }
            kept = StoredEnrolment.model_validate(token.enrolment.model_dump() | changed)
            self._save((*self._kept, kept))
            self._accept((*self._kept, kept))
            token.is_used = True
        logger.info("enrol_station", station=kept.station, client=client)
        return StationKey(station=kept.station, key=key)

    def revoke(self, station: str, *, by: str, former: bool = False) -> None:
        """Refuse the keys of a station from now on, or its unused token.

        With `former` its newest key stays valid. Raises NotFoundError if the station has neither,
        StorageError if the key is refused, but would be accepted again after a restart of the
        service: a repetition tries to save this again.
        """
        with self._lock:
            num_unused = 0 if former else self._forget_unused(station)
            valid = [o for o in self._kept if (o.station, o.state) == (station, "enrolled")]
            ended = valid[:-1] if former else valid
            end = {"state": "revoked", "revoked_at": datetime.now(UTC), "revoked_by": by}
            revoked = tuple(
                one.model_copy(update=end) if one in ended else one for one in self._kept
            )
            if revoked == self._kept and not num_unused and self._is_saved:
                raise NotFoundError(
                    f"station {station!r}: it has no {'former ' * former}enrolled key; keys of the "
                    "setting api_keys are removed there",
                    station=station,
                )
            # Before the file, so that a full disk does not leave the key valid.
            self._is_saved = self._is_saved and revoked == self._kept
            self._accept(revoked)
            if not self._is_saved:
                self._save(revoked)
        logger.info("revoke_station", station=station, by=by)

    def _valid(self, digest: bytes) -> Token:
        # Every token is compared, to avoid a timing side channel.
        found = [one for one in self._tokens if hmac.compare_digest(one.digest, digest)]
        if not found:
            raise AccessDeniedError(f"unknown token; {ASK_AGAIN}", reason="unknown_token")
        if found[0].is_used:
            raise AccessDeniedError(
                f"the token was used before; {ASK_AGAIN}, and revoke the key if the station did "
                "not get it",
                reason="used_token",
            )
        if found[0].end_s <= self._clock_s():
            raise AccessDeniedError(
                f"the token has expired: tokens are valid for {TOKEN_LIFETIME_S // 60} minutes; "
                f"{ASK_AGAIN}",
                reason="expired_token",
            )
        return found[0]

    def _forget_unused(self, station: str) -> int:
        """Drop the unused tokens of a station, and return how many there were."""
        left = [t for t in self._tokens if t.is_used or t.enrolment.station != station]
        num_dropped = len(self._tokens) - len(left)
        self._tokens = left
        return num_dropped

    def _save(self, enrolments: tuple[StoredEnrolment, ...]) -> None:
        with disk_errors(f"write {self._path}"):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            text = StoredEnrolments(enrolments=enrolments).model_dump_json(indent=1)
            replace_file(self._path, text.encode(), mode=0o600)
        self._is_saved = True

    def _accept(self, enrolments: tuple[StoredEnrolment, ...]) -> None:
        self._kept = enrolments
        self._access.set_enrolled(
            [
                (
                    bytes.fromhex(one.key_sha256),
                    Grant(name=one.station, scopes=STATION_SCOPES, station=one.station),
                )
                for one in enrolments
                if one.state == "enrolled"
            ]
        )


def _read(path: Path) -> tuple[StoredEnrolment, ...]:
    with disk_errors(f"read {path}"):
        if not path.exists():
            return ()
        text = path.read_bytes()
    try:
        return StoredEnrolments.model_validate_json(text).enrolments
    except ValidationError as error:
        raise StorageError(
            f"{path}: no valid list of enrolled stations ({first_problems(error)}); restore it "
            "from a backup, or remove it and enrol the stations again"
        ) from error


def enrolment_router(enrolments: Enrolments) -> APIRouter:
    """Create the routes below /v1/enrolments; the exchange of a token needs no key."""
    router = APIRouter(prefix="/v1/enrolments", tags=["enrolments"])

    @router.get("", dependencies=[MAY_ENROL])
    def list_enrolments() -> StationEnrolments:
        """List enrolled, waiting and revoked stations."""
        return enrolments.listing()

    @router.post("", status_code=201)
    def issue_enrolment(
        body: EnrolStation, by: Annotated[str, MAY_ENROL], response: Response
    ) -> EnrolmentToken:
        """Issue a one-time token for a station, valid for 15 minutes."""
        response.headers["cache-control"] = "no-store"
        return enrolments.issue(body.station, by=by, renew=body.renew)

    @router.post("/exchange", status_code=201)
    @takes({JSON: KIB}, needs_key=False)
    def exchange_enrolment(given: UseToken, request: Request, response: Response) -> StationKey:
        """Exchange a token for a key of the station's own, once."""
        response.headers["cache-control"] = "no-store"
        client = request.client.host if request.client else "unknown"
        try:
            return enrolments.exchange(given.token.get_secret_value(), client=client)
        except AccessDeniedError as error:
            if error.details["reason"] == "unknown_token":
                wrong_keys: WrongKeys = request.app.state.wrong_keys
                wrong_keys.count(request, what="token")
            raise

    @router.post("/{station}/revoke")
    def revoke_enrolment(
        station: str, by: Annotated[str, MAY_ENROL], *, former: bool = False
    ) -> StationEnrolments:
        """Refuse the keys of a station from now on, or its unused token; or its `former` keys."""
        enrolments.revoke(station, by=by, former=former)
        return enrolments.listing()

    return router
