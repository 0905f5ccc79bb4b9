"""Versioned key-value state shared by processes (rollouts, leases), in memory or in Redis."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from dextouch.errors import ConflictError, InvalidInputError
from dextouch.serving.redis_link import RedisLink, open_redis

REDIS_PREFIX = "dextouch:state:"


@dataclass(frozen=True)
class Versioned:
    """A value and its version, which starts at 1 and counts writes."""

    value: bytes
    version: int


@runtime_checkable
class StateStore(Protocol):
    """Expiring values with compare-and-set writes, so that no update is lost."""

    async def get(self, key: str) -> Versioned | None:
        """The value, or None when absent or expired."""
        ...

    async def set(self, key: str, value: bytes, *, expected_version: int, ttl_s: float) -> int:
        """Write if the version is the expected one (0: absent), and renew the time to live.

        Returns:
            The new version.

        Raises:
            ConflictError: another version is stored; see `expected` and `got`.
        """
        ...

    async def add(self, key: str, value: bytes, *, within: str, limit: int, ttl_s: float) -> bool:
        """Write a new value unless `limit` live keys start with `within`; False if they do.

        Counting and writing are atomic, so concurrent callers never exceed the limit.

        Raises:
            ConflictError: the key exists.
        """
        ...

    async def delete(self, key: str) -> bool:
        """Delete a key; False if absent."""
        ...

    async def keys(self, prefix: str) -> list[str]:
        """Live keys that start with `prefix`, sorted."""
        ...

    async def ping(self) -> None:
        """Raise UnavailableError when the store cannot be reached."""
        ...

    async def close(self) -> None:
        """Close connections."""
        ...


def open_state(url: str) -> StateStore:
    """Open the store at `memory://` or `redis://host:port/db`.

    Raises:
        InvalidInputError: an unsupported URL.
    """
    if url == "memory://":
        return MemoryState()
    if url.startswith(("redis://", "rediss://")):
        return RedisState(open_redis(url))
    raise InvalidInputError(f"state: got {url!r}, expected memory:// or redis://HOST:PORT/DB")


class MemoryState:
    """A store of one process."""

    def __init__(self, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._entries: dict[str, tuple[Versioned, float]] = {}

    async def get(self, key: str) -> Versioned | None:
        """See StateStore."""
        self._expire()
        entry = self._entries.get(key)
        return None if entry is None else entry[0]

    async def set(self, key: str, value: bytes, *, expected_version: int, ttl_s: float) -> int:
        """See StateStore."""
        self._expire()
        stored = self._entries.get(key)
        version = 0 if stored is None else stored[0].version
        if version != expected_version:
            raise _version_conflict(key, expected=expected_version, got=version)
        written = Versioned(bytes(value), version + 1)
        self._entries[key] = (written, self._clock_s() + _checked_ttl(ttl_s))
        return written.version

    async def add(self, key: str, value: bytes, *, within: str, limit: int, ttl_s: float) -> bool:
        """See StateStore."""
        # No await between counting and writing, hence atomic in one event loop.
        if key not in self._entries and len(await self.keys(within)) >= limit:
            return False
        await self.set(key, value, expected_version=0, ttl_s=ttl_s)
        return True

    async def delete(self, key: str) -> bool:
        """See StateStore."""
        self._expire()
        return self._entries.pop(key, None) is not None

    async def keys(self, prefix: str) -> list[str]:
        """See StateStore."""
        self._expire()
        return sorted(key for key in self._entries if key.startswith(prefix))

    async def ping(self) -> None:
        """Always succeeds."""

    async def close(self) -> None:
        """Drop all values."""
        self._entries.clear()

    def _expire(self) -> None:
        now_s = self._clock_s()
        gone = [key for key, (_, until_s) in self._entries.items() if until_s <= now_s]
        for key in gone:
            del self._entries[key]


# KEYS[1] key · ARGV: expected version, value, time to live in ms → {1, new} or {0, stored}
COMPARE_AND_SET = """
local version = tonumber(redis.call('HGET', KEYS[1], 'version') or '0')
if version ~= tonumber(ARGV[1]) then return {0, version} end
redis.call('HSET', KEYS[1], 'version', version + 1, 'value', ARGV[2])
redis.call('PEXPIRE', KEYS[1], ARGV[3])
return {1, version + 1}
"""

# KEYS[1] key · ARGV: pattern of the keys to count, limit, value, time to live in ms
# → -1: stored already, 0: no room, 1: written
ADD = """
if redis.call('EXISTS', KEYS[1]) == 1 then return -1 end
if #redis.call('KEYS', ARGV[1]) >= tonumber(ARGV[2]) then return 0 end
redis.call('HSET', KEYS[1], 'version', 1, 'value', ARGV[3])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
return 1
"""


class RedisState:
    """A store shared by several processes; one hash per key, written by a Lua script."""

    def __init__(self, link: RedisLink) -> None:
        self._link = link
        self._compare_and_set = link.script(COMPARE_AND_SET)
        self._add = link.script(ADD)

    async def get(self, key: str) -> Versioned | None:
        """See StateStore."""
        version, value = await self._link.call("HMGET", REDIS_PREFIX + key, "version", "value")
        return None if version is None else Versioned(value, int(version))

    async def set(self, key: str, value: bytes, *, expected_version: int, ttl_s: float) -> int:
        """See StateStore."""
        written, version = await self._compare_and_set(
            [REDIS_PREFIX + key], [expected_version, value, _milliseconds(ttl_s)]
        )
        if not written:
            raise _version_conflict(key, expected=expected_version, got=int(version))
        return int(version)

    async def add(self, key: str, value: bytes, *, within: str, limit: int, ttl_s: float) -> bool:
        """See StateStore."""
        counted = _literal(REDIS_PREFIX + within) + "*"
        added = await self._add([REDIS_PREFIX + key], [counted, limit, value, _milliseconds(ttl_s)])
        if added < 0:
            stored = await self.get(key)
            raise _version_conflict(key, expected=0, got=stored.version if stored else 0)
        return bool(added)

    async def delete(self, key: str) -> bool:
        """See StateStore."""
        return bool(await self._link.call("DEL", REDIS_PREFIX + key))

    async def keys(self, prefix: str) -> list[str]:
        """See StateStore."""
        found: set[bytes] = set()
        cursor = 0
        while True:
            cursor, some = await self._link.call(
                "SCAN", cursor, "MATCH", _literal(REDIS_PREFIX + prefix) + "*", "COUNT", 1000
            )
            found.update(some)
            if cursor == 0:
                break
        return sorted(key.decode().removeprefix(REDIS_PREFIX) for key in found)

    async def ping(self) -> None:
        """See StateStore."""
        await self._link.call("PING")

    async def close(self) -> None:
        """See StateStore."""
        await self._link.close()


def _version_conflict(key: str, *, expected: int, got: int) -> ConflictError:
    return ConflictError(
        f"state {key!r}: version {got} is stored, expected {expected}; read it again",
        expected=expected,
        got=got,
    )


def _checked_ttl(ttl_s: float) -> float:
    if not 0 < ttl_s < 1e9:
        raise InvalidInputError(f"time to live: got {ttl_s} s, expected more than 0")
    return ttl_s


def _milliseconds(ttl_s: float) -> int:
    return max(1, round(_checked_ttl(ttl_s) * 1e3))


def _literal(text: str) -> str:
    """Escape a text to a Redis pattern that matches only itself."""
    return "".join("\\" + letter if letter in "*?[]^\\" else letter for letter in text)
