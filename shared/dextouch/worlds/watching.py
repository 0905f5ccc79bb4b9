"""Read access to open rollouts for people who watch: a listing, and each one's newest response.

Both read what the rollouts have stored anyway, so a world computes and renders nothing for them.
"""

import asyncio
import hashlib
import time
from typing import Any, Final

from dextouch.errors import NotFoundError
from dextouch.schemas import WatchedRollout, WatchedRollouts
from dextouch.streams import pack, unpack
from dextouch.worlds.records import RecordStore, WatchNote, watch_id_of

_TAG_LETTERS: Final = 32
_MAX_BYTES: Final = 2**30
_NS: Final = 1e-9


class RolloutWatch:
    """The open rollouts of a state store; one newest response is read at a time.

    Args:
        records: of the rollouts, in this process and in all others with the same store.
    """

    def __init__(self, records: RecordStore) -> None:
        self._records = records
        self._reading = asyncio.Lock()

    async def listed(self, limit: int) -> WatchedRollouts:
        """Open rollouts, the newest first."""
        notes, num_open = await self._records.newest_notes(limit)
        found = tuple(_watched(*WatchNote.from_bytes(note)) for note in notes)
        return WatchedRollouts(rollouts=found, num_open=num_open)

    async def newest(self, watch_id: str, known: str = "") -> tuple[str, bytes | None]:
        """The newest response as the rollout's client got it, and a tag of it.

        Its `rollout` is that of the listing. The bytes are None if the tag is `known`.

        Raises:
            NotFoundError: unknown, deleted or expired.
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
            shown = _watched(record.info.model_dump(mode="json"), written_host_ns, record.note)
            rollout = shown.model_dump(mode="json")
            return tag, await asyncio.to_thread(_shown, record.payload, rollout)


def _watched(info: dict[str, Any], written_host_ns: int, note: WatchNote) -> WatchedRollout:
    now_ns = time.time_ns()
    return WatchedRollout(
        watch_id=watch_id_of(info["id"]),
        client=note.client,
        key=note.key,
        age_s=max(0.0, _NS * (now_ns - note.begun_host_ns)),
        idle_s=max(0.0, _NS * (now_ns - written_host_ns)),
        doubt=note.doubt,
        success=note.success,
        trace_id=note.trace_id,
        **{name: info[name] for name in WatchedRollout.model_fields.keys() & info.keys()},
    )


def _shown(payload: bytes, rollout: dict[str, Any]) -> bytes:
    """A response with the id of its rollout left out."""
    fields, arrays = unpack(payload, max_bytes=_MAX_BYTES)
    return pack(fields | {"rollout": rollout}, arrays)
