"""Persistent record of a rollout and the responses of its service.

A record holds the progress, the world's snapshot, and the newest response.
"""

import asyncio
import hashlib
import secrets
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np

from dextouch.errors import (
    ConflictError,
    EndedError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import (
    Observation,
    ReturnSelector,
    RolloutInfo,
    Uncertainty,
    WatchedRollout,
    WatchedRollouts,
    answer_parts,
)
from dextouch.serving import StateStore, Versioned
from dextouch.streams import pack, unpack

# The group of all rollouts in the state store, and the beginning of their keys.
GROUP = "rollout:"
RECORD_FORMAT = 3
# Time that a start may wait for others and for its world; after a crash its slot is held that long.
PLACE_TTL_S = 600.0
# Of an id, the beginning that all rollouts of one API key share.
OWNER_LETTERS = 8
ID_LETTERS: Final = 32
# Notes of the rollouts that were ended last, how many are kept, and for how long.
OVER_KEY: Final = "rollouts over"
NUM_OVER: Final = 10
OVER_TTL_S: Final = 86_400.0
# Chosen: as many as end at once when a study stops; after that a rollout is not listed.
MAX_TRIES: Final = 32
# More images are encoded as JPEG beside the event loop; JPEG takes some 15 ms for a megabyte.
MAX_INLINE_IMAGE_BYTES: Final = 2**16

AnswerParts = tuple[dict[str, Any], dict[str, np.ndarray]]


class WatchNote(NamedTuple):
    """What those who watch a rollout see beside its progress (see `WatchedRollout`)."""

    client: str = ""
    key: str = ""
    begun_host_ns: int = 0
    uncertainty: Uncertainty | None = None
    success: bool | None = None
    trace_id: str | None = None

    def after(self, seen: Observation) -> "WatchNote":
        """The note once this has been observed."""
        return WatchNote(*self[:3], seen.uncertainty, seen.success, self.trace_id)

    def to_bytes(self, info: Mapping[str, Any]) -> bytes:
        """Serialize the note with the progress of its rollout and the time of this write."""
        uncertainty = None if self.uncertainty is None else self.uncertainty.model_dump()
        known = (*self[:3], uncertainty, *self[4:])
        return msgpack.packb((info, time.time_ns(), known))

    @staticmethod
    def from_bytes(note: bytes) -> "tuple[dict[str, Any], int, WatchNote]":
        """Progress, time of the write on the host clock (ns), and the note."""
        info, written_host_ns, known = msgpack.unpackb(note)
        client, key, begun_host_ns, uncertainty, success, trace_id = known
        unreliable = None if uncertainty is None else Uncertainty.model_validate(uncertainty)
        restored = WatchNote(client, key, begun_host_ns, unreliable, success, trace_id)
        return info, written_host_ns, restored


class RolloutRecord(NamedTuple):
    """Everything that another process needs to continue a rollout.

    `request_sha256` and `payload` are request and response of the newest chunk, for a client that
    missed the response; None and empty before the first chunk. `version` is that of the store from
    which the record was read or computed. Version, payload and note are not part of the bytes.
    """

    info: RolloutInfo
    snapshot: bytes
    request_sha256: str | None = None
    payload: bytes = b""
    version: int = 0
    note: WatchNote = WatchNote()

    def to_bytes(self, info: Mapping[str, Any]) -> bytes:
        """Serialize the record with its info as JSON, except the payload, stored as it is."""
        fields = (RECORD_FORMAT, info, self.request_sha256, len(self.payload), self.snapshot)
        return msgpack.packb(fields)

    def replay(self, chunk: int, request_sha256: str) -> "Answer | None":
        """The stored response if the request is a repetition; None if the chunk is the next one.

        Raises ConflictError for another chunk, or the newest one with another body.
        """
        info = self.info
        if chunk == info.next_chunk:
            return None
        is_newest = chunk == info.next_chunk - 1
        if is_newest and self.request_sha256 == request_sha256:
            return Answer(self.payload, replayed=True)
        why = "again with another body" if is_newest else "out of turn"
        raise ConflictError(
            f"rollout {info.id}: got chunk {chunk} {why}, expected chunk {info.next_chunk}",
            expected=info.next_chunk,
            got=chunk,
        )

    @staticmethod
    def from_stored(stored: Versioned) -> "RolloutRecord":
        """The record that a store holds.

        Raises StorageError if it is not the whole record, or one of another version of DexTouch.
        """
        fields = msgpack.unpackb(stored.value)
        if not isinstance(fields, list) or fields[0] != RECORD_FORMAT:
            raise StorageError(
                "rollout: it was stored by another version of DexTouch; start a new one"
            )
        info, sha256, num_bytes, snapshot = fields[1:]
        if num_bytes != len(stored.tail):
            raise StorageError(
                f"rollout {info['id']}: got {len(stored.tail)} bytes of its newest response, "
                f"expected {num_bytes}; start a new one"
            )
        note = WatchNote.from_bytes(stored.note)[2]
        rollout = RolloutInfo.model_validate(info)
        return RolloutRecord(rollout, snapshot, sha256, stored.tail, stored.version, note)


def new_rollout_id(owner: str) -> str:
    """An id that cannot be guessed, for a rollout begun with the key of this name."""
    of_owner = hashlib.sha256(owner.encode()).hexdigest()[:OWNER_LETTERS]
    return of_owner + secrets.token_hex((ID_LETTERS - OWNER_LETTERS) // 2)


@lru_cache(maxsize=4096)
def watch_id_of(rollout_id: str) -> str:
    """Name of a rollout for those who watch; it gives nobody the rollout's id.

    Records are stored under it, so that both ids find them.
    """
    name = hashlib.sha256(f"watch {rollout_id}".encode()).hexdigest()
    return rollout_id[:OWNER_LETTERS] + name[: ID_LETTERS - OWNER_LETTERS]


def _key_of(rollout_id: str) -> str:
    return GROUP + watch_id_of(rollout_id)


class RecordStore:
    """Rollout records in a state store; every write renews their time to live."""

    def __init__(self, store: StateStore, *, ttl_s: float) -> None:
        self._store = store
        self._ttl_s = ttl_s

    async def read(self, rollout_id: str) -> RolloutRecord:
        """The newest record; raises NotFoundError where unknown, deleted or expired."""
        stored = await self._store.get(_key_of(rollout_id))
        # Without a value while it is only placed.
        if stored is None or not stored.value:
            raise _unknown(rollout_id)
        return RolloutRecord.from_stored(stored)

    async def is_newest(self, record: RolloutRecord) -> bool:
        """Whether nobody has written since, without reading what is stored."""
        return await self._store.version(_key_of(record.info.id)) == record.version

    @asynccontextmanager
    async def place(
        self, rollout_id: str, *, limit: int, limit_per_key: int | None
    ) -> AsyncIterator[int]:
        """Reserve a slot, unless the block fails; yields the version to compute the record from.

        Ids of rollouts that were begun with one key start with the same `OWNER_LETTERS` letters.
        """
        key, ttl_s = _key_of(rollout_id), max(self._ttl_s, PLACE_TTL_S)
        limits, per_key = {GROUP: limit}, ""
        if limit_per_key is not None:
            limits[GROUP + rollout_id[:OWNER_LETTERS]] = limit_per_key
            per_key = f", or of {limit_per_key} of one key,"
        async with AsyncExitStack() as failed:
            # Also where the reply is lost although the slot was written.
            failed.push_async_callback(self._give_up, key)
            if not await self._store.add(key, b"", limits=limits, ttl_s=ttl_s):
                raise LimitExceededError(
                    f"the limit of {limit} rollouts{per_key} is reached; delete one that is no "
                    f"longer needed, or try again later: each expires after {self._ttl_s:g} s "
                    "without a chunk",
                    retry_after_s=1,
                )
            yield 1
            failed.pop_all()

    async def _give_up(self, key: str) -> None:
        """Delete a rollout that no client knows; if that fails, it expires."""
        with suppress(StorageError, UnavailableError):
            await self._store.delete(key)

    async def write(self, record: RolloutRecord, info: Mapping[str, Any] | None = None) -> int:
        """Replace the version that the record was computed from, and return the new one.

        `info` is the record's as JSON, where the caller has it.
        """
        info = info or record.info.model_dump(mode="json")
        return await self._store.set(
            _key_of(record.info.id),
            record.to_bytes(info),
            tail=record.payload,
            note=record.note.to_bytes(info),
            expected_version=record.version,
            ttl_s=self._ttl_s,
        )

    async def newest_notes(self, limit: int) -> tuple[list[bytes], int]:
        """Notes of the rollouts that began last, the newest first, and the number of all."""
        return await self._store.newest_notes(GROUP, limit)

    async def note(self, watch_id: str) -> bytes:
        """Note of the rollout that watchers know by this name; empty if there is none."""
        return await self._store.note(GROUP + watch_id)

    async def delete(self, rollout_id: str) -> None:
        """Forget a rollout but its note; raises NotFoundError where unknown, deleted or expired."""
        note = await self._store.note(_key_of(rollout_id))
        if not await self._store.delete(_key_of(rollout_id)):
            raise _unknown(rollout_id)
        if note:
            with suppress(StorageError, UnavailableError):
                await self._keep_ended(note)

    async def _keep_ended(self, note: bytes) -> None:
        for _ in range(MAX_TRIES):
            stored = await self._store.get(OVER_KEY)
            kept = [] if stored is None else msgpack.unpackb(stored.value)
            # Of several that end at once, one is written; the others try again.
            with suppress(ConflictError):
                await self._store.set(
                    OVER_KEY,
                    msgpack.packb([note, *kept][:NUM_OVER]),
                    expected_version=0 if stored is None else stored.version,
                    ttl_s=OVER_TTL_S,
                )
                return

    async def notes_of_ended(self) -> list[bytes]:
        """Notes of the rollouts that were deleted last, the newest first."""
        stored = await self._store.get(OVER_KEY)
        return [] if stored is None else msgpack.unpackb(stored.value)


def _unknown(rollout_id: str) -> NotFoundError:
    return NotFoundError(
        f"rollout {rollout_id!r}: unknown, deleted or expired; start a new one", got=rollout_id
    )


def ended_error(info: RolloutInfo) -> EndedError:
    """What a chunk of a rollout that has ended is refused with."""
    last_chunk = info.next_chunk - 1 if info.next_chunk else None
    return EndedError(
        f"rollout {info.id}: has ended: {info.ended}; its last good chunk is "
        f"{'none' if last_chunk is None else last_chunk} and its last good step {info.last_step}; "
        "start a new one, or branch from there with other actions",
        reason=str(info.ended),
        last_chunk=last_chunk,
        last_step=info.last_step,
    )


class Answer(NamedTuple):
    """An encoded response; `replayed` if it was computed for an earlier, equal request.

    `parts` are its fields and arrays; None where only the bytes are known. `spent_s` are the times
    in queue, device, encoder and store; empty where nothing was computed.
    """

    payload: bytes
    parts: AnswerParts | None = None
    replayed: bool = False
    spent_s: Mapping[str, float] = MappingProxyType({})


async def parts_of(
    rollout: RolloutInfo,
    seen: Observation,
    selector: ReturnSelector,
    **options: Any,  # noqa: ANN401 - see answer_parts
) -> AnswerParts:
    """Fields and arrays of a response, from a thread where encoding the images takes long."""
    sizes = (images.nbytes for images in seen.images.values())
    if selector.images == "raw" or sum(sizes) <= MAX_INLINE_IMAGE_BYTES:
        return answer_parts(rollout, seen, selector=selector, **options)
    return await asyncio.to_thread(answer_parts, rollout, seen, selector=selector, **options)


@lru_cache(maxsize=64)
def selector_bytes(selector: ReturnSelector) -> bytes:
    """A selector as it enters the hash of a request."""
    return selector.model_dump_json().encode()


_TAG_LETTERS: Final = 32  # 128 bits: no two are alike
_MAX_BYTES: Final = 2**30  # chosen: more than any response
_NS: Final = 1e-9


class RolloutWatch:
    """The open rollouts of all processes with one state store, for people who watch.

    It reads what they have stored anyway, so a world computes and renders nothing for it; one
    response is read at a time.
    """

    def __init__(self, records: RecordStore) -> None:
        self._records = records
        self._reading = asyncio.Lock()

    async def listed(self, limit: int) -> WatchedRollouts:
        """Open rollouts, the newest first, and those that ended last."""
        notes, num_open = await self._records.newest_notes(limit)
        found, over = (
            tuple(_watched(*WatchNote.from_bytes(note)) for note in some)
            for some in (notes, await self._records.notes_of_ended())
        )
        return WatchedRollouts(rollouts=found, num_open=num_open, over=over)

    async def newest(self, watch_id: str, known: str = "") -> tuple[str, bytes | None]:
        """The newest response as the rollout's client got it, and a tag of it.

        Its `rollout` is that of the listing. The bytes are None if the tag is `known`. Raises
        NotFoundError for a rollout that is unknown, deleted or expired.
        """
        note = await self._records.note(watch_id)
        if not note:
            raise NotFoundError(
                f"watched rollout {watch_id!r}: unknown, deleted or expired; list the open ones "
                "again",
                got=watch_id,
            )
        # Time and progress of the newest write, which differ for every two of them.
        tag = hashlib.sha256(note).hexdigest()[:_TAG_LETTERS]
        if tag == known:
            return tag, None
        async with self._reading:
            info, written_host_ns, _ = WatchNote.from_bytes(note)
            record = await self._records.read(info["id"])
            if not record.payload:
                raise NotFoundError(
                    f"watched rollout {watch_id!r}: has no response yet; wait for its next chunk",
                    got=watch_id,
                )
            watched = _watched(record.info.model_dump(mode="json"), written_host_ns, record.note)
            rollout = watched.model_dump(mode="json")
            return tag, await asyncio.to_thread(_shown, record.payload, rollout)


def _watched(info: dict[str, Any], written_host_ns: int, note: WatchNote) -> WatchedRollout:
    now_ns = time.time_ns()
    names = {field.alias or name for name, field in WatchedRollout.model_fields.items()}
    return WatchedRollout(
        watch_id=watch_id_of(info["id"]),
        client=note.client,
        key=note.key,
        age_s=max(0.0, _NS * (now_ns - note.begun_host_ns)),
        idle_s=max(0.0, _NS * (now_ns - written_host_ns)),
        doubt=note.uncertainty,
        success=note.success,
        trace_id=note.trace_id,
        **{name: info[name] for name in names & info.keys()},
    )


def _shown(payload: bytes, rollout: dict[str, Any]) -> bytes:
    fields, arrays = unpack(payload, max_bytes=_MAX_BYTES)
    return pack(fields | {"rollout": rollout}, arrays)
