"""What a viewer looks at in, its newest messages out: fetched only while someone looks."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import suppress

import structlog

logger = structlog.get_logger(__name__)

# What goes over a websocket: text (JSON) or bytes.
Message = str | bytes
Fetch = Callable[[], Awaitable[list[Message]]]


def topic_message(topic: str, data: object) -> str:
    """One JSON message of the live link."""
    return json.dumps({"topic": topic, "data": data}, allow_nan=False, separators=(",", ":"))


class Topic:
    """One kind of news: its newest messages, fetched every period while it has viewers."""

    def __init__(self, name: str, period_s: float, fetch: Fetch) -> None:
        self.name = name
        self.period_s = period_s
        self.messages: list[Message] = []
        self.version = 0
        self._fetch = fetch
        self._viewers: set[Viewer] = set()
        self._wanted = asyncio.Event()

    def add(self, viewer: "Viewer") -> None:
        """Someone looks; what is known is sent at once."""
        self._viewers.add(viewer)
        self._wanted.set()
        viewer.changed.set()

    def remove(self, viewer: "Viewer") -> None:
        """Nobody is left: fetching rests."""
        self._viewers.discard(viewer)
        if not self._viewers:
            self._wanted.clear()

    async def refresh(self) -> None:
        """Fetch once and wake the viewers if there is news."""
        messages = await self._fetch()
        if messages != self.messages:
            self.messages = messages
            self.version += 1
            for viewer in self._viewers:
                viewer.changed.set()

    async def run(self) -> None:
        """Keep fetching while wanted, never faster than the period; ends by cancellation."""
        loop = asyncio.get_running_loop()
        while True:
            await self._wanted.wait()
            started_s = loop.time()
            try:
                await self.refresh()
            except Exception:
                # The supervisor of a feed: one bad answer must not end the page's news for ever.
                logger.exception("topic_failed", topic=self.name)
            await asyncio.sleep(max(0.0, self.period_s - (loop.time() - started_s)))


class Viewer:
    """One open page: a slow one skips to the newest news, it never holds up the others."""

    def __init__(self, topics: Mapping[str, Topic]) -> None:
        self.changed = asyncio.Event()
        self._topics = topics
        self._seen: dict[str, int] = {}

    def look_at(self, names: Iterable[str]) -> None:
        """Replace what is in view; names that are no topics are ignored."""
        wanted = set(names) & set(self._topics)
        for name in set(self._seen) - wanted:
            self._topics[name].remove(self)
            del self._seen[name]
        for name in wanted - set(self._seen):
            self._seen[name] = 0
            self._topics[name].add(self)

    async def news(self) -> list[Message]:
        """Wait for something new and return it."""
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


async def run_topics(topics: Iterable[Topic], until_stopped: asyncio.Event) -> None:
    """Run all topics until told to stop."""
    tasks = [asyncio.create_task(topic.run()) for topic in topics]
    try:
        await until_stopped.wait()
    finally:
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError):
                await task
