"""News reach only those who look, are fetched only while someone looks, and never queue up."""

import asyncio

import pytest

from services.dashboard.feeds import Topic
from services.dashboard.routes import _topic


class Source:
    """Counts how often it is asked."""

    def __init__(self):
        self.count = 0
        self.fails = False

    async def fetch(self):
        self.count += 1
        if self.fails:
            self.fails = False
            raise RuntimeError("planted")
        return [str(self.count)]


@pytest.fixture
def source():
    return Source()


@pytest.fixture
def topic(source):
    return Topic("news", 0.0, source.fetch)


async def test_slow_viewer_gets_only_the_newest(topic):
    updates = topic.updates()
    assert await anext(updates) == ["1"]
    for _ in range(3):
        await topic.newest()
    assert await anext(updates) == ["5"]


async def test_what_does_not_change_is_not_sent_again():
    answers = iter(["a", "a", "a", "b"])

    async def fetch():
        return [next(answers)]

    updates = Topic("news", 0.0, fetch).updates()
    assert [await anext(updates), await anext(updates)] == [["a"], ["b"]]


async def test_viewers_share_one_fetch_a_period(source):
    topic = Topic("news", 3600.0, source.fetch)
    found = await asyncio.gather(*(anext(topic.updates()) for _ in range(5)))
    assert found == [["1"]] * 5
    assert source.count == 1


async def test_fetching_rests_without_viewers(topic, source):
    updates = topic.updates()
    await anext(updates)
    await updates.aclose()
    for _ in range(20):
        await asyncio.sleep(0)
    assert source.count == 1


async def test_a_viewer_that_leaves_while_it_fetches_leaves_nothing_old(source):
    entered, answer = asyncio.Event(), asyncio.Event()

    async def fetch():
        entered.set()
        await answer.wait()
        return await source.fetch()

    topic = Topic("news", 3600.0, fetch)
    leaving = asyncio.create_task(topic.newest())
    await entered.wait()
    staying = asyncio.create_task(topic.newest())
    await asyncio.sleep(0)
    leaving.cancel()
    answer.set()
    assert await staying == ["1"]


async def test_a_failed_fetch_does_not_end_the_news(topic, source):
    source.fails = True
    assert await anext(topic.updates()) == ["2"]


async def test_a_period_begins_when_its_fetch_begins(source, monkeypatch):
    """Each fetch takes 4 s of a clock that only the test moves."""
    now_s = [100.0]

    async def fetch():
        now_s[0] += 4.0
        return await source.fetch()

    topic = Topic("news", 10.0, fetch)
    monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: now_s[0])
    for at_s, expected in ((100.0, "1"), (109.9, "1"), (110.0, "2"), (119.9, "2")):
        now_s[0] = at_s
        assert await topic.newest() == [expected]


async def test_a_source_that_fails_is_asked_again_after_a_period_too(source):
    topic = Topic("news", 3600.0, source.fetch)
    source.fails = True
    assert [await topic.newest() for _ in range(3)] == [[], [], []]
    assert source.count == 1


def test_the_first_finder_of_a_name_gives_its_topic(topic):
    def other(name):
        raise AssertionError(f"a later finder was called for {name}")

    assert _topic("news", ({}.get, {"news": topic}.get, other)) is topic
    assert _topic("none", ({}.get,)) is None
