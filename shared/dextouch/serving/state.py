"""Versioned key-value state shared by processes (rollouts, leases), in memory or in Redis."""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

import redis.asyncio
from redis.commands.core import AsyncScript
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError

from dextouch.errors import ConflictError, InvalidInputError, StorageError, UnavailableError

REDIS_PREFIX = "dextouch:state:"
CONNECT_TIMEOUT_S = 2.0
ANSWER_TIMEOUT_S = 10.0

Argument = str | bytes | int | float


@dataclass(frozen=True)
class Versioned:
    """A value in two parts, its version, which starts at 1 and counts writes, and a short note."""

    value: bytes
    version: int
    tail: bytes = b""
    note: bytes = b""


class MemoryState:
    """Expiring values of one process, with compare-and-set writes, so that no update is lost."""

    def __init__(self, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._entries: dict[str, tuple[Versioned, float]] = {}
        # No entry expires earlier.
        self._expires_s = math.inf

    async def get(self, key: str) -> Versioned | None:
        """The value, or None when absent or expired."""
        self._expire()
        entry = self._entries.get(key)
        return None if entry is None else entry[0]

    async def version(self, key: str) -> int:
        """The version that `get` would return, without the value; 0 when absent or expired."""
        stored = await self.get(key)
        return 0 if stored is None else stored.version

    async def notes(self, prefix: str) -> dict[str, bytes]:
        """Notes of all keys that begin with a prefix, without their values."""
        self._expire()
        return {
            key: stored.note
            for key, (stored, _) in self._entries.items()
            if stored.note and key.startswith(prefix)
        }

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

        Args:
            key: of the entry.
            value: its first part.
            tail: its second part, such as megabytes that are not to be copied behind the first.
            note: a few bytes about it, which `notes` lists without reading the value.
            expected_version: that the new value was computed from.
            ttl_s: seconds until it expires.

        Returns:
            The new version.

        Raises:
            ConflictError: another version is stored; see `expected` and `got`.
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
        return written.version

    async def add(self, key: str, value: bytes, *, limits: Mapping[str, int], ttl_s: float) -> bool:
        """Write a new value unless a limit is reached; False if one is.

        Counting and writing are atomic, so concurrent callers never exceed a limit.

        Args:
            key: of the value.
            value: to write.
            limits: for beginnings of keys, the number of live keys that may begin so.
            ttl_s: time to live.

        Raises:
            ConflictError: the key exists.
        """
        # No await between counting and writing, hence atomic in one event loop.
        self._expire()
        is_full = any(
            sum(other.startswith(within) for other in self._entries) >= limit
            for within, limit in limits.items()
        )
        if key not in self._entries and is_full:
            return False
        await self.set(key, value, expected_version=0, ttl_s=ttl_s)
        return True

    async def delete(self, key: str) -> bool:
        """Delete a key; False if absent."""
        self._expire()
        return self._entries.pop(key, None) is not None

    async def ping(self) -> None:
        """Always succeeds; drops what has expired, also where nobody asks for it again."""
        self._expire()

    async def close(self) -> None:
        """Drop all values."""
        self._entries.clear()

    def _expire(self) -> None:
        now_s = self._clock_s()
        if now_s < self._expires_s:
            return
        gone = [key for key, (_, until_s) in self._entries.items() if until_s <= now_s]
        for key in gone:
            del self._entries[key]
        self._expires_s = min((until_s for _, until_s in self._entries.values()), default=math.inf)


# KEYS[1] key · ARGV: expected version, value, tail, time to live in ms, note
# → {1, new} or {0, stored}
COMPARE_AND_SET = """
local version = tonumber(redis.call('HGET', KEYS[1], 'version') or '0')
if version ~= tonumber(ARGV[1]) then return {0, version} end
redis.call('HSET', KEYS[1], 'version', version + 1, 'value', ARGV[2], 'tail', ARGV[3],
  'note', ARGV[5])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
return {1, version + 1}
"""

# KEYS[1] key · ARGV: value, time to live in ms, then pairs of a pattern of keys and their limit
# → -1: stored already, 0: no room, 1: written
ADD = """
if redis.call('EXISTS', KEYS[1]) == 1 then return -1 end
for i = 3, #ARGV, 2 do
  if #redis.call('KEYS', ARGV[i]) >= tonumber(ARGV[i + 1]) then return 0 end
end
redis.call('HSET', KEYS[1], 'version', 1, 'value', ARGV[1])
redis.call('PEXPIRE', KEYS[1], ARGV[2])
return 1
"""

# ARGV: pattern of keys → key, note, key, note …
NOTES = """
local found = {}
for _, key in ipairs(redis.call('KEYS', ARGV[1])) do
  local note = redis.call('HGET', key, 'note')
  if note and note ~= '' then table.insert(found, key) table.insert(found, note) end
end
return found
"""


class RedisState:
    """As `MemoryState`, shared by several processes; one hash per key, written by a Lua script.

    Args:
        url: redis://HOST:PORT/DB; connects lazily.

    Raises:
        InvalidInputError: an invalid URL.
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
        self._compare_and_set = self._client.register_script(COMPARE_AND_SET)
        self._add = self._client.register_script(ADD)
        self._notes = self._client.register_script(NOTES)

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

    async def notes(self, prefix: str) -> dict[str, bytes]:
        """See MemoryState."""
        found = await self._answer(self._notes(args=[_literal(REDIS_PREFIX + prefix) + "*"]))
        keys = [key.decode().removeprefix(REDIS_PREFIX) for key in found[::2]]
        return dict(zip(keys, found[1::2], strict=True))

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
        for within, limit in limits.items():
            counted += [_literal(REDIS_PREFIX + within) + "*", limit]
        added = await self._run(self._add, key, value, _milliseconds(ttl_s), *counted)
        if added < 0:
            stored = await self.get(key)
            raise _version_conflict(key, expected=0, got=stored.version if stored else 0)
        return bool(added)

    async def delete(self, key: str) -> bool:
        """See MemoryState."""
        return bool(await self._call("DEL", REDIS_PREFIX + key))

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
    """Open the store at `memory://` or `redis://host:port/db`.

    Raises:
        InvalidInputError: an unsupported URL.
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


def _literal(text: str) -> str:
    """Escape a text to a Redis pattern that matches only itself."""
    return "".join("\\" + letter if letter in "*?[]^\\" else letter for letter in text)
