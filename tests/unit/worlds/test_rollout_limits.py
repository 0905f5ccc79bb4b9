"""Limits of a rollout service: numbers, lengths, places that fail, and memory."""

import asyncio
import threading

import pytest
from pydantic import ValidationError

from dextouch.errors import (
    InvalidInputError,
    LimitExceededError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import RolloutStart
from dextouch.serving.state import MemoryState, RedisState
from dextouch.worlds.settings import RolloutLimits
from tests.unit.worlds.begun import ALL, begin, service
from tests.unit.worlds.fakes import (
    SumWorld,
    actions,
)


@pytest.mark.parametrize("ttl_s", [float("inf"), 1e9])
def test_a_time_to_live_that_no_rollout_could_have_is_refused(ttl_s):
    with pytest.raises(ValidationError, match="less than 1000000000"):
        RolloutLimits(ttl_s=ttl_s)


async def test_limits_on_number_and_length():
    now_s = [0.0]
    made = service(MemoryState(clock_s=lambda: now_s[0]), max_rollouts=2, max_chunks=2, ttl_s=10.0)
    first = await begin(made)
    await made.fork(first)
    for refused in (begin(made), made.fork(first)):
        with pytest.raises(LimitExceededError, match=r"limit of 2 rollouts is reached; delete one"):
            await refused
    for chunk in range(2):
        await made.step(first, chunk, actions(4), ALL)
    with pytest.raises(LimitExceededError, match="has 2 chunks"):
        await made.step(first, 2, actions(4), ALL)
    now_s[0] = 11.0
    await begin(made)
    made.close()


@pytest.mark.parametrize("num_processes", [1, 2])
async def test_of_many_starts_at_once_only_as_many_as_allowed_begin(state, num_processes):
    if isinstance(state, RedisState):
        await state._client.flushdb()
    made = [service(state, max_rollouts=4) for _ in range(num_processes)]
    results = await asyncio.gather(
        *(begin(made[i % num_processes]) for i in range(24)), return_exceptions=True
    )
    begun = [result for result in results if isinstance(result, str)]
    assert len(begun) == 4
    refused = [result for result in results if not isinstance(result, str)]
    assert {type(error) for error in refused} == {LimitExceededError}
    assert refused[0].details == {"retry_after_s": 1}
    # A place is free again once a rollout has ended; branches take one, too.
    await made[0].delete(begun[0])
    results = await asyncio.gather(
        *(made[i % num_processes].fork(begun[1]) for i in range(24)), return_exceptions=True
    )
    assert sum(not isinstance(result, Exception) for result in results) == 1
    for each in made:
        each.close()


class Waiting(SumWorld):
    """Begins when it is let; an instruction of none cannot begin at all."""

    def __init__(self):
        super().__init__()
        self.may_begin = threading.Event()
        self.has_place = threading.Event()

    def reset(self, start):
        if not start.instruction:
            raise InvalidInputError("no instruction")
        self.has_place.set()
        self.may_begin.wait(30)
        return super().reset(start)


async def test_starts_that_fail_or_are_cancelled_leave_their_place(state):
    if isinstance(state, RedisState):
        await state._client.flushdb()
    world = Waiting()
    made = service(state, world=world, max_rollouts=1)
    for _ in range(2):
        with pytest.raises(InvalidInputError, match="no instruction"):
            await begin(made, RolloutStart("stand_bottle", 3, ""))
    starting = asyncio.create_task(begin(made))
    await asyncio.to_thread(world.has_place.wait, 30)
    with pytest.raises(LimitExceededError):
        await begin(made)
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    world.may_begin.set()
    await begin(made)
    made.close()


def fail_after(store, command, error):
    """Let a command of a store do its work, if any, and then fail."""
    asked = getattr(store, command)

    async def failing(*args, **kwargs):
        await asked(*args, **kwargs)
        raise error

    setattr(store, command, failing)


async def test_a_store_whose_answer_is_lost_holds_no_place(state):
    if isinstance(state, RedisState):
        await state._client.flushdb()
    made = service(state, max_rollouts=2)
    first = await begin(made)
    fail_after(state, "add", UnavailableError("answer lost"))
    for asked in (begin(made), made.fork(first)):
        with pytest.raises(UnavailableError, match="answer lost"):
            await asked
    del state.add
    await begin(made)
    with pytest.raises(LimitExceededError):
        await begin(made)
    made.close()


@pytest.mark.parametrize("error", [StorageError("read-only replica"), UnavailableError("gone")])
async def test_the_error_of_a_start_stays_when_its_place_cannot_be_freed(error):
    store = MemoryState()
    fail_after(store, "delete", error)
    made = service(store, Waiting())
    with pytest.raises(InvalidInputError, match="no instruction"):
        await begin(made, RolloutStart("stand_bottle", 3, ""))
    made.close()


async def test_memory_stays_flat_over_abandoned_rollouts():
    now_s = [0.0]
    store = MemoryState(clock_s=lambda: now_s[0])
    made = service(store, max_rollouts=4, ttl_s=1.0)
    for _ in range(300):
        await begin(made)
        now_s[0] += 0.5
    assert len(made._live) <= 4
    store._expire()
    assert len(store._entries) <= 3
    assert len(made._locks) == 0
    made.close()


async def test_as_many_states_are_held_as_rollouts_may_live():
    made, other = (service(store, max_rollouts=3) for store in [MemoryState()] * 2)
    first, second, third = [await begin(made) for _ in range(3)]
    assert made.num_live == 3
    await made.delete(second)
    assert made.num_live == 2
    # One that another process deletes and replaces makes room: the least recently used one goes.
    await made.step(first, 0, actions(4), ALL)
    await other.delete(third)
    fourth, fifth = [await begin(made) for _ in range(2)]
    assert list(made._live) == [first, fourth, fifth]
    for each in (made, other):
        each.close()


async def test_the_states_of_abandoned_rollouts_are_dropped():
    now_s = [0.0]
    store = MemoryState(clock_s=lambda: now_s[0])
    made = service(store, ttl_s=600.0)
    # The first one is swept at once, since it is there when the sweeper begins.
    _, kept, _ = [await begin(made) for _ in range(3)]
    made._sweep()
    now_s[0] = 500.0
    await made.step(kept, 0, actions(4), ALL)
    made._sweep()
    assert list(made._live) == [kept]
    now_s[0] = 601.0
    await store.ping()
    assert len(store._entries) == 1
    made._sweep()
    made._sweep()
    assert not made._live
    assert made._sweeper is None
    await begin(made)
    assert made._sweeper is not None
    made.close()
