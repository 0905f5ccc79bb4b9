"""News reach only those who look, are fetched only while someone looks, and never queue up."""

import asyncio

import pytest

from services.dashboard.topics import Topic, Viewer, running


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
    viewer = Viewer({"news": topic})
    viewer.look_at(["news"])
    for _ in range(3):
        await topic.refresh()
    assert await viewer.news() == ["3"]


async def test_late_viewer_gets_what_is_known(topic):
    await topic.refresh()
    viewer = Viewer({"news": topic})
    viewer.look_at(["news", "no such topic"])
    assert await viewer.news() == ["1"]


async def test_what_is_out_of_view_is_not_sent(topic):
    other = Topic("other", 0.0, Source().fetch)
    viewer = Viewer({"news": topic, "other": other})
    viewer.look_at(["news", "other"])
    viewer.look_at(["other"])
    await topic.refresh()
    await other.refresh()
    assert await viewer.news() == ["1"]
    assert viewer.changed.is_set() is False


async def test_fetching_rests_without_viewers(topic, source):
    viewer = Viewer({"news": topic})
    async with running([topic]):
        viewer.look_at(["news"])
        assert await viewer.news() == ["1"]
        viewer.look_at([])
        for _ in range(5):  # one fetch may be under way
            await asyncio.sleep(0)
        resting = source.count
        for _ in range(20):
            await asyncio.sleep(0)
        assert source.count == resting


async def test_a_failed_fetch_does_not_end_the_news(topic, source):
    source.fails = True
    viewer = Viewer({"news": topic})
    async with running([topic]):
        viewer.look_at(["news"])
        assert await viewer.news() == ["2"]
