"""Versioned key-value state shared by processes (rollouts, leases), in memory or in Redis."""

import asyncio
import math
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping
from itertools import islice
from typing import Any, NamedTuple

import redis.asyncio
from redis.commands.core import AsyncScript
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError

from dextouch.errors import ConflictError, InvalidInputError, StorageError, UnavailableError

REDIS_PREFIX = "dextouch:state:"
# Sorted sets of the keys of a group: all of them by when they expire, and those with a note by when
# they got it. Listing and counting a group reads no other keys.
LIVE_PREFIX = "dextouch:live:"
NOTED_PREFIX = "dextouch:noted:"
CONNECT_TIMEOUT_S = 2.0
ANSWER_TIMEOUT_S = 10.0

Argument = str | bytes | int | float


class Versioned(NamedTuple):
    """A value in two parts, its version, which starts at 1 and counts writes, and a short note."""

    value: bytes
    version: int
    tail: bytes = b""
    note: bytes = b""


class MemoryState:
    """Expiring values of one process, with compare-and-set writes, so that no update is lost.

    A value that is added (`add`) belongs to groups, whose size is limited and which are listed.
    """

    def __init__(self, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._entries: dict[str, tuple[Versioned, float]] = {}
        self._groups_of: dict[str, tuple[str, ...]] = {}
        # Keys of each group: all, and those with a note in the order in which they got it.
        self._live: defaultdict[str, set[str]] = defaultdict(set)
        self._noted: defaultdict[str, dict[str, None]] = defaultdict(dict)
        # No entry expires earlier.
        self._expires_s = math.inf

    async def get(self, key: str) -> Versioned | None:
        """The value, or None when absent or expired."""
        self._expire()
        entry = self._entries.get(key)
        return None if entry is None else entry[0]

    async def version(self, key: str) -> int:
        """The version that `get` would return, without the value; 0 when absent or expired."""
        self._expire()
        return self._entries[key][0].version if key in self._entries else 0

    async def note(self, key: str) -> bytes:
        """The note, without the value; empty when absent or expired."""
        stored = await self.get(key)
        return b"" if stored is None else stored.note

    async def newest_notes(self, group: str, limit: int) -> tuple[list[bytes], int]:
        """Notes of the keys of a group that got theirs last, the newest first, and how many have.

        Takes a time that depends on `limit` alone.
        """
        self._expire()
        noted = self._noted.get(group, {})
        newest = islice(reversed(noted), limit)
        return [self._entries[key][0].note for key in newest], len(noted)

    async def set(
        self,
        key: str,
        value: bytes,
        *,
        tail: bytes = b"",
        note: bytes = b"",
        expected_version: int,
        ttl_s: float,
    ) -> int:
        """Write if the version is the expected one (0: absent), and renew the time to live.

        `tail` is a second part of the value, such as megabytes that are not to be copied behind the
        first; `note` a few bytes about it, which `newest_notes` lists without reading the value.

        Returns:
            The new version.

        Raises ConflictError if another version is stored; see `expected` and `got`.
        """
        self._expire()
        stored = self._entries.get(key)
        version = 0 if stored is None else stored[0].version
        if version != expected_version:
            raise _version_conflict(key, expected=expected_version, got=version)
        written = Versioned(bytes(value), version + 1, tail, note)
        until_s = self._clock_s() + _checked_ttl(ttl_s)
        self._expires_s = min(self._expires_s, until_s)
        self._entries[key] = (written, until_s)
        if note:
            for group in self._groups_of.get(key, ()):
                self._noted[group].setdefault(key)
        return written.version

    async def add(self, key: str, value: bytes, *, limits: Mapping[str, int], ttl_s: float) -> bool:
        """Write a new value into groups unless a limit is reached; False if one is.

        Counting and writing are atomic, so concurrent callers never exceed a limit: the number of
        live keys of each group. The value is in its groups until it is deleted or expires. Raises
        ConflictError if the key exists.
        """
        # No await between counting and writing, hence atomic in one event loop.
        self._expire()
        is_full = any(len(self._live.get(group, ())) >= limit for group, limit in limits.items())
        if key not in self._entries and is_full:
            return False
        await self.set(key, value, expected_version=0, ttl_s=ttl_s)
        self._groups_of[key] = tuple(limits)
        for group in limits:
            self._live[group].add(key)
        return True

    async def delete(self, key: str) -> bool:
        """Delete a key; False if absent."""
        self._expire()
        return self._remove(key)

    async def ping(self) -> None:
        """Always succeeds; drops what has expired, also where nobody asks for it again."""
        self._expire()

    async def close(self) -> None:
        """Drop all values."""
        for key in list(self._entries):
            self._remove(key)

    def _remove(self, key: str) -> bool:
        for group in self._groups_of.pop(key, ()):
            self._live[group].discard(key)
            self._noted[group].pop(key, None)
            if not self._live[group]:
                del self._live[group], self._noted[group]
        return self._entries.pop(key, None) is not None

    def _expire(self) -> None:
        now_s = self._clock_s()
        if now_s < self._expires_s:
            return
        gone = [key for key, (_, until_s) in self._entries.items() if until_s <= now_s]
        for key in gone:
            self._remove(key)
        self._expires_s = min((until_s for _, until_s in self._entries.values()), default=math.inf)


# Functions of all scripts. The score of a key in `live` is when it expires, in ms of the server.
_SCRIPT_COMMON = f"""
local function now_ms()
  local time = redis.call('TIME')
  return time[1] * 1000 + math.floor(time[2] / 1000)
end
local function indexes(group)
  return '{LIVE_PREFIX}' .. group, '{NOTED_PREFIX}' .. group
end
local function forget(group, keys)
  local live, noted = indexes(group)
  for _, key in ipairs(keys) do
    redis.call('ZREM', live, key)
    redis.call('ZREM', noted, key)
  end
end
local function forget_expired(group)
  local live = indexes(group)
  forget(group, redis.call('ZRANGEBYSCORE', live, '-inf', now_ms()))
end
local function outlive(index, until_ms)
  if redis.call('PTTL', index) < until_ms - now_ms() then
    redis.call('PEXPIREAT', index, until_ms)
  end
end
"""

# KEYS[1] key · ARGV: expected version, value, tail, time to live in ms, note
# → {1, new} or {0, stored}
COMPARE_AND_SET = """
local stored = redis.call('HMGET', KEYS[1], 'version', 'groups')
local version = tonumber(stored[1] or '0')
if version ~= tonumber(ARGV[1]) then return {0, version} end
local until_ms = now_ms() + ARGV[4]
redis.call('HSET', KEYS[1], 'version', version + 1, 'value', ARGV[2], 'tail', ARGV[3],
  'note', ARGV[5])
redis.call('PEXPIREAT', KEYS[1], until_ms)
for _, group in ipairs(stored[2] and cmsgpack.unpack(stored[2]) or {}) do
  local live, noted = indexes(group)
  redis.call('ZADD', live, until_ms, KEYS[1])
  outlive(live, until_ms)
  if ARGV[5] ~= '' then
    if not redis.call('ZSCORE', noted, KEYS[1]) then
      local last = redis.call('ZREVRANGE', noted, 0, 0, 'WITHSCORES')
      redis.call('ZADD', noted, tonumber(last[2] or '0') + 1, KEYS[1])
    end
    outlive(noted, until_ms)
  end
end
return {1, version + 1}
"""

# KEYS[1] key · ARGV: value, time to live in ms, then pairs of a group and its limit
# → -1: stored already, 0: no room, 1: written
ADD = """
if redis.call('EXISTS', KEYS[1]) == 1 then return -1 end
local groups = {}
for i = 3, #ARGV, 2 do
  forget_expired(ARGV[i])
  if redis.call('ZCARD', (indexes(ARGV[i]))) >= tonumber(ARGV[i + 1]) then return 0 end
  table.insert(groups, ARGV[i])
end
local until_ms = now_ms() + ARGV[2]
redis.call('HSET', KEYS[1], 'version', 1, 'value', ARGV[1], 'groups', cmsgpack.pack(groups))
redis.call('PEXPIREAT', KEYS[1], until_ms)
for _, group in ipairs(groups) do
  local live = indexes(group)
  redis.call('ZADD', live, until_ms, KEYS[1])
  outlive(live, until_ms)
end
return 1
"""

# KEYS[1] key → 1: deleted, 0: absent
DELETE = """
local groups = redis.call('HGET', KEYS[1], 'groups')
for _, group in ipairs(groups and cmsgpack.unpack(groups) or {}) do forget(group, {KEYS[1]}) end
return redis.call('DEL', KEYS[1])
"""

# ARGV: group, limit → how many keys have a note, then notes, the newest first
NEWEST_NOTES = """
forget_expired(ARGV[1])
local _, noted = indexes(ARGV[1])
local found = {redis.call('ZCARD', noted)}
for _, key in ipairs(redis.call('ZREVRANGE', noted, 0, ARGV[2] - 1)) do
  table.insert(found, redis.call('HGET', key, 'note') or '')
end
return found
"""


class RedisState:
    """As `MemoryState`, shared by several processes; one hash per key, written by a Lua script.

    `url` is redis://HOST:PORT/DB (an invalid one raises InvalidInputError); it connects lazily.
    """

    def __init__(self, url: str) -> None:
        try:
            self._client = redis.asyncio.Redis.from_url(
                url,
                decode_responses=False,
                socket_connect_timeout=CONNECT_TIMEOUT_S,
                socket_timeout=ANSWER_TIMEOUT_S,
            )
        except ValueError as error:
            raise InvalidInputError(f"redis address: {error}") from error
        # Credentials in the URL are kept out of messages.
        self._where = url.rsplit("@", 1)[-1]
        self._compare_and_set = self._client.register_script(_SCRIPT_COMMON + COMPARE_AND_SET)
        self._add = self._client.register_script(_SCRIPT_COMMON + ADD)
        self._delete = self._client.register_script(_SCRIPT_COMMON + DELETE)
        self._newest_notes = self._client.register_script(_SCRIPT_COMMON + NEWEST_NOTES)

    async def get(self, key: str) -> Versioned | None:
        """See MemoryState."""
        version, value, tail, note = await self._call(
            "HMGET", REDIS_PREFIX + key, "version", "value", "tail", "note"
        )
        if version is None:
            return None
        return Versioned(value, int(version), tail or b"", note or b"")

    async def version(self, key: str) -> int:
        """See MemoryState."""
        return int(await self._call("HGET", REDIS_PREFIX + key, "version") or 0)

    async def note(self, key: str) -> bytes:
        """See MemoryState."""
        return await self._call("HGET", REDIS_PREFIX + key, "note") or b""

    async def newest_notes(self, group: str, limit: int) -> tuple[list[bytes], int]:
        """See MemoryState."""
        count, *notes = await self._answer(self._newest_notes(args=[group, limit]))
        return [note for note in notes if note], int(count)

    async def set(
        self,
        key: str,
        value: bytes,
        *,
        tail: bytes = b"",
        note: bytes = b"",
        expected_version: int,
        ttl_s: float,
    ) -> int:
        """See MemoryState."""
        written, version = await self._run(
            self._compare_and_set, key, expected_version, value, tail, _milliseconds(ttl_s), note
        )
        if not written:
            raise _version_conflict(key, expected=expected_version, got=int(version))
        return int(version)

    async def add(self, key: str, value: bytes, *, limits: Mapping[str, int], ttl_s: float) -> bool:
        """See MemoryState."""
        counted: list[Argument] = []
        for group, limit in limits.items():
            counted += [group, limit]
        added = await self._run(self._add, key, value, _milliseconds(ttl_s), *counted)
        if added < 0:
            stored = await self.get(key)
            raise _version_conflict(key, expected=0, got=stored.version if stored else 0)
        return bool(added)

    async def delete(self, key: str) -> bool:
        """See MemoryState."""
        return bool(await self._run(self._delete, key))

    async def ping(self) -> None:
        """Raise UnavailableError when the server cannot be reached."""
        await self._call("PING")

    async def close(self) -> None:
        """See MemoryState."""
        await self._client.aclose()

    async def _call(self, *command: Argument) -> Any:  # noqa: ANN401 - Redis answers by command
        return await self._answer(self._client.execute_command(*command))  # type: ignore[no-untyped-call]

    async def _run(self, script: AsyncScript, key: str, *arguments: Argument) -> Any:  # noqa: ANN401
        return await self._answer(script(keys=[REDIS_PREFIX + key], args=list(arguments)))

    async def _answer(self, pending: Awaitable[Any]) -> Any:  # noqa: ANN401
        task = asyncio.current_task()
        cancels_before = 0 if task is None else task.cancelling()
        try:
            answer = await pending
        except (RedisConnectionError, RedisTimeoutError, OSError) as error:
            raise UnavailableError(
                f"redis at {self._where}: {type(error).__name__}: {error}; is the server running?",
                retry_after_s=1,
            ) from error
        except ResponseError as error:
            raise StorageError(f"redis at {self._where}: {error}") from error
        except RedisError as error:
            raise UnavailableError(f"redis at {self._where}: {error}", retry_after_s=1) from error
        if task is not None and task.cancelling() > cancels_before:
            # redis-py 8.1 loses a cancellation that arrives while it acquires a connection.
            raise asyncio.CancelledError
        return answer


StateStore = MemoryState | RedisState


def open_state(url: str) -> StateStore:
    """The store at `memory://` or `redis://host:port/db`.

    Raises InvalidInputError for other URLs.
    """
    if url == "memory://":
        return MemoryState()
    if url.startswith(("redis://", "rediss://")):
        return RedisState(url)
    # The rest may hold a password.
    begin = url[:8]
    raise InvalidInputError(f"state: got {begin!r}…, expected memory:// or redis://HOST:PORT/DB")


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
