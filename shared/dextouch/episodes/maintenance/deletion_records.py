"""Records of permanent deletions, by which a store recognises the takes that stations still hold.

A record names no operator: of the pseudonym and of each take it holds a salted hash, besides the id
of the take for people. Deletions write `.deleted/records`, the service `.deleted/stations`: which
records a station has worked off, and which of their takes it could not remove yet.
"""

import hashlib
import os
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeVar

from pydantic import AwareDatetime, BaseModel, Field, ValidationError

from dextouch.episodes.files import disk_errors, replace_file, write_file
from dextouch.episodes.format import sha256_hex
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import OutstandingTakes, RecordingAttributes

M = TypeVar("M", bound=BaseModel)

FOLDER: Final = ".deleted"
_SALT_BYTES: Final = 32
# Of scrypt: 16 MiB and about 50 ms a guess, since pseudonyms are short (RFC 7914, section 2).
_SCRYPT_COST: Final = 2**14


@dataclass(frozen=True)
class TakeFacts:
    """By what a take is recognised; of a damaged one ids alone are known.

    `started` is its `take_start`.
    """

    recording_id: str
    station: str
    started: str
    operator: str | None = None
    started_at: datetime | None = None
    is_damaged: bool = False

    @classmethod
    def of(cls, about: RecordingAttributes) -> "TakeFacts":
        """Those of a recording."""
        return cls(
            recording_id=about.recording_id,
            station=about.station,
            started=take_start(about.started_at, about.started_t_host_ns),
            operator=about.operator,
            started_at=about.started_at,
        )


class DeletedTake(FrozenModel):
    """A deleted recording: its id and station for people, its fingerprint for comparison."""

    id: str
    station: str
    fingerprint: str


class DeletionRecord(FrozenModel):
    """A deletion; `operator_digest` is None of a recording, and of one who may record again."""

    record_version: Literal[1] = 1
    deleted_at: AwareDatetime
    operator_digest: str | None = None
    takes: tuple[DeletedTake, ...] = ()


class StationState(FrozenModel):
    """What a station has confirmed: of each record its time, and the takes that it still holds."""

    station: str
    confirmed: dict[str, AwareDatetime] = Field(default={})
    held: dict[str, tuple[str, ...]] = Field(default={})


@dataclass(frozen=True)
class Covered:
    """A take that a deletion covers; `is_later` if it began after the operator was deleted."""

    key: str
    deleted_at: datetime
    is_later: bool


def take_start(started_at: datetime | str | None, started_t_host_ns: int | None) -> str:
    """When a take began, in one form for text and parsed times."""
    if isinstance(started_at, str):
        with suppress(ValueError):
            started_at = datetime.fromisoformat(started_at)
    if isinstance(started_at, datetime):
        # Near the ends of the calendar a time may have no date in UTC.
        with suppress(OverflowError):
            started_at = started_at.astimezone(UTC)
        started_at = started_at.isoformat()
    return f"{started_at}/{started_t_host_ns}"


class DeletionRecords:
    """The deletions that a store remembers, read anew whenever a file has changed. Thread-safe."""

    def __init__(self, root: Path) -> None:
        self._folder = root / FOLDER
        self._salt = b""

    def read(self) -> Mapping[str, DeletionRecord]:
        """All records by key, oldest first; raises CorruptDataError for a damaged one."""
        found = {path.stem: _record(path, at) for path, at in _stamps(self._folder / "records")}
        return dict(sorted(found.items(), key=lambda item: item[1].deleted_at))

    @property
    def revision(self) -> str:
        """Changes with every deletion."""
        times = [f"{key} {record.deleted_at.isoformat()}" for key, record in self.read().items()]
        return sha256_hex("\n".join(times).encode())[:32]

    def key_of(self, *, operator: str | None, recording: str | None = None) -> str:
        """The key of the record of an operator or a recording."""
        if operator is not None:
            return _operator_digest(self._make_salt(), operator)[:32]
        return sha256_hex(f"recording {recording}".encode())[:32]

    def add(self, key: str, takes: Sequence[TakeFacts], *, operator: str | None) -> DeletionRecord:
        """Remember a deletion until now, in addition to what the record of this key has."""
        with disk_errors("remember the deletion"):
            (self._folder / "records").mkdir(parents=True, exist_ok=True)
            (self._folder / "stations").mkdir(exist_ok=True)
            salt = self._make_salt()
            deleted = {
                DeletedTake(
                    id=_shown(take, operator, salt),
                    station=take.station,
                    fingerprint=_fingerprint(salt, take),
                )
                for take in takes
            }
            known = self.read().get(key)
            deleted |= set(known.takes if known else ())
            record = DeletionRecord(
                deleted_at=datetime.now(UTC),
                operator_digest=operator and _operator_digest(salt, operator),
                takes=tuple(sorted(deleted, key=lambda take: (take.station, take.id))),
            )
            path = self._folder / "records" / f"{key}.json"
            replace_file(path, record.model_dump_json(indent=1).encode())
        return record

    def readmit(self, operator: str) -> int:
        """Let a deleted operator record again; returns the number of records that were changed."""
        digest, num_changed = _operator_digest(self._make_salt(), operator), 0
        for key, record in self.read().items():
            if record.operator_digest == digest:
                changed = record.model_copy(update={"operator_digest": None})
                path = self._folder / "records" / f"{key}.json"
                with disk_errors("readmit the operator"):
                    replace_file(path, changed.model_dump_json(indent=1).encode())
                num_changed += 1
        return num_changed

    def has_operator(self, operator: str) -> bool:
        """Whether an operator was deleted, and not readmitted."""
        digests = {record.operator_digest for record in self.read().values()} - {None}
        return bool(digests) and _operator_digest(self._make_salt(), operator) in digests

    def find(self, take: TakeFacts) -> Covered | None:
        """The deletion that covers a take; None where there is none."""
        records = self.read()
        if not records:
            return None
        salt = self._make_salt()
        fingerprint, later = _fingerprint(salt, take), None
        for key, record in records.items():
            covered = Covered(key, record.deleted_at, is_later=False)
            if any(_is_same(take, fingerprint, known) for known in record.takes):
                return covered
            if take.operator is None or record.operator_digest is None:
                continue
            if record.operator_digest == _operator_digest(salt, take.operator):
                if take.started_at is None or take.started_at <= record.deleted_at:
                    return covered
                later = Covered(key, record.deleted_at, is_later=True)
        return later

    def confirm(self, station: str, *, revision: str, held: Mapping[str, Sequence[str]]) -> None:
        """Note that a station holds no covered takes any more, except those in `held` by record.

        Raises ConflictError after a deletion later than `revision`, InvalidInputError for an
        unknown record in `held`.
        """
        records = self.read()
        if revision != self.revision:
            raise ConflictError(
                f"station {station!r}: there was another deletion meanwhile; check the spool again",
                reason="stale_revision",
            )
        if unknown := set(held) - set(records):
            raise InvalidInputError(f"station {station!r}: got the deletions {sorted(unknown)}")
        state = StationState(
            station=station,
            confirmed={key: record.deleted_at for key, record in records.items()},
            held={key: tuple(sorted(ids)) for key, ids in held.items() if ids},
        )
        path = self._folder / "stations" / f"{sha256_hex(station.encode())[:32]}.json"
        with disk_errors(f"note what station {station!r} confirmed"):
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.is_file() or _read(path, StationState) != state:
                replace_file(path, state.model_dump_json(indent=1).encode())

    def outstanding(self, key: str) -> tuple[OutstandingTakes, ...]:
        """What stations still have to remove of a deletion, by station."""
        record = self.read().get(key)
        if record is None:
            return ()
        paths = [path for path, _ in _stamps(self._folder / "stations")]
        states = {state.station: state for state in (_read(path, StationState) for path in paths)}
        found = []
        names = {take.station for take in record.takes}
        # Any station may hold takes of an operator that it never uploaded.
        names |= set(states) if record.operator_digest else set()
        for station in sorted(names):
            state = states.get(station)
            if state is not None and state.confirmed.get(key) == record.deleted_at:
                if ids := state.held.get(key, ()):
                    found.append(
                        OutstandingTakes(station=station, recordings=ids, has_answered=True)
                    )
                continue
            ids = tuple(take.id for take in record.takes if take.station == station)
            found.append(OutstandingTakes(station=station, recordings=ids, has_answered=False))
        return tuple(found)

    def _make_salt(self) -> bytes:
        """The store's salt, made at its first deletion."""
        if self._salt:
            return self._salt
        path = self._folder / "salt"
        with disk_errors(f"read {path}"):
            if not path.is_file():
                path.parent.mkdir(parents=True, exist_ok=True)
                fresh = path.with_name(f"salt.{secrets.token_hex(8)}")
                write_file(fresh, secrets.token_bytes(_SALT_BYTES))
                # Two deletions at once: the first salt stays.
                with suppress(FileExistsError):
                    os.link(fresh, path)
                fresh.unlink()
            self._salt = path.read_bytes()
        return self._salt


def _stamps(folder: Path) -> list[tuple[Path, tuple[int, int, int]]]:
    found = []
    with disk_errors(f"list {folder}"), suppress(FileNotFoundError):
        for entry in os.scandir(folder):
            if entry.name.endswith(".json"):
                stat = entry.stat()
                # Files are replaced, so that a change has another inode.
                stamp = (stat.st_ino, stat.st_mtime_ns, stat.st_size)
                found.append((Path(entry.path), stamp))
    return found


def _read(path: Path, model: type[M]) -> M:
    with disk_errors(f"read {path}"):
        data = path.read_bytes()
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        raise CorruptDataError(
            f"deletions: {path} is damaged ({error}); restore it from a backup: without it takes "
            "of deleted operators could be uploaded again"
        ) from error


# Many more than a store has deletions.
@lru_cache(maxsize=4096)
def _record(path: Path, _stamp: tuple[int, int, int]) -> DeletionRecord:
    return _read(path, DeletionRecord)


def _fingerprint(salt: bytes, take: TakeFacts) -> str:
    facts = repr((take.recording_id, take.station, take.started))
    return hashlib.sha256(salt + facts.encode()).hexdigest()


def _is_same(take: TakeFacts, fingerprint: str, known: DeletedTake) -> bool:
    if take.is_damaged:
        return (take.recording_id, take.station) == (known.id, known.station)
    return fingerprint == known.fingerprint


def _shown(take: TakeFacts, operator: str | None, salt: bytes) -> str:
    """The id of a take, unless it contains the operator's name."""
    if operator is None or operator.casefold() not in take.recording_id.casefold():
        return take.recording_id
    return f"(named after the operator) {_fingerprint(salt, take)[:12]}"


@lru_cache(maxsize=1024)
def _operator_digest(salt: bytes, operator: str) -> str:
    digest = hashlib.scrypt(operator.encode(), salt=salt, n=_SCRYPT_COST, r=8, p=1)
    return digest.hex()
