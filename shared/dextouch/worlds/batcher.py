"""Worker thread of a world that batches the pending steps of several rollouts."""

import asyncio
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64

from dextouch.errors import LimitExceededError, UnavailableError
from dextouch.schemas import EVERYTHING, ReturnSelector
from dextouch.worlds.world import BatchWorld, State, SteppedRollout, World

ResultT = TypeVar("ResultT")
# Start time and duration of a batch, and of each entry the step and its snapshot.
SteppedBatch = tuple[float, float, list[tuple[SteppedRollout[State], bytes]]]


class StepOutcome(NamedTuple, Generic[State]):
    """Result of a step, its serialized state, and timings."""

    stepped: SteppedRollout[State]
    snapshot: bytes
    queued_s: float
    device_s: float


@dataclass(eq=False)
class StepJob(Generic[State]):
    """One rollout's next chunk, and what of its observation is wanted; only a queued one waits."""

    state: State
    actions: Float64[np.ndarray, "steps 67"]
    seed: int
    selector: ReturnSelector = EVERYTHING
    since_s: float = field(default_factory=time.perf_counter, init=False)
    outcome: "asyncio.Future[StepOutcome[State]]" = field(init=False)


class WorldWorker(Generic[State]):
    """One world, one thread, one queue; a quick world needs neither thread nor queue.

    A world with `step_batch` gets all pending chunks of one length at once, without waiting for
    more; other worlds get them one by one. Bound to the event loop that first uses it.
    """

    def __init__(
        self,
        world: World[State],
        *,
        max_waiting: int = 256,
        max_batch: int = 32,
    ) -> None:
        self.world = world
        # How many batches had this many rollouts.
        self.num_batches: Counter[int] = Counter()
        self.max_waiting = max_waiting
        self._max_batch = max_batch if isinstance(world, BatchWorld) else 1
        self._waiting: deque[StepJob[State]] = deque()
        # Of a failed batch; they run one by one, so that only the faulty rollout fails.
        self._apart: deque[StepJob[State]] = deque()
        self._is_stepping = False
        self._is_quick = bool(getattr(world, "is_quick", False))
        self._executor = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix=f"world-{world.description.name}"
        )

    @property
    def num_waiting(self) -> int:
        """Chunks that wait for the world."""
        return len(self._waiting) + len(self._apart)

    async def call(self, function: Callable[..., ResultT], *arguments: Any) -> ResultT:  # noqa: ANN401
        """Run a function in the world's thread, or here if the world is quick."""
        if self._is_quick:
            return function(*arguments)
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._executor, function, *arguments)

    async def step(self, job: StepJob[State]) -> StepOutcome[State]:
        """Advance one rollout; raises LimitExceededError where the queue is full."""
        if self._is_quick:
            began_s, device_s, ((stepped, snapshot),) = self._step_all([job])
            return StepOutcome(stepped, snapshot, began_s - job.since_s, device_s)
        if len(self._waiting) >= self.max_waiting:
            raise LimitExceededError(
                f"world {self.world.description.name}: {len(self._waiting)} chunks are pending, "
                f"expected at most {self.max_waiting}; try again",
                retry_after_s=1,
            )
        job.outcome = asyncio.get_running_loop().create_future()
        self._waiting.append(job)
        if not self._is_stepping:
            self._step_next()
        return await job.outcome

    def close(self) -> None:
        """Finish the running step and reject pending ones."""
        for jobs in (self._apart, self._waiting):
            while jobs:
                _fail(jobs.popleft(), _shutting_down())
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _step_next(self) -> None:
        batch = [self._apart.popleft()] if self._apart else self._take_batch()
        self._is_stepping = True
        loop = asyncio.get_running_loop()
        running = self._executor.submit(self._step_all, batch)
        running.add_done_callback(lambda ran: loop.call_soon_threadsafe(self._stepped, batch, ran))

    def _take_batch(self) -> list[StepJob[State]]:
        """The oldest pending chunk and, up to the limit, others of its length."""
        num_steps = len(self._waiting[0].actions)
        fitting = [job for job in self._waiting if len(job.actions) == num_steps]
        batch = fitting[: self._max_batch]
        self._waiting = deque(job for job in self._waiting if job not in batch)
        return batch

    def _stepped(self, batch: Sequence[StepJob[State]], ran: "Future[SteppedBatch[State]]") -> None:
        """Answer those of a batch, in the event loop."""
        self._is_stepping = False
        error = _shutting_down() if ran.cancelled() else ran.exception()
        if error is None:
            began_s, device_s, steps = ran.result()
            for job, (stepped, snapshot) in zip(batch, steps, strict=True):
                if not job.outcome.done():
                    queued_s = began_s - job.since_s
                    job.outcome.set_result(StepOutcome(stepped, snapshot, queued_s, device_s))
        elif len(batch) == 1:
            _fail(batch[0], error)
        else:
            self._apart.extend(batch)
        if self._apart or self._waiting:
            self._step_next()

    def _step_all(self, jobs: Sequence[StepJob[State]]) -> SteppedBatch[State]:
        """Runs in the world's thread; returns start time, duration, steps and snapshots."""
        began_s = time.perf_counter()
        self.num_batches[len(jobs)] += 1
        # The test of a protocol takes longer than a step may.
        if len(jobs) > 1 and isinstance(self.world, BatchWorld):
            stepped = self.world.step_batch(
                [job.state for job in jobs],
                np.stack([job.actions for job in jobs]),
                seeds=[job.seed for job in jobs],
                selectors=[job.selector for job in jobs],
            )
        else:
            stepped = [
                self.world.step(job.state, job.actions, seed=job.seed, selector=job.selector)
                for job in jobs
            ]
        results = [(one, self.world.snapshot(one.state)) for one in stepped]
        return began_s, time.perf_counter() - began_s, results


def _fail(job: StepJob[Any], error: BaseException) -> None:
    if not job.outcome.done():
        job.outcome.set_exception(error)


def _shutting_down() -> UnavailableError:
    return UnavailableError("the service is shutting down")
