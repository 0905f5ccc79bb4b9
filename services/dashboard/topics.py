"""Live topics of the page, fetched only while somebody looks, once for all viewers."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

import structlog
from pydantic_core import to_json

logger = structlog.get_logger(__name__)

# A WebSocket message: text (JSON) or bytes.
Message = str | bytes


def topic_message(topic: str, data: object) -> str:
    """Encode a message of a topic as JSON; `data` may hold pydantic models."""
    return to_json({"topic": topic, "data": data}, inf_nan_mode="null").decode()


class Topic:
    """A topic: its newest messages, fetched at most once a period whatever the number of viewers.

    Args:
        name: of the topic.
        period_s: between two fetches.
        fetch: asks the services.
    """

    def __init__(
        self, name: str, period_s: float, fetch: Callable[[], Awaitable[list[Message]]]
    ) -> None:
        self.name = name
        self.period_s = period_s
        self._fetch = fetch
        self._messages: list[Message] = []
        self._due_s = float("-inf")
        self._fetching = asyncio.Lock()

    @classmethod
    def of_json(cls, name: str, period_s: float, read: Callable[[], Awaitable[object]]) -> "Topic":
        """A topic with one message, the JSON of what `read` returns."""

        async def fetch() -> list[Message]:
            return [topic_message(name, await read())]

        return cls(name, period_s, fetch)

    async def newest(self) -> list[Message]:
        """Messages that are at most a period old; the same list while nothing changes."""
        now_s = asyncio.get_running_loop().time
        async with self._fetching:
            if (started_s := now_s()) >= self._due_s:
                try:
                    messages = await self._fetch()
                    if messages != self._messages:
                        self._messages = messages
                except Exception:
                    # Supervisor of a feed: a bad response must not end the page's updates.
                    logger.exception("topic_failed", topic=self.name)
                self._due_s = started_s + self.period_s
            return self._messages

    async def updates(self) -> AsyncIterator[list[Message]]:
        """Messages at first and whenever they change; a slow viewer skips to the newest ones."""
        seen: list[Message] = []
        while True:
            messages = await self.newest()
            if messages and messages is not seen:
                seen = messages
                yield messages
            await asyncio.sleep(max(0.0, self._due_s - asyncio.get_running_loop().time()))
