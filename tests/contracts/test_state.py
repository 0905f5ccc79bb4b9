"""One suite for every state store: compare-and-set, limits, time to live; memory and Redis."""

import asyncio
import os
import uuid

import pytest

from dextouch.errors import ConflictError, InvalidInputError, UnavailableError
from dextouch.serving import open_state
from dextouch.serving.state import MemoryState


@pytest.fixture(params=["memory", "redis"])
async def state(request):
    url = "memory://" if request.param == "memory" else request.getfixturevalue("redis_url")
    store = open_state(url)
    yield store
    await store.close()


@pytest.fixture
def key():
    return f"test:{uuid.uuid4().hex}"


async def test_values_come_back_byte_for_byte_with_their_version(state, key):
    value = bytes(range(256)) + os.urandom(1000) + b"\r\n\x00"
    assert await state.get(key) is None
    assert await state.set(key, value, expected_version=0, ttl_s=60.0) == 1
    stored = await state.get(key)
    assert (stored.value, stored.version) == (value, 1)
    assert await state.set(key, b"", expected_version=1, ttl_s=60.0) == 2
    assert (await state.get(key)).value == b""


async def test_a_write_on_another_version_is_refused_and_changes_nothing(state, key):
    with pytest.raises(ConflictError) as caught:
        await state.set(key, b"x", expected_version=1, ttl_s=60.0)
    assert caught.value.details == {"expected": 1, "got": 0}
    await state.set(key, b"first", expected_version=0, ttl_s=60.0)
    for wrong in (0, 2):
        with pytest.raises(ConflictError):
            await state.set(key, b"other", expected_version=wrong, ttl_s=60.0)
    assert (await state.get(key)).value == b"first"


async def test_of_many_writers_exactly_one_wins(state, key):
    writes = [state.set(key, b"%d" % i, expected_version=0, ttl_s=60.0) for i in range(16)]
    results = await asyncio.gather(*writes, return_exceptions=True)
    winners = [i for i, result in enumerate(results) if result == 1]
    assert len(winners) == 1
    assert (await state.get(key)).value == b"%d" % winners[0]


async def test_of_many_new_values_only_as_many_as_allowed_are_kept(state, key):
    await state.set(key + "-other", b"", expected_version=0, ttl_s=60.0)
    adds = [
        state.add(f"{key}:{i}", b"%d" % i, limits={key + ":": 4}, ttl_s=60.0) for i in range(24)
    ]
    assert (await asyncio.gather(*adds)).count(True) == 4
    kept = [f"{key}:{i}" for i in range(24) if await state.get(f"{key}:{i}") is not None]
    assert len(kept) == 4
    stored = await state.get(kept[0])
    assert (stored.value.decode(), stored.version) == (kept[0].rpartition(":")[2], 1)
    assert not await state.add(key + ":z", b"", limits={key + ":": 4}, ttl_s=60.0)
    await state.delete(kept[0])
    assert await state.add(key + ":z", b"z", limits={key + ":": 4}, ttl_s=60.0)
    with pytest.raises(ConflictError) as caught:
        await state.add(key + ":z", b"", limits={key + ":": 9}, ttl_s=60.0)
    assert caught.value.details == {"expected": 0, "got": 1}
    assert (await state.get(key + ":z")).value == b"z"


async def test_a_group_lists_its_newest_notes(state, key):
    async def add(name):
        assert await state.add(f"{key}:{name}", b"", limits={key: 9}, ttl_s=60.0)

    async def note(name, version=1, text=None):
        await state.set(
            f"{key}:{name}",
            b"long" * 1000,
            note=(text or name).encode(),
            expected_version=version,
            ttl_s=60.0,
        )

    assert await state.newest_notes(key, 5) == ([], 0)
    for name in ("a", "b", "c", "silent"):
        await add(name)
    for name in ("b", "a", "c"):
        await note(name)
    # A second note changes the text and not the order; other keys are in no group.
    await note("b", 2, "b again")
    await state.set(f"{key}:other", b"", note=b"other", expected_version=0, ttl_s=60.0)
    assert await state.newest_notes(key, 5) == ([b"c", b"a", b"b again"], 3)
    assert await state.newest_notes(key, 1) == ([b"c"], 3)
    assert await state.note(f"{key}:b") == b"b again"
    assert await state.note(f"{key}:silent") == await state.note(f"{key}:none") == b""
    await state.delete(f"{key}:c")
    assert await state.newest_notes(key, 5) == ([b"a", b"b again"], 2)


async def test_expired_values_leave_their_groups(state, key):
    assert await state.add(key + ":lasting", b"", limits={key: 2}, ttl_s=60.0)
    assert await state.add(key + ":brief", b"", limits={key: 2}, ttl_s=60.0)
    await state.set(key + ":lasting", b"", note=b"lasting", expected_version=1, ttl_s=60.0)
    await state.set(key + ":brief", b"", note=b"brief", expected_version=1, ttl_s=0.02)
    assert not await state.add(key + ":more", b"", limits={key: 2}, ttl_s=60.0)
    await asyncio.sleep(0.05)
    assert await state.newest_notes(key, 5) == ([b"lasting"], 1)
    assert await state.add(key + ":more", b"", limits={key: 2}, ttl_s=60.0)


async def test_redis_keeps_nothing_of_what_is_gone(redis_url, key):
    store = open_state(redis_url)
    for name, ttl_s in (("deleted", 60.0), ("expired", 0.02)):
        assert await store.add(f"{key}:{name}", b"", limits={key + name: 2}, ttl_s=ttl_s)
        await store.set(f"{key}:{name}", b"", note=b"x", expected_version=1, ttl_s=ttl_s)
    await store.delete(f"{key}:deleted")
    while left := await store._call("KEYS", f"*{key}*"):
        # Sorted sets expire with the last of their keys.
        assert all(b"expired" in name for name in left)
        await asyncio.sleep(0.005)
    await store.close()


async def test_delete_makes_room_for_a_new_thing(state, key):
    await state.set(key + ":b", b"1", expected_version=0, ttl_s=60.0)
    await state.set(key + ":a", b"2", expected_version=0, ttl_s=60.0)
    assert await state.delete(key + ":a")
    assert not await state.delete(key + ":a")
    assert await state.get(key + ":a") is None
    assert (await state.get(key + ":b")).value == b"1"
    assert await state.set(key + ":a", b"4", expected_version=0, ttl_s=60.0) == 1


async def test_a_prefix_is_a_text_and_no_pattern(state, key):
    pattern = key.replace("test:", "tes*:")
    await state.set(key, b"1", expected_version=0, ttl_s=60.0)
    assert await state.add(pattern + ":a", b"2", limits={pattern: 1}, ttl_s=60.0)
    assert not await state.add(pattern + ":b", b"3", limits={pattern: 1}, ttl_s=60.0)


async def test_values_expire(state, key):
    await state.set(key, b"brief", expected_version=0, ttl_s=0.005)
    for _ in range(100_000):
        if await state.get(key) is None:
            break
    assert await state.get(key) is None
    assert await state.add(key + "-other", b"", limits={key: 1}, ttl_s=60.0)
    assert await state.set(key, b"again", expected_version=0, ttl_s=60.0) == 1


@pytest.mark.parametrize("ttl_s", [0.0, -1.0, float("nan"), float("inf")])
async def test_a_time_to_live_must_be_a_time(state, key, ttl_s):
    with pytest.raises(InvalidInputError, match="time to live"):
        await state.set(key, b"x", expected_version=0, ttl_s=ttl_s)
    assert await state.get(key) is None


async def test_ping(state):
    await state.ping()


async def test_memory_expires_by_its_clock(key):
    now_s = [100.0]
    store = MemoryState(clock_s=lambda: now_s[0])
    await store.set(key, b"x", expected_version=0, ttl_s=10.0)
    now_s[0] = 109.9
    assert await store.get(key) is not None
    await store.set(key, b"y", expected_version=1, ttl_s=10.0)
    now_s[0] = 119.8
    assert await store.get(key) is not None
    now_s[0] = 119.9
    assert await store.get(key) is None


async def test_a_server_that_is_not_there_is_unavailable(free_port):
    store = open_state(f"redis://:secret@127.0.0.1:{free_port}/0")
    with pytest.raises(UnavailableError, match="is the server running") as caught:
        await store.ping()
    assert "secret" not in str(caught.value)
    await store.close()


@pytest.mark.parametrize("url", ["", "sqlite://x", "redis//host"])
def test_other_addresses_are_refused(url):
    with pytest.raises(InvalidInputError, match="expected memory"):
        open_state(url)
