"""The rollout service: numbering, replay, branches, expiry, and going on in another process."""

import asyncio
import threading

import msgpack
import numpy as np
import pytest

from dextouch.errors import (
    ConflictError,
    DexTouchError,
    EndedError,
    InvalidInputError,
    NonFiniteError,
    NotFoundError,
    StorageError,
    UnknownNameError,
)
from dextouch.schemas import MAX_SEED, ReturnSelector, RolloutStart, observations
from dextouch.serving.state import MemoryState
from dextouch.worlds import records
from dextouch.worlds.records import watch_id_of
from dextouch.worlds.rollouts import chunk_seed
from tests.unit.worlds.begun import ALL, START, begin, decoded, service
from tests.unit.worlds.fakes import (
    CAMERAS,
    K_HEAD,
    BatchSumWorld,
    SumWorld,
    actions,
    anchor,
    observation,
)


async def test_chunks_count_up_and_steps_follow():
    made = service()
    rollout_id = await begin(made)
    for chunk, (num_steps, first_step) in enumerate([(4, 1), (16, 5), (8, 21)]):
        answer = decoded(await made.step(rollout_id, chunk, actions(num_steps), ALL))
        assert answer.observation.first_step == first_step
        assert answer.rollout.next_chunk == chunk + 1
    info = await made.get(rollout_id)
    assert (info.next_chunk, info.last_step) == (3, 28)
    made.close()


async def test_the_same_request_again_is_replayed_byte_for_byte():
    world = SumWorld()
    made = service(world=world)
    rollout_id = await begin(made)
    first = await made.step(rollout_id, 0, actions(4, 0.5), ALL)
    again = await made.step(rollout_id, 0, actions(4, 0.5), ALL)
    assert (first.replayed, again.replayed) == (False, True)
    assert again.payload == first.payload
    assert (await made.get(rollout_id)).next_chunk == 1
    made.close()


@pytest.mark.parametrize("chunk", [-1, 0, 1, 3, 10**30])
async def test_any_other_number_or_body_is_a_conflict(chunk):
    made = service()
    rollout_id = await begin(made)
    for i in range(2):
        await made.step(rollout_id, i, actions(4), ALL)
    with pytest.raises(ConflictError, match="expected chunk 2") as caught:
        await made.step(rollout_id, chunk, actions(4, 0.5), ALL)
    assert caught.value.details == {"expected": 2, "got": chunk}
    with pytest.raises(ConflictError):
        await made.step(rollout_id, 1, actions(4), ReturnSelector(steps="last"))
    assert (await made.get(rollout_id)).next_chunk == 2
    made.close()


async def test_an_older_chunk_is_a_conflict_even_with_the_newest_ones_body():
    made = service()
    rollout_id = await begin(made)
    for chunk in range(3):
        await made.step(rollout_id, chunk, actions(4), ALL)
    for chunk in (0, 1):
        with pytest.raises(ConflictError, match="expected chunk 3"):
            await made.step(rollout_id, chunk, actions(4), ALL)
    assert (await made.step(rollout_id, 2, actions(4), ALL)).replayed
    made.close()


@pytest.mark.parametrize(
    ("value", "error"), [(1e6, InvalidInputError), (2e6, RuntimeError), (3e6, NonFiniteError)]
)
async def test_a_failed_step_changes_nothing(value, error):
    made, plain = service(), service()
    rollout_id, expected_id = await begin(made), await begin(plain)
    with pytest.raises(error):
        await made.step(rollout_id, 0, actions(4, value), ALL)
    one = decoded(await made.step(rollout_id, 0, actions(4), ALL)).observation
    other = decoded(await plain.step(expected_id, 0, actions(4), ALL)).observation
    np.testing.assert_array_equal(one.tactile_kpa, other.tactile_kpa)
    made.close()
    plain.close()


async def test_a_rollout_that_its_world_ends_stays_ended(state):
    world = SumWorld()
    made = service(state, world=world)
    rollout_id = await begin(made)
    good = await made.step(rollout_id, 0, actions(4), ALL)
    with pytest.raises(EndedError, match="too many to count") as caught:
        await made.step(rollout_id, 1, actions(4, 4e6), ALL)
    expected = {"reason": "too many to count", "last_chunk": 0, "last_step": 4}
    assert caught.value.details == expected
    info, asked = await made.get(rollout_id), world.num_steps
    assert (info.next_chunk, info.last_step, info.ended) == (1, 4, "too many to count")
    # Also in another process, and with actions that the world would take; nobody asks it again.
    for one in (made, service(state, world=world)):
        with pytest.raises(EndedError) as again:
            await one.step(rollout_id, 1, actions(4), ALL)
        assert (again.value.message, again.value.details) == (caught.value.message, expected)
    assert world.num_steps == asked
    assert (await made.step(rollout_id, 0, actions(4), ALL)).payload == good.payload
    with pytest.raises(ConflictError, match="expected chunk 1"):
        await made.step(rollout_id, 2, actions(4), ALL)


async def test_a_branch_of_an_ended_rollout_goes_on_from_its_last_good_step():
    made = service()
    rollout_id = await begin(made)
    with pytest.raises(EndedError) as caught:
        await made.step(rollout_id, 0, actions(4, 4e6), ALL)
    assert caught.value.details["last_chunk"] is None
    branch = await made.fork(rollout_id)
    assert branch.ended is None
    answer = decoded(await made.step(branch.id, 0, actions(4), ALL))
    assert (answer.observation.first_step, answer.rollout.ended) == (1, None)
    made.close()


async def test_a_world_draws_only_what_is_asked_for():
    class Noting(SumWorld):
        def step(self, state, actions, *, seed, selector):
            asked.append(selector)
            return super().step(state, actions, seed=seed, selector=selector)

    asked: list[ReturnSelector] = []
    made = service(world=Noting())
    rollout_id = await begin(made)
    selector = ReturnSelector(cameras=("camera_head",), steps="last")
    answer = decoded(await made.step(rollout_id, 0, actions(8), selector))
    assert asked == [selector]
    seen = answer.observation
    assert (seen.first_step, len(seen), set(seen.images)) == (8, 1, {"camera_head"})
    made.close()


async def test_a_world_that_shows_more_than_asked_breaks_its_promise():
    class Generous(SumWorld):
        def step(self, state, actions, *, seed, selector):
            return super().step(state, actions, seed=seed)

    made = service(world=Generous())
    rollout_id = await begin(made)
    with pytest.raises(DexTouchError, match="got 4 steps from 1, expected 1 from 4"):
        await made.step(rollout_id, 0, actions(4), ReturnSelector(steps="last"))
    with pytest.raises(DexTouchError, match="images of"):
        await made.step(rollout_id, 0, actions(4), ReturnSelector(cameras=()))
    made.close()


async def test_a_world_that_breaks_its_promise_is_not_believed():
    class Short(SumWorld):
        def step(self, state, actions, *, seed, selector):
            return super().step(state, actions[:-1], seed=seed, selector=selector)

    made = service(world=Short())
    rollout_id = await begin(made)
    with pytest.raises(DexTouchError, match="got 3 steps from 1, expected 4 from 1"):
        await made.step(rollout_id, 0, actions(4), ALL)
    assert (await made.get(rollout_id)).next_chunk == 0
    made.close()


async def test_another_process_goes_on_where_the_first_was(state):
    alone = service()
    alone_id = await begin(alone)
    first, second = service(state), service(state)
    rollout_id = await begin(first)
    for chunk in range(4):
        here = first if chunk % 2 == 0 else second
        one = decoded(await here.step(rollout_id, chunk, actions(4, 0.1), ALL)).observation
        other = decoded(await alone.step(alone_id, chunk, actions(4, 0.1), ALL)).observation
        np.testing.assert_array_equal(one.tactile_kpa, other.tactile_kpa)
    assert first._workers["sum"].world.num_restores == 1
    assert second._workers["sum"].world.num_restores == 2
    # The second process also knows the last answer of the first.
    replayed = await first.step(rollout_id, 3, actions(4, 0.1), ALL)
    assert replayed.replayed
    await second.delete(rollout_id)
    with pytest.raises(NotFoundError):
        await first.step(rollout_id, 4, actions(4), ALL)
    for made in (alone, first, second):
        made.close()


async def test_what_is_stored_is_read_only_where_it_is_needed(state):
    made, other = service(state), service(state)
    rollout_id = await begin(made)
    reads = []
    read = made._records.read

    async def noted(rollout_id):
        reads.append(rollout_id)
        return await read(rollout_id)

    made._records.read = noted
    for chunk in range(3):
        await made.step(rollout_id, chunk, actions(4), ALL)
    assert not reads
    assert (await made.step(rollout_id, 2, actions(4), ALL)).replayed
    assert len(reads) == 1
    await other.step(rollout_id, 3, actions(4), ALL)
    await other.step(rollout_id, 4, actions(4), ALL)
    # The state that this process holds is after chunk 2: the store is read, and its state restored.
    num_steps = made._workers["sum"].world.num_steps
    with pytest.raises(ConflictError, match="expected chunk 5"):
        await made.step(rollout_id, 3, actions(4), ALL)
    assert made._workers["sum"].world.num_steps == num_steps
    await made.step(rollout_id, 5, actions(4), ALL)
    made.close()
    other.close()


async def test_a_record_of_another_version_is_refused():
    store = MemoryState()
    made = service(store)
    rollout_id = await begin(made)
    key = f"rollout:{watch_id_of(rollout_id)}"
    for value, tail, says in [
        (msgpack.packb({"fields": {}, "arrays": {}}), b"", "another version"),
        ((await store.get(key)).value, b"x", "got 1 bytes"),
    ]:
        version = await store.version(key)
        await store.set(key, value, tail=tail, expected_version=version, ttl_s=60.0)
        with pytest.raises(StorageError, match=says):
            await made.step(rollout_id, 0, actions(4), ALL)
    made.close()


async def test_many_jpeg_images_are_encoded_beside_the_event_loop(monkeypatch):
    threads = []
    encode = observations.encode_jpeg

    def noted(image):
        threads.append(threading.get_ident())
        return encode(image)

    monkeypatch.setattr(observations, "encode_jpeg", noted)
    made = service()
    rollout_id = await begin(made)
    selector = ReturnSelector(images="jpeg")
    await made.step(rollout_id, 0, actions(4), selector)
    assert set(threads) == {threading.get_ident()}
    monkeypatch.setattr(records, "MAX_INLINE_IMAGE_BYTES", 100)
    threads.clear()
    answer = decoded(await made.step(rollout_id, 1, actions(4), selector))
    assert threads
    assert threading.get_ident() not in threads
    assert set(answer.observation.images) == set(CAMERAS)
    made.close()


async def test_two_processes_that_take_the_same_chunk_agree(state):
    first, second = service(state), service(state)
    rollout_id = await begin(first)
    answers = await asyncio.gather(
        *(made.step(rollout_id, 0, actions(4), ALL) for made in (first, second))
    )
    assert answers[0].payload == answers[1].payload
    assert sorted(answer.replayed for answer in answers) == [False, True]
    different = await asyncio.gather(
        first.step(rollout_id, 1, actions(4, 0.1), ALL),
        second.step(rollout_id, 1, actions(4, 0.2), ALL),
        return_exceptions=True,
    )
    assert [isinstance(one, ConflictError) for one in different].count(True) == 1
    assert (await first.get(rollout_id)).next_chunk == 2
    first.close()
    second.close()


async def test_a_retry_while_the_first_try_runs_waits_and_is_replayed():
    made = service()
    rollout_id = await begin(made)
    answers = await asyncio.gather(*(made.step(rollout_id, 0, actions(4), ALL) for _ in range(3)))
    assert [answer.replayed for answer in answers] == [False, True, True]
    assert made._workers["sum"].world.num_steps == 1
    made.close()


async def test_rollouts_expire_without_chunks():
    now_s = [0.0]
    made = service(MemoryState(clock_s=lambda: now_s[0]), ttl_s=10.0)
    rollout_id = await begin(made)
    now_s[0] = 9.0
    await made.get(rollout_id)
    await made.step(rollout_id, 0, actions(4), ALL)
    now_s[0] = 18.0
    await made.step(rollout_id, 1, actions(4), ALL)
    now_s[0] = 28.0
    with pytest.raises(NotFoundError, match="expired"):
        await made.step(rollout_id, 2, actions(4), ALL)
    made.close()


async def test_a_branch_has_the_same_past_and_its_own_future():
    made = service()
    rollout_id = await begin(made)
    await made.step(rollout_id, 0, actions(4), ALL)
    same = (await made.fork(rollout_id)).id
    other = (await made.fork(rollout_id, seed=8)).id
    one, two, three = [
        decoded(await made.step(name, 1, actions(4), ALL)).observation.tactile_kpa
        for name in (rollout_id, same, other)
    ]
    np.testing.assert_array_equal(one, two)
    assert np.abs(one - three).max() > 1e-3
    assert (await made.get(other)).seed == 8
    made.close()


async def test_answers_do_not_depend_on_who_else_is_served():
    alone, shared = service(world=SumWorld()), service(world=BatchSumWorld())
    alone_id = await begin(alone)
    expected = decoded(await alone.step(alone_id, 0, actions(4), ALL)).observation.tactile_kpa
    ids = [await begin(shared) for _ in range(8)]
    answers = await asyncio.gather(*(shared.step(one, 0, actions(4), ALL) for one in ids))
    for answer in answers:
        got = decoded(answer).observation.tactile_kpa
        # Another world digest would be another noise: both worlds say digest d1.
        np.testing.assert_array_equal(got, expected)
    assert max(shared._workers["sum"].world.batch_sizes) > 1
    alone.close()
    shared.close()


async def test_a_rollout_of_another_checkpoint_is_refused(state):
    old, new = service(state), service(state, world=SumWorld(digest="d2"))
    rollout_id = await begin(old)
    with pytest.raises(ConflictError, match="start a new rollout"):
        await new.step(rollout_id, 0, actions(4), ALL)
    old.close()
    new.close()


async def test_starts_are_checked_against_the_world():
    made = service()
    bad_task = RolloutStart("juggle", 1, "x")
    with pytest.raises(UnknownNameError, match="task 'juggle'; valid: stack_bowls, stand_bottle"):
        await made.start("sum", bad_task, ALL)
    with pytest.raises(UnknownNameError, match="action kind 'measured'; valid: commanded"):
        await made.start("sum", RolloutStart("stand_bottle", 1, "x", "measured"), ALL)
    with pytest.raises(UnknownNameError, match="camera 'ceiling'"):
        await made.start("sum", START, ReturnSelector(cameras=("ceiling",)))
    two = RolloutStart(
        "stand_bottle", 1, "x", observation=observation(2), anchor=anchor(), K_head=K_HEAD
    )
    with pytest.raises(InvalidInputError, match="2 steps, expected 1"):
        await made.start("sum", two, ALL)
    made.close()


def test_chunk_seeds_are_stable_and_differ():
    # Fixed for ever: stored rollouts and published scores depend on it.
    assert chunk_seed(3, 0, "d1") == 3293921974459185955
    seeds = {chunk_seed(a, b, c) for a in range(4) for b in range(4) for c in ("d1", "d2")}
    assert len(seeds) == 32
    assert all(0 <= seed <= MAX_SEED for seed in seeds)
