"""Worker thread of a world that batches the pending steps of several rollouts."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float64

from dextouch.errors import LimitExceededError, UnavailableError
from dextouch.schemas import EVERYTHING, ReturnSelector
from dextouch.worlds.world import BatchWorld, State, SteppedRollout, World

ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class StepOutcome(Generic[State]):
    """Result of a step, its serialized state, and timings."""

    stepped: SteppedRollout[State]
    snapshot: bytes
    queued_s: float
    device_s: float


@dataclass(frozen=True, eq=False)
class StepJob(Generic[State]):
    """One rollout's next chunk, and what of its observation is wanted; made in the event loop."""

    state: State
    actions: Float64[np.ndarray, "steps 67"]
    seed: int
    selector: ReturnSelector = EVERYTHING
    since_s: float = field(default_factory=time.perf_counter, init=False)
    outcome: "asyncio.Future[StepOutcome[State]]" = field(
        default_factory=lambda: asyncio.get_running_loop().create_future(), init=False
    )


class WorldWorker(Generic[State]):
    """One world, one thread, one queue.

    A world with `step_batch` gets all pending chunks of one length at once, without waiting for
    more; other worlds get them one by one. Bound to the event loop that first uses it.
    """

    def __init__(self, world: World[State], *, max_waiting: int = 256, max_batch: int = 32) -> None:
        self.world = world
        self._max_waiting = max_waiting
        self._max_batch = max_batch if isinstance(world, BatchWorld) else 1
        self._waiting: deque[StepJob[State]] = deque()
        self._drain: asyncio.Task[None] | None = None
        self._executor = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix=f"world-{world.description.name}"
        )

    async def call(self, function: Callable[..., ResultT], *arguments: Any) -> ResultT:  # noqa: ANN401
        """Run a function in the world's thread."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._executor, function, *arguments)

    async def step(self, job: StepJob[State]) -> StepOutcome[State]:
        """Advance one rollout; raises LimitExceededError where the queue is full."""
        if len(self._waiting) >= self._max_waiting:
            raise LimitExceededError(
                f"world {self.world.description.name}: {len(self._waiting)} chunks are pending, "
                f"expected at most {self._max_waiting}; try again",
                retry_after_s=1,
            )
        self._waiting.append(job)
        if self._drain is None or self._drain.done():
            self._drain = asyncio.create_task(self._run_waiting())
        return await job.outcome

    def close(self) -> None:
        """Finish the running step and reject pending ones."""
        if self._drain is not None:
            self._drain.cancel()
        while self._waiting:
            _fail(self._waiting.popleft(), UnavailableError("the service is shutting down"))
        self._executor.shutdown(wait=True, cancel_futures=True)

    async def _run_waiting(self) -> None:
        while self._waiting:
            await self._run(self._take_batch())

    def _take_batch(self) -> list[StepJob[State]]:
        """The oldest pending chunk and, up to the limit, others of its length."""
        num_steps = len(self._waiting[0].actions)
        fitting = [job for job in self._waiting if len(job.actions) == num_steps]
        batch = fitting[: self._max_batch]
        self._waiting = deque(job for job in self._waiting if job not in batch)
        return batch

    async def _run(self, batch: Sequence[StepJob[State]]) -> None:
        (result,) = await asyncio.gather(self.call(self._step_all, batch), return_exceptions=True)
        if not isinstance(result, BaseException):
            began_s, device_s, steps = result
            for job, (stepped, snapshot) in zip(batch, steps, strict=True):
                if not job.outcome.done():
                    queued_s = began_s - job.since_s
                    job.outcome.set_result(StepOutcome(stepped, snapshot, queued_s, device_s))
        elif len(batch) == 1:
            _fail(batch[0], result)
        else:
            # One by one, so that only the faulty rollout fails.
            for job in batch:
                await self._run([job])

    def _step_all(
        self, jobs: Sequence[StepJob[State]]
    ) -> tuple[float, float, list[tuple[SteppedRollout[State], bytes]]]:
        """Runs in the world's thread; returns start time, duration, steps and snapshots."""
        began_s = time.perf_counter()
        if isinstance(self.world, BatchWorld) and len(jobs) > 1:
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
