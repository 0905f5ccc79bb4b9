"""Events between services, in order and bounded: memory:// or redis:// (Streams).

A topic is a log that keeps its newest `capacity` events and numbers all of them. A subscriber has
a place in the log; what was pushed out before it was read is lost to it, and counted.
"""

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from dextouch.errors import InvalidInputError
from dextouch.serving.redis_link import RedisLink, open_redis

REDIS_PREFIX = "dextouch:bus:"
DEFAULT_CAPACITY = 1024
WAIT_MS = 1000
READ_AT_ONCE = 64


@dataclass(frozen=True)
class Event:
    """One event; `number` counts a topic's events from 1 without holes."""

    topic: str
    number: int
    fields: dict[str, Any]


@runtime_checkable
class Bus(Protocol):
    """Publish and subscribe. Small facts only: frames and arrays never ride on it."""

    async def publish(self, topic: str, fields: Mapping[str, Any]) -> int:
        """Append an event of JSON-like fields; its number."""
        ...

    async def subscribe(self, topic: str, *, after: int | None = None) -> "Subscription":
        """Follow a topic.

        Args:
            topic: which.
            after: number after which to begin (0: all that is still kept); None: from now on.
        """
        ...

    async def ping(self) -> None:
        """Raise UnavailableError when the bus cannot be reached."""
        ...

    async def close(self) -> None:
        """Give connections back."""
        ...


@runtime_checkable
class Log(Protocol):
    """What a subscription reads from."""

    async def read(self, topic: str, after: int) -> list[Event]:
        """Events kept after a number, oldest first; waits a while for the first, may be empty."""
        ...

    async def newest(self, topic: str) -> int:
        """Number of the newest event, 0 before the first."""
        ...


class Subscription:
    """An endless iterator over a topic; `dropped` counts what was lost to a slow reader."""

    def __init__(self, log: Log, topic: str, after: int) -> None:
        self._log = log
        self._after = after
        self._ready: deque[Event] = deque()
        self.topic = topic
        self.dropped = 0

    def __aiter__(self) -> AsyncIterator[Event]:
        return self

    async def __anext__(self) -> Event:
        """The next event, when there is one."""
        while not self._ready:
            events = await self._log.read(self.topic, self._after)
            if events:
                self.dropped += events[0].number - self._after - 1
                self._after = events[-1].number
                self._ready.extend(events)
            elif await self._log.newest(self.topic) < self._after:
                # The server lost its data and counts from 1 again.
                self._after = 0
        return self._ready.popleft()


def open_bus(url: str, *, capacity: int = DEFAULT_CAPACITY) -> Bus:
    """The bus behind `memory://` or `redis://host:port/db`.

    Args:
        url: where.
        capacity: events that a topic keeps.

    Raises:
        InvalidInputError: another kind of address.
    """
    if capacity < 1:
        raise InvalidInputError(f"bus: got capacity {capacity}, expected at least 1")
    if url == "memory://":
        return MemoryBus(capacity=capacity)
    if url.startswith(("redis://", "rediss://")):
        return RedisBus(open_redis(url), capacity=capacity)
    raise InvalidInputError(f"bus: got {url!r}, expected memory:// or redis://HOST:PORT/DB")


class MemoryBus:
    """A bus of one process and one event loop."""

    def __init__(self, *, capacity: int) -> None:
        self._capacity = capacity
        self._topics: dict[str, deque[Event]] = {}
        self._newest: dict[str, int] = {}
        self._changed: dict[str, asyncio.Event] = {}

    async def publish(self, topic: str, fields: Mapping[str, Any]) -> int:
        """See Bus."""
        number = self._newest.get(topic, 0) + 1
        event = Event(topic, number, json.loads(_to_json(fields)))
        self._topics.setdefault(topic, deque(maxlen=self._capacity)).append(event)
        self._newest[topic] = number
        waiting = self._changed.pop(topic, None)
        if waiting is not None:
            waiting.set()
        return number

    async def subscribe(self, topic: str, *, after: int | None = None) -> Subscription:
        """See Bus."""
        return Subscription(self, topic, self._newest.get(topic, 0) if after is None else after)

    async def read(self, topic: str, after: int) -> list[Event]:
        """See Log."""
        if self._newest.get(topic, 0) <= after:
            await self._changed.setdefault(topic, asyncio.Event()).wait()
        kept = [event for event in self._topics.get(topic, ()) if event.number > after]
        return kept[:READ_AT_ONCE]

    async def newest(self, topic: str) -> int:
        """See Log."""
        return self._newest.get(topic, 0)

    async def ping(self) -> None:
        """Memory is always there."""

    async def close(self) -> None:
        """Forget everything."""
        self._topics.clear()


# KEYS: stream, counter · ARGV: capacity, payload → number, which is also the entry's id
PUBLISH = """
local number = redis.call('INCR', KEYS[2])
redis.call('XADD', KEYS[1], 'MAXLEN', '=', ARGV[1], number .. '-0', 'json', ARGV[2])
return number
"""


class RedisBus:
    """A bus that several processes share."""

    def __init__(self, link: RedisLink, *, capacity: int) -> None:
        self._link = link
        self._capacity = capacity
        self._publish = link.script(PUBLISH)

    async def publish(self, topic: str, fields: Mapping[str, Any]) -> int:
        """See Bus."""
        payload = _to_json(fields)
        return int(
            await self._publish([_stream(topic), _counter(topic)], [self._capacity, payload])
        )

    async def subscribe(self, topic: str, *, after: int | None = None) -> Subscription:
        """See Bus."""
        return Subscription(self, topic, await self.newest(topic) if after is None else after)

    async def read(self, topic: str, after: int) -> list[Event]:
        """See Log."""
        place = ("STREAMS", _stream(topic), f"{after}-0")
        answer = await self._link.call("XREAD", "COUNT", READ_AT_ONCE, "BLOCK", WAIT_MS, *place)
        return [
            Event(topic, int(number.split(b"-")[0]), json.loads(payload))
            for number, payload in _entries(answer)
        ]

    async def newest(self, topic: str) -> int:
        """See Log."""
        return int(await self._link.call("GET", _counter(topic)) or 0)

    async def ping(self) -> None:
        """See Bus."""
        await self._link.call("PING")

    async def close(self) -> None:
        """See Bus."""
        await self._link.close()


def _entries(answer: list[Any]) -> list[tuple[bytes, bytes]]:
    """Id and payload of each entry of an XREAD of one stream."""
    return [(number, fields[b"json"]) for _, found in answer for number, fields in found]


def _stream(topic: str) -> str:
    return f"{REDIS_PREFIX}{topic}:events"


def _counter(topic: str) -> str:
    return f"{REDIS_PREFIX}{topic}:newest"


def _to_json(fields: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(fields), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"event: {error}; expected JSON-like, finite fields") from error
