"""Redis connection with binary replies and mapped errors; the only user of redis-py."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import redis.asyncio
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError

from dextouch.errors import InvalidInputError, StorageError, UnavailableError

CONNECT_TIMEOUT_S = 2.0
ANSWER_TIMEOUT_S = 10.0

Argument = str | bytes | int | float
Script = Callable[[Sequence[str], Sequence[Argument]], Awaitable[Any]]


class RedisLink:
    """A connection pool."""

    def __init__(self, client: "redis.asyncio.Redis", url: str) -> None:
        self._client = client
        # Credentials in the URL are kept out of messages.
        self._where = url.rsplit("@", 1)[-1]

    async def call(self, *command: Argument) -> Any:  # noqa: ANN401 - Redis answers by command
        """Execute a command; strings are returned as bytes."""
        task = asyncio.current_task()
        cancels_before = 0 if task is None else task.cancelling()
        with self._as_our_errors():
            answer = await self._client.execute_command(*command)  # type: ignore[no-untyped-call]
        if task is not None and task.cancelling() > cancels_before:
            # redis-py 8.1 loses a cancellation that arrives while it acquires a connection.
            raise asyncio.CancelledError
        return answer

    def script(self, source: str) -> Script:
        """Register a Lua script, which runs atomically, as a function of keys and arguments."""
        registered = self._client.register_script(source)

        async def run(keys: Sequence[str], arguments: Sequence[Argument]) -> Any:  # noqa: ANN401
            with self._as_our_errors():
                return await registered(keys=list(keys), args=list(arguments))

        return run

    async def close(self) -> None:
        """Close every connection."""
        await self._client.aclose()

    @contextmanager
    def _as_our_errors(self) -> Iterator[None]:
        try:
            yield
        except (RedisConnectionError, RedisTimeoutError, OSError) as error:
            raise UnavailableError(
                f"redis at {self._where}: {type(error).__name__}: {error}; is the server running?",
                retry_after_s=1,
            ) from error
        except ResponseError as error:
            raise StorageError(f"redis at {self._where}: {error}") from error
        except RedisError as error:
            raise UnavailableError(f"redis at {self._where}: {error}", retry_after_s=1) from error


def open_redis(url: str) -> RedisLink:
    """Open redis://HOST:PORT/DB; connects lazily.

    Raises:
        InvalidInputError: an invalid URL.
    """
    try:
        client = redis.asyncio.Redis.from_url(
            url,
            decode_responses=False,
            socket_connect_timeout=CONNECT_TIMEOUT_S,
            socket_timeout=ANSWER_TIMEOUT_S,
        )
    except ValueError as error:
        raise InvalidInputError(f"redis address: {error}") from error
    return RedisLink(client, url)
