"""Rollout service: idempotent steps by numbered action chunks, forking, limits and expiry.

The state store is authoritative; the live state in this process only saves a restore. A chunk is
committed when its record replaces the version it was computed from (compare and set).
"""

import asyncio
import hashlib
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any, Final
from weakref import WeakValueDictionary

import numpy as np
import structlog
from jaxtyping import Float64

from dextouch.errors import (
    ConflictError,
    DexTouchError,
    EndedError,
    InvalidInputError,
    LimitExceededError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.schemas import (
    MAX_SEED,
    ReturnSelector,
    RolloutInfo,
    RolloutOrigin,
    RolloutStart,
    WorldDescription,
)
from dextouch.serving import StateStore
from dextouch.streams import pack
from dextouch.tracing import current_trace_id
from dextouch.worlds.batcher import StepJob, WorldWorker
from dextouch.worlds.records import (
    Answer,
    RecordStore,
    RolloutRecord,
    WatchNote,
    ended_error,
    new_rollout_id,
    parts_of,
    selector_bytes,
)
from dextouch.worlds.settings import RolloutLimits
from dextouch.worlds.world import (
    StartedRollout,
    World,
    asked_cameras,
    check_answer,
    check_chunk,
    check_selector,
    check_start,
    first_chunk_s,
)

logger = structlog.get_logger(__name__)

_FLOAT64: Final = np.dtype("<f8")
# Opens the world of this name and digest, or returns None where it is not to be had.
Reopen = Callable[[str, str], World[Any] | None]


class RolloutService:
    """All rollouts of one process; several processes may share one store.

    Bound to one event loop. `close` ends the worlds' threads, not the store.

    Args:
        worlds: by name; new rollouts begin in them.
        store: of the records.
        limits: of this installation.
        reopen: for rollouts that began in a world of another digest; None refuses them.
    """

    def __init__(
        self,
        worlds: Mapping[str, World[Any]],
        store: StateStore,
        limits: RolloutLimits | None = None,
        *,
        reopen: Reopen | None = None,
    ) -> None:
        self.limits = limits or RolloutLimits()
        self.is_draining = False
        self._reopen = reopen
        self._reopened: dict[tuple[str, str], WorldWorker[Any]] = {}
        self._reopening = asyncio.Lock()
        self._workers = {name: WorldWorker(world) for name, world in worlds.items()}
        self._records = RecordStore(store, ttl_s=self.limits.ttl_s)
        # The newest states of this process's rollouts, least recently used first, with their
        # records, of which snapshot and payload are left out, and locks.
        self._live: OrderedDict[str, tuple[RolloutRecord, Any, object]] = OrderedDict()
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        # Of those, the ones that no chunk has renewed since the last sweep.
        self._unused: set[str] = set()
        self._sweeper: asyncio.TimerHandle | None = None

    def worlds(self) -> list[WorldDescription]:
        """Descriptions of the available worlds."""
        return [
            worker.world.description.model_copy(update={"name": name})
            for name, worker in self._workers.items()
        ]

    @property
    def num_live(self) -> int:
        """Rollouts whose state this process holds."""
        return len(self._live)

    def queues(self) -> dict[str, tuple[int, int]]:
        """Chunks that wait and that may wait, by world."""
        return {
            name: (worker.num_waiting, worker.max_waiting) for name, worker in self._workers.items()
        }

    def num_batches(self) -> dict[str, Counter[int]]:
        """How many batches had how many rollouts, by world."""
        reopened = [(name, worker) for (name, _), worker in self._reopened.items()]
        found: dict[str, Counter[int]] = {}
        for name, worker in (*self._workers.items(), *reopened):
            found[name] = found.get(name, Counter()) + worker.num_batches.copy()
        return found

    def drain(self) -> None:
        """Refuse new rollouts from now on."""
        self.is_draining = True

    async def warm_up(self) -> None:
        """Begin a rollout in each world and advance it, so that the first one of a user is fast."""
        for name, worker in self._workers.items():
            try:
                took_s = await worker.call(first_chunk_s, worker.world)
                logger.info("world_warmed_up", world=name, duration_s=round(took_s, 3))
            except DexTouchError as error:
                # Computed it has, and such a start no user may send.
                logger.info("world_warmed_up", world=name, refused=error.message)

    async def start(
        self,
        world: str,
        start: RolloutStart,
        selector: ReturnSelector,
        *,
        owner: str = "",
        client: str = "",
    ) -> Answer:
        """Start a rollout; `owner` is the name of the caller's key, `client` what it is called."""
        self._refuse_while_draining()
        worker = self._worker(world)
        description = worker.world.description
        begin = check_start(start, description)
        check_selector(selector, description)

        def reset() -> tuple[StartedRollout[Any], bytes]:
            started = worker.world.reset(begin)
            return started, worker.world.snapshot(started.state)

        rollout_id = new_rollout_id(owner)
        async with self._place(rollout_id) as placed:
            started, snapshot = await worker.call(reset)
            cameras = asked_cameras(selector, description.cameras)
            optional = set(cameras) & set(description.optional_cameras)
            if absent := sorted(optional - set(started.observation.images)):
                raise InvalidInputError(
                    f"start: got a request for {', '.join(absent)}, whose images are not in the "
                    "start; send them with it, or do not ask for them"
                )
            returned = selector.model_copy(update={"cameras": cameras})
            observation = started.observation.selected(returned)
            check_answer(observation, description, first_step=0, num_steps=1, selector=returned)
            info = RolloutInfo(
                id=rollout_id,
                world=world,
                world_digest=description.digest,
                task=start.task,
                instruction=start.instruction,
                seed=start.seed,
                action_kind=start.action_kind,
                next_chunk=0,
                last_step=0,
                ttl_s=self.limits.ttl_s,
            )
            origin = RolloutOrigin(started.anchor, started.K_head)
            parts = await parts_of(info, observation, selector, origin=origin)
            note = WatchNote(
                client,
                owner,
                time.time_ns(),
                observation.uncertainty,
                observation.success,
                current_trace_id(),
            )
            # No chunk has this response; it is kept for those who watch.
            record = RolloutRecord(info, snapshot, None, pack(*parts), placed, note)
            version = await self._records.write(record, parts[0]["rollout"])
        self._keep(RolloutRecord(info, b"", version=version, note=note), started.state)
        logger.info("rollout_started", rollout_id=info.id, world=world, task=info.task)
        return Answer(record.payload, parts)

    async def get(self, rollout_id: str) -> RolloutInfo:
        """State of a rollout; does not renew its time to live."""
        return (await self._records.read(rollout_id)).info

    async def step(
        self, rollout_id: str, chunk: int, actions: np.ndarray, selector: ReturnSelector
    ) -> Answer:
        """Advance by a numbered chunk, or repeat the response of the newest one.

        Raises:
            NotFoundError: unknown, deleted or expired.
            ConflictError: another chunk number is expected, see `expected`.
            ShapeError, NonFiniteError, InvalidInputError: invalid actions.
            EndedError: the world cannot continue; later chunks get the same error.
            LimitExceededError: the rollout has its maximum length, or the queue is full.
        """
        lock = self._locks.get(rollout_id)
        async with lock or self._locks.setdefault(rollout_id, asyncio.Lock()):
            record = await self._newest(rollout_id, chunk)
            worker = await self._worker_of(record.info)
            description = worker.world.description
            check_selector(selector, description)
            checked = check_chunk(actions, description)
            digest = hashlib.sha256(selector_bytes(selector))
            digest.update(np.ascontiguousarray(checked, dtype=_FLOAT64).data)
            sha256 = digest.hexdigest()
            replayed = record.replay(chunk, sha256)
            if replayed is not None:
                logger.info("chunk_replayed", rollout_id=rollout_id, chunk=chunk)
                return replayed
            if record.info.ended is not None:
                raise ended_error(record.info)
            if record.info.next_chunk >= self.limits.max_chunks:
                raise LimitExceededError(
                    f"rollout {rollout_id}: has {record.info.next_chunk} chunks, expected at most "
                    f"{self.limits.max_chunks}; start a new one"
                )
            try:
                return await self._advance(record, worker, checked, selector, sha256)
            except EndedError as error:
                raise await self._end(record, error) from error
            except ConflictError:
                # Another process was faster: its response is valid if the request was the same.
                replayed = (await self._records.read(rollout_id)).replay(chunk, sha256)
                if replayed is None:
                    raise
                return replayed

    async def fork(
        self, rollout_id: str, *, seed: int | None = None, owner: str = ""
    ) -> RolloutInfo:
        """Branch at the current step: the copy shares the past and continues independently.

        An ended rollout branches before the chunk that ended it. A seed gives the branch its own
        noise.
        """
        self._refuse_while_draining()
        parent = await self._records.read(rollout_id)
        await self._worker_of(parent.info)
        changed: dict[str, object] = {"id": new_rollout_id(owner), "ended": None}
        if seed is not None:
            changed["seed"] = seed
        info = parent.info.model_copy(update=changed)
        async with self._place(info.id) as placed:
            begun_host_ns, trace_id = time.time_ns(), current_trace_id()
            note = parent.note._replace(key=owner, begun_host_ns=begun_host_ns, trace_id=trace_id)
            record = RolloutRecord(info, parent.snapshot, None, parent.payload, placed, note)
            await self._records.write(record)
        logger.info("rollout_forked", rollout_id=info.id, parent_id=rollout_id)
        return info

    async def delete(self, rollout_id: str) -> None:
        """End a rollout."""
        self._live.pop(rollout_id, None)
        await self._records.delete(rollout_id)
        logger.info("rollout_deleted", rollout_id=rollout_id)

    def close(self) -> None:
        """End the worlds' threads; rollouts remain in the store."""
        if self._sweeper is not None:
            self._sweeper.cancel()
        for worker in (*self._workers.values(), *self._reopened.values()):
            worker.close()

    async def _newest(self, rollout_id: str, chunk: int) -> RolloutRecord:
        """The record; without its large parts if the live state is to be advanced."""
        held, _, _ = self._live.get(rollout_id, (None, None, None))
        # Any other chunk is a repetition, which needs the stored response, or a conflict.
        is_next = held is not None and chunk == held.info.next_chunk
        if held is not None and is_next and await self._records.is_newest(held):
            return held
        return await self._records.read(rollout_id)

    async def _advance(
        self,
        stored: RolloutRecord,
        worker: WorldWorker[Any],
        actions: Float64[np.ndarray, "steps 67"],
        selector: ReturnSelector,
        request_sha256: str,
    ) -> Answer:
        """Compute a chunk and commit its record."""
        before = stored.info
        held, state, _ = self._live.get(before.id, (None, None, None))
        if held is None or held.version != stored.version:
            state = await worker.call(worker.world.restore, stored.snapshot)
        seed = chunk_seed(before.seed, before.next_chunk, before.world_digest)
        outcome = await worker.step(StepJob(state, actions, seed, selector))
        seen, num_steps = outcome.stepped.observation, len(actions)
        check_answer(
            seen,
            worker.world.description,
            first_step=before.last_step + 1,
            num_steps=num_steps,
            selector=selector,
        )
        info = before.after(seen.uncertainty, num_steps)
        began_s = time.perf_counter()
        parts = await parts_of(info, seen, selector, info=outcome.stepped.info)
        payload = pack(*parts)
        encoded_s = time.perf_counter() - began_s
        note = stored.note.after(seen)
        record = RolloutRecord(
            info, outcome.snapshot, request_sha256, payload, stored.version, note
        )
        version = await self._records.write(record, parts[0]["rollout"])
        self._keep(RolloutRecord(info, b"", version=version, note=note), outcome.stepped.state)
        stored_s = time.perf_counter() - began_s - encoded_s
        spent_s = {"queue": outcome.queued_s, "device": outcome.device_s, "encode": encoded_s}
        return Answer(payload, parts, spent_s=spent_s | {"store": stored_s})

    async def _end(self, record: RolloutRecord, error: EndedError) -> EndedError:
        """Mark a rollout as ended; returns the error that later chunks get."""
        info = record.info.model_copy(update={"ended": error.reason})
        stored = await self._records.read(info.id)
        await self._records.write(stored._replace(info=info, version=record.version))
        self._live.pop(info.id, None)
        logger.info("rollout_ended", rollout_id=info.id, reason=error.reason)
        return ended_error(info)

    def _keep(self, record: RolloutRecord, state: object) -> None:
        self._live[record.info.id] = (record, state, self._locks.get(record.info.id))
        self._live.move_to_end(record.info.id)
        self._unused.discard(record.info.id)
        if len(self._live) > self.limits.max_rollouts:
            self._live.popitem(last=False)
        if self._sweeper is None:
            self._sweep()

    def _sweep(self) -> None:
        """Drop the states of abandoned rollouts, every `ttl_s` while there are any states."""
        for rollout_id in self._unused:
            self._live.pop(rollout_id, None)
        self._unused = set(self._live)
        loop = asyncio.get_running_loop()
        self._sweeper = loop.call_later(self.limits.ttl_s, self._sweep) if self._live else None

    def _worker(self, world: str) -> WorldWorker[Any]:
        if world not in self._workers:
            raise UnknownNameError("world", world, list(self._workers))
        return self._workers[world]

    def _place(self, rollout_id: str) -> AbstractAsyncContextManager[int]:
        limit, limit_per_key = self.limits.max_rollouts, self.limits.max_rollouts_per_key
        return self._records.place(rollout_id, limit=limit, limit_per_key=limit_per_key)

    def _refuse_while_draining(self) -> None:
        if self.is_draining:
            raise UnavailableError(
                "the service is about to end and begins no rollouts; try again", retry_after_s=1
            )

    async def _worker_of(self, info: RolloutInfo) -> WorldWorker[Any]:
        """The world that a rollout began in, reopened if this process serves another one."""
        worker = self._worker(info.world)
        digest = worker.world.description.digest
        if digest == info.world_digest:
            return worker
        began = (info.world, info.world_digest)
        async with self._reopening:
            if began not in self._reopened and self._reopen is not None:
                world = await asyncio.to_thread(self._reopen, *began)
                if world is not None:
                    self._reopened[began] = WorldWorker(world)
                    logger.info("world_reopened", world=info.world, digest=info.world_digest)
        if began not in self._reopened:
            raise ConflictError(
                f"rollout {info.id}: began in world {info.world} of digest "
                f"{info.world_digest[:12]}, this process has {digest[:12]}; start a new rollout",
                expected=info.world_digest,
                got=digest,
            )
        return self._reopened[began]


def chunk_seed(rollout_seed: int, chunk: int, world_digest: str) -> int:
    """Deterministic seed of a chunk's noise, independent of process and batching."""
    text = f"{rollout_seed}/{chunk}/{world_digest}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:8], "big") & MAX_SEED
