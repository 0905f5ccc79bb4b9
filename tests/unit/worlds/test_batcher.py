"""The worker of a world: greedy batches, failures that stay with who caused them, one thread."""

import asyncio
import threading
from dataclasses import replace

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, LimitExceededError, UnavailableError
from dextouch.schemas import EVERYTHING, ReturnSelector
from dextouch.worlds import CopyFirstWorld
from dextouch.worlds.batcher import StepJob, WorldWorker
from tests.unit.worlds.fakes import BatchSumWorld, SumState, SumWorld, actions


class GatedMixin:
    """Lets a test hold the world's thread until it says go."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = threading.Event()
        self.entered = threading.Event()
        self.threads: set[int] = set()

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        self.threads.add(threading.get_ident())
        self.entered.set()
        assert self.gate.wait(20)
        return super().step(state, actions, seed=seed, selector=selector)


class GatedSum(GatedMixin, SumWorld):
    pass


class GatedBatch(GatedMixin, BatchSumWorld):
    pass


def job(value: float = 0.0, num_steps: int = 4, seed: int = 1) -> StepJob[SumState]:
    return StepJob(SumState(0, value), actions(num_steps), seed)


async def queue_behind_one(worker, jobs):
    """Start one job, wait until the world is busy with it, then queue the others."""
    first = asyncio.create_task(worker.step(job()))
    await asyncio.to_thread(worker.world.entered.wait, 20)
    others = [asyncio.create_task(worker.step(one)) for one in jobs]
    await asyncio.sleep(0)
    return first, others


async def test_one_chunk_alone_waits_for_nobody():
    worker = WorldWorker(BatchSumWorld())
    outcome = await worker.step(job(5.0))
    assert outcome.snapshot == worker.world.snapshot(outcome.stepped.state)
    assert worker.world.batch_sizes == []
    worker.close()


async def test_what_waits_is_taken_together_and_answers_as_alone():
    worker = WorldWorker(GatedBatch(), max_batch=3)
    jobs = [job(float(i), seed=i) for i in range(7)]
    first, others = await queue_behind_one(worker, jobs)
    worker.world.gate.set()
    await first
    outcomes = await asyncio.gather(*others)
    assert worker.world.batch_sizes == [3, 3]
    alone = SumWorld()
    for one, outcome in zip(jobs, outcomes, strict=True):
        expected = alone.step(one.state, one.actions, seed=one.seed)
        assert outcome.stepped.state == expected.state
    worker.close()


async def test_each_of_a_batch_is_shown_what_it_asked_for():
    worker = WorldWorker(GatedBatch())
    asked = [ReturnSelector(steps="last"), ReturnSelector(cameras=()), EVERYTHING]
    jobs = [replace(job(), selector=selector) for selector in asked]
    first, others = await queue_behind_one(worker, jobs)
    worker.world.gate.set()
    await first
    shown = [outcome.stepped.observation for outcome in await asyncio.gather(*others)]
    assert worker.world.batch_sizes == [3]
    assert [len(one) for one in shown] == [1, 4, 4]
    assert [len(one.images) for one in shown] == [2, 0, 2]
    alone = (await worker.step(jobs[0])).stepped.observation
    assert len(alone) == 1
    worker.close()


async def test_chunks_of_other_lengths_wait_for_their_own_batch():
    worker = WorldWorker(GatedBatch())
    jobs = [job(num_steps=n) for n in (4, 8, 4, 8, 4)]
    first, others = await queue_behind_one(worker, jobs)
    worker.world.gate.set()
    await first
    outcomes = await asyncio.gather(*others)
    assert [len(one.stepped.observation) for one in outcomes] == [4, 8, 4, 8, 4]
    assert worker.world.batch_sizes == [3, 2]
    worker.close()


async def test_a_world_without_batches_is_served_one_by_one_in_one_thread():
    worker = WorldWorker(GatedSum())
    first, others = await queue_behind_one(worker, [job(), job()])
    worker.world.gate.set()
    await asyncio.gather(first, *others)
    assert len(worker.world.threads) == 1
    assert threading.get_ident() not in worker.world.threads
    worker.close()


async def test_in_a_failed_batch_only_the_guilty_fails():
    worker = WorldWorker(GatedBatch())
    bad = StepJob(SumState(0, 0.0), actions(4, 1e6), 1)
    first, others = await queue_behind_one(worker, [job(1.0), bad, job(2.0)])
    worker.world.gate.set()
    await first
    good_one, failed, good_two = await asyncio.gather(*others, return_exceptions=True)
    assert isinstance(failed, InvalidInputError)
    assert good_one.stepped.observation.first_step == good_two.stepped.observation.first_step == 1
    assert np.isfinite((await worker.step(job())).stepped.state.total)
    worker.close()


class NotedBatch(GatedBatch):
    """Keeps what each single step began with."""

    def __init__(self) -> None:
        super().__init__()
        self.totals: list[float] = []

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        self.totals.append(state.total)
        return super().step(state, actions, seed=seed, selector=selector)


async def test_a_failed_batch_is_repeated_in_order_before_what_came_later():
    worker = WorldWorker(NotedBatch())
    bad = StepJob(SumState(0, 2.0), actions(4, 1e6), 1)
    jobs = [job(1.0), bad, job(3.0), job(4.0, num_steps=8)]
    first, others = await queue_behind_one(worker, jobs)
    worker.world.totals.clear()
    worker.world.gate.set()
    await first
    await asyncio.gather(*others, return_exceptions=True)
    # The failed batch may have stepped some of its own before.
    assert worker.world.totals[-4:] == [1.0, 2.0, 3.0, 4.0]
    worker.close()


async def test_a_full_queue_refuses_and_recovers():
    worker = WorldWorker(GatedSum(), max_waiting=2)
    first, others = await queue_behind_one(worker, [job(), job()])
    with pytest.raises(LimitExceededError, match="2 chunks are pending") as caught:
        await worker.step(job())
    assert caught.value.details["retry_after_s"] == 1
    worker.world.gate.set()
    await asyncio.gather(first, *others)
    await worker.step(job())
    worker.close()


async def test_a_caller_that_gives_up_disturbs_nobody():
    worker = WorldWorker(GatedSum())
    first, others = await queue_behind_one(worker, [job(), job(7.0)])
    others[0].cancel()
    worker.world.gate.set()
    await first
    assert (await others[1]).stepped.observation.first_step == 1
    worker.close()


async def test_closing_tells_those_who_wait():
    worker = WorldWorker(GatedSum())
    first, others = await queue_behind_one(worker, [job()])
    worker.world.gate.set()
    worker.close()
    with pytest.raises(UnavailableError, match="shutting down"):
        await others[0]
    first.cancel()


class QuickSum(SumWorld):
    """Notes the threads of its calls."""

    def __init__(self, *, is_quick: bool) -> None:
        super().__init__()
        self.is_quick = is_quick
        self.threads: set[int] = set()

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        self.threads.add(threading.get_ident())
        return super().step(state, actions, seed=seed, selector=selector)


@pytest.mark.parametrize("is_quick", [True, False])
async def test_only_a_quick_world_is_called_in_the_event_loop(is_quick):
    worker = WorldWorker(QuickSum(is_quick=is_quick))
    outcome = await worker.step(job(5.0))
    thread = await worker.call(threading.get_ident)
    assert (thread == threading.get_ident()) is is_quick
    assert worker.world.threads == {thread}
    expected = SumWorld().step(SumState(0, 5.0), actions(4), seed=1)
    assert outcome.stepped.state == expected.state
    assert outcome.snapshot == worker.world.snapshot(expected.state)
    with pytest.raises(InvalidInputError):
        await worker.step(StepJob(SumState(0, 0.0), actions(4, 1e6), 1))
    worker.close()


def test_the_baseline_is_quick_while_its_images_are_small():
    small = CopyFirstWorld(tasks=("rest",))
    large = CopyFirstWorld(tasks=("rest",), image_height_px=480, image_width_px=640)
    assert (small.is_quick, large.is_quick) == (True, False)
