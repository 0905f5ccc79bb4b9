"""What several processes and long lives of a service need: quotas, warm worlds, earlier digests."""

import asyncio

import pytest
from pydantic import ValidationError

from dextouch.errors import ConflictError, EndedError, LimitExceededError, UnavailableError
from dextouch.serving.state import MemoryState, RedisState
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings
from dextouch.worlds.rollouts import RolloutService
from tests.unit.worlds.begun import ALL, START, begin, decoded, service
from tests.unit.worlds.fakes import SumWorld, actions


async def test_rollouts_of_one_key_are_limited(state):
    if isinstance(state, RedisState):
        await state._client.flushdb()
    made = service(state, max_rollouts=5, max_rollouts_per_key=2)

    async def begun(owner):
        return decoded(await made.start("sum", START, ALL, owner=owner)).rollout.id

    results = await asyncio.gather(*(begun("alice") for _ in range(8)), return_exceptions=True)
    ids = [result for result in results if isinstance(result, str)]
    assert len(ids) == 2
    await begun("bob")
    with pytest.raises(LimitExceededError, match="of 5 rollouts, or of 2 of one key, is reached"):
        await made.fork(ids[0], owner="alice")
    # A branch counts for the key that asks for it.
    branch = await made.fork(ids[0], owner="bob")
    assert branch.id[:8] != ids[0][:8]
    await made.delete(ids[1])
    ids[1] = await begun("alice")
    await begun("carol")
    with pytest.raises(LimitExceededError):
        await begun("dave")
    for rollout_id in (*ids, branch.id):
        await made.delete(rollout_id)
    made.close()


async def test_keys_do_not_share_their_limit():
    """Seventeen keys: of their ids two begin with the same hexadecimal digit."""
    made = service(max_rollouts=100, max_rollouts_per_key=1)
    for number in range(17):
        await made.start("sum", START, ALL, owner=f"key-{number}")
    with pytest.raises(LimitExceededError, match="of 1 of one key"):
        await made.start("sum", START, ALL, owner="key-3")
    made.close()


async def test_a_draining_service_continues_but_begins_nothing():
    made = service()
    rollout = await begin(made)
    made.drain()
    assert decoded(await made.step(rollout, 0, actions(4), ALL)).rollout.next_chunk == 1
    for refused in (begin(made), made.fork(rollout)):
        with pytest.raises(UnavailableError, match="begins no rollouts") as caught:
            await refused
        assert caught.value.details["retry_after_s"] == 1
    made.close()


class Unwilling(SumWorld):
    def step(self, state, actions, **more):
        super().step(state, actions, **more)
        raise EndedError("sum: nothing there", reason="black images")


async def test_worlds_are_warm_once_each_has_computed_a_chunk():
    warm, copying, unwilling = SumWorld(), CopyFirstWorld(tasks=("a",)), Unwilling()
    store = MemoryState()
    made = RolloutService({"sum": warm, "copy": copying, "no": unwilling}, store)
    await made.warm_up()
    assert (warm.num_steps, warm.num_restores, unwilling.num_steps) == (1, 1, 1)
    assert store._entries == {}
    made.close()


async def test_a_rollout_keeps_the_digest_it_began_with(state):
    opened = []

    def reopen(name, digest):
        opened.append((name, digest))
        return SumWorld(digest=digest) if digest == "d1" else None

    before = service(state)
    rollout, lost = await begin(before), await begin(service(state, SumWorld(digest="d0")))
    first = await before.step(rollout, 0, actions(4), ALL)
    same = await before.fork(rollout)
    after = RolloutService({"sum": SumWorld(digest="d2")}, state, reopen=reopen)
    assert (await after.step(rollout, 0, actions(4), ALL)).payload == first.payload
    continued = decoded(await after.step(rollout, 1, actions(4), ALL))
    expected = decoded(await before.step(same.id, 1, actions(4), ALL))
    assert continued.rollout.world_digest == "d1"
    assert (continued.observation.tactile_kpa == expected.observation.tactile_kpa).all()
    assert (await after.fork(rollout)).world_digest == "d1"
    assert opened == [("sum", "d1")]
    assert decoded(await after.start("sum", START, ALL)).rollout.world_digest == "d2"
    with pytest.raises(ConflictError, match="of digest d0, this process has d2"):
        await after.step(lost, 0, actions(4), ALL)
    with pytest.raises(ConflictError, match="of digest d0, this process has d2"):
        await after.fork(lost)
    before.close()
    after.close()


def test_workers_need_a_shared_store():
    with pytest.raises(ValidationError, match="each of them would have for itself"):
        WorldServiceSettings(workers=2)
    assert WorldServiceSettings(workers=2, state_url="redis://127.0.0.1:1/0").workers == 2
