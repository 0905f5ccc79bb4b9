"""Live topics of the page, polled only while they have viewers."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from contextlib import asynccontextmanager

import structlog
from pydantic_core import to_json

logger = structlog.get_logger(__name__)

# A WebSocket message: text (JSON) or bytes.
Message = str | bytes
Fetch = Callable[[], Awaitable[list[Message]]]


def topic_message(topic: str, data: object) -> str:
    """Encode a message of a topic as JSON; `data` may hold pydantic models."""
    return to_json({"topic": topic, "data": data}, inf_nan_mode="null").decode()


class Topic:
    """A topic: its newest messages, fetched every period while it has viewers."""

    def __init__(self, name: str, period_s: float, fetch: Fetch) -> None:
        self.name = name
        self.period_s = period_s
        self.messages: list[Message] = []
        self.version = 0
        self._fetch = fetch
        self._viewers: set[Viewer] = set()
        self._wanted = asyncio.Event()

    @classmethod
    def of_json(cls, name: str, period_s: float, read: Callable[[], Awaitable[object]]) -> "Topic":
        """A topic with one message, the JSON of what `read` returns."""

        async def fetch() -> list[Message]:
            return [topic_message(name, await read())]

        return cls(name, period_s, fetch)

    def add(self, viewer: "Viewer") -> None:
        """Add a viewer, which gets the current messages at once."""
        self._viewers.add(viewer)
        self._wanted.set()
        viewer.changed.set()

    def remove(self, viewer: "Viewer") -> None:
        """Remove a viewer; without viewers fetching pauses."""
        self._viewers.discard(viewer)
        if not self._viewers:
            self._wanted.clear()

    async def refresh(self) -> None:
        """Fetch once, and notify viewers of changes."""
        messages = await self._fetch()
        if messages != self.messages:
            self.messages = messages
            self.version += 1
            for viewer in self._viewers:
                viewer.changed.set()

    async def run(self) -> None:
        """Poll while there are viewers, at most once per period; runs until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            await self._wanted.wait()
            started_s = loop.time()
            try:
                await self.refresh()
            except Exception:
                # Supervisor of a feed: a bad response must not end the page's updates.
                logger.exception("topic_failed", topic=self.name)
            await asyncio.sleep(max(0.0, self.period_s - (loop.time() - started_s)))


class Viewer:
    """An open page; a slow one skips to the newest messages without delaying others."""

    def __init__(self, topics: Mapping[str, Topic]) -> None:
        self.changed = asyncio.Event()
        self._topics = topics
        self._seen: dict[str, int] = {}

    def look_at(self, names: Iterable[str]) -> None:
        """Replace the topics in view; unknown names are ignored."""
        wanted = set(names) & set(self._topics)
        for name in set(self._seen) - wanted:
            self._topics[name].remove(self)
            del self._seen[name]
        for name in wanted - set(self._seen):
            self._seen[name] = 0
            self._topics[name].add(self)

    async def news(self) -> list[Message]:
        """Wait for new messages and return them."""
        while True:
            await self.changed.wait()
            self.changed.clear()
            messages: list[Message] = []
            for name, seen in self._seen.items():
                topic = self._topics[name]
                if topic.version != seen:
                    self._seen[name] = topic.version
                    messages.extend(topic.messages)
            if messages:
                return messages


@asynccontextmanager
async def running(topics: Iterable[Topic]) -> AsyncIterator[None]:
    """Context manager that polls all topics meanwhile."""
    tasks = [asyncio.create_task(topic.run()) for topic in topics]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
