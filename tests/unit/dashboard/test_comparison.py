"""Replay in two worlds at once: the actions sent, the worlds that are refused, the errors."""

from contextlib import AsyncExitStack
from dataclasses import replace

import httpx
import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.schemas import EVERYTHING
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.dashboard.comparison import Comparisons, compared
from services.dashboard.feeds import Feeds
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.worlds.fakes import observation

EPISODE = toy.demonstration("reach", 3)


class NotedWorld(toy.ToyWorld):
    """Keeps the actions that it was sent; its description can differ from that of the toy."""

    def __init__(self, name, *, judge, **described):
        super().__init__(name, judge=judge)
        self.rows = []
        self.description = self.description.model_copy(update=described)

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        self.rows.extend(actions)
        return super().step(state, actions, seed=seed, selector=selector)


@pytest.fixture
async def compare(tmp_path):
    """Replay the episode in two worlds; returns the comparison's last view."""
    folder = str(tmp_path / "store")
    write(EpisodeStore(folder), EPISODE)
    async with AsyncExitStack() as running:

        async def upstream(name, app):
            await running.enter_async_context(app.router.lifespan_context(app))
            client = httpx.AsyncClient(
                transport=httpx.ASGITransport(app), base_url="http://127.0.0.1"
            )
            return Upstream(name, await running.enter_async_context(client))

        async def run(twin, model):
            apps = {
                "episode_store": create_store(EpisodeStoreSettings(store_url=folder)),
                "twin": create_world_app({"twin": twin}, WorldServiceSettings()),
                "world_model": create_world_app({"dream": model}, WorldServiceSettings()),
            }
            feeds = Feeds(
                {name: await upstream(name, app) for name, app in apps.items()}, DashboardSettings()
            )
            comparisons = Comparisons(feeds, period_s=1.0)
            await comparisons.start(EPISODE.episode_id)
            await comparisons._run.task
            return await comparisons.newest()

        yield run


async def test_both_worlds_get_the_actions_after_the_start(compare):
    twin, model = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)
    view = await compare(twin, model)
    assert (view.state, view.note, view.num_steps) == ("finished", "", toy.STEPS - 1)
    for world in (twin, model):
        np.testing.assert_array_equal(world.rows, EPISODE.commanded[1:])
    # The worlds are the same, as long as they are sent the same.
    assert view.pixel_error == (0.0,) * toy.STEPS


@pytest.mark.parametrize(
    "described",
    [{"model_rate_hz": 30.0}, {"image_height_px": 64}, {"image_width_px": 64}],
    ids=lambda one: next(iter(one)),
)
async def test_worlds_that_differ_in_rate_or_size_are_refused(compare, described):
    with pytest.raises(InvalidInputError, match="expected the same"):
        await compare(NotedWorld("twin", judge=True), NotedWorld("dream", judge=False, **described))


@pytest.mark.parametrize(("truth", "guess"), [(10, 250), (250, 10)])
def test_the_pixel_error_is_as_large_as_bytes_allow(truth, guess):
    real, imagined = (
        replace(observation(), images={"camera_head": np.full((1, 8, 8, 3), value, np.uint8)})
        for value in (truth, guess)
    )
    errors, _ = compared(real, imagined)
    assert errors["pixel_error"] == (240.0,)
