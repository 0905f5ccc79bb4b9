"""One suite for every bus: order, places, loss that is counted; memory and Redis."""

import asyncio
import uuid

import pytest

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.serving.bus import open_bus

CAPACITY = 8


@pytest.fixture(params=["memory", "redis"])
async def bus(request):
    url = "memory://" if request.param == "memory" else request.getfixturevalue("redis_url")
    opened = open_bus(url, capacity=CAPACITY)
    yield opened
    await opened.close()


@pytest.fixture
def topic():
    return f"test.{uuid.uuid4().hex}"


async def take(subscription, count):
    async with asyncio.timeout(20):
        return [await anext(subscription) for _ in range(count)]


async def test_events_arrive_in_order_and_numbered(bus, topic):
    subscription = await bus.subscribe(topic)
    for i in range(5):
        assert await bus.publish(topic, {"i": i, "text": "µ", "list": [1, None]}) == i + 1
    events = await take(subscription, 5)
    assert [event.number for event in events] == [1, 2, 3, 4, 5]
    assert events[3].fields == {"i": 3, "text": "µ", "list": [1, None]}
    assert subscription.dropped == 0


async def test_a_waiting_subscriber_is_woken(bus, topic):
    subscription = await bus.subscribe(topic)
    waiting = asyncio.create_task(take(subscription, 1))
    for _ in range(10):
        await asyncio.sleep(0)
    assert not waiting.done()
    await bus.publish(topic, {"i": 1})
    assert (await waiting)[0].fields == {"i": 1}


async def test_every_subscriber_gets_everything_and_topics_do_not_mix(bus, topic):
    first, second = await bus.subscribe(topic), await bus.subscribe(topic)
    await bus.publish(topic + ".other", {"i": 99})
    await bus.publish(topic, {"i": 1})
    assert [event.fields["i"] for event in await take(first, 1)] == [1]
    assert [event.fields["i"] for event in await take(second, 1)] == [1]


async def test_places_now_start_and_number(bus, topic):
    for i in range(1, 5):
        await bus.publish(topic, {"i": i})
    now = await bus.subscribe(topic)
    start = await bus.subscribe(topic, after=0)
    third = await bus.subscribe(topic, after=2)
    await bus.publish(topic, {"i": 5})
    assert [event.number for event in await take(now, 1)] == [5]
    assert [event.number for event in await take(start, 5)] == [1, 2, 3, 4, 5]
    assert [event.number for event in await take(third, 3)] == [3, 4, 5]


async def test_a_slow_subscriber_loses_the_oldest_and_counts_them(bus, topic):
    subscription = await bus.subscribe(topic)
    for i in range(1, 3 * CAPACITY + 1):
        await bus.publish(topic, {"i": i})
    events = await take(subscription, CAPACITY)
    assert [event.number for event in events] == list(range(2 * CAPACITY + 1, 3 * CAPACITY + 1))
    assert subscription.dropped == 2 * CAPACITY
    await bus.publish(topic, {"i": 0})
    assert [event.number for event in await take(subscription, 1)] == [3 * CAPACITY + 1]
    assert subscription.dropped == 2 * CAPACITY


async def test_many_publishers_give_each_event_its_own_number(bus, topic):
    numbers = await asyncio.gather(*(bus.publish(topic, {"i": i}) for i in range(20)))
    assert sorted(numbers) == list(range(1, 21))


@pytest.mark.parametrize("fields", [{"x": float("nan")}, {"x": b"bytes"}, {"x": object()}])
async def test_what_is_no_json_is_refused(bus, topic, fields):
    with pytest.raises(InvalidInputError, match="event"):
        await bus.publish(topic, fields)


async def test_a_cancelled_reader_loses_nothing(bus, topic):
    subscription = await bus.subscribe(topic)
    waiting = asyncio.create_task(take(subscription, 1))
    await asyncio.sleep(0)
    waiting.cancel()
    done, _ = await asyncio.wait([waiting], timeout=10)
    assert done
    assert waiting.cancelled()
    await bus.publish(topic, {"i": 7})
    assert (await take(subscription, 1))[0].fields == {"i": 7}


async def test_redis_counting_anew_does_not_stop_a_subscriber(redis_url, topic):
    bus = open_bus(redis_url, capacity=CAPACITY)
    for i in range(3):
        await bus.publish(topic, {"i": i})
    subscription = await bus.subscribe(topic)
    await bus._link.call("DEL", f"dextouch:bus:{topic}:events", f"dextouch:bus:{topic}:newest")
    await bus.publish(topic, {"i": "new"})
    assert (await take(subscription, 1))[0].fields == {"i": "new"}
    await bus.close()


async def test_a_server_that_is_not_there_is_unavailable(free_port):
    bus = open_bus(f"redis://127.0.0.1:{free_port}/0")
    with pytest.raises(UnavailableError):
        await bus.publish("x", {})
    await bus.close()


def test_other_addresses_and_capacities_are_refused():
    with pytest.raises(InvalidInputError, match="expected memory"):
        open_bus("nats://x")
    with pytest.raises(InvalidInputError, match="capacity"):
        open_bus("memory://", capacity=0)
