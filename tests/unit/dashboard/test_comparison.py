"""Replay in two worlds at once: the actions sent, the worlds that are refused, the errors."""

import asyncio
from contextlib import AsyncExitStack
from dataclasses import replace

import httpx
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry.rotations import rotation_from_6d
from dextouch.hands.actions import unpack_action
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import EVERYTHING
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.dashboard import comparison, hand_driving
from services.dashboard.comparison import Comparisons, StartComparison, compared
from services.dashboard.comparison_sides import fitted
from services.dashboard.feeds import Feeds
from services.dashboard.hand_driving import Moves
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.worlds.fakes import observation

EPISODE = toy.demonstration("reach", 3)
REPLAY = StartComparison(episode_id=EPISODE.episode_id)


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
    """Replay an episode in two worlds, or drive them; returns the comparison's last view."""
    folder = str(tmp_path / "store")
    write(EpisodeStore(folder), EPISODE)
    of_a_station = {"seed": None, "origin": "recorded"}
    # In the scene of seed 0, which a rollout without a seed has.
    write(EpisodeStore(folder), toy.demonstration("reach", 0, name="of-a-station"), **of_a_station)
    async with AsyncExitStack() as running:

        async def upstream(name, app):
            await running.enter_async_context(app.router.lifespan_context(app))
            client = httpx.AsyncClient(
                transport=httpx.ASGITransport(app), base_url="http://127.0.0.1"
            )
            return Upstream(name, await running.enter_async_context(client))

        async def run(twin, model, asked=REPLAY, drive=None):
            apps = {
                "episode_store": create_store(EpisodeStoreSettings(store_url=folder)),
                "twin": create_world_app({"twin": twin}, WorldServiceSettings()),
                "world_model": create_world_app({"dream": model}, WorldServiceSettings()),
            }
            feeds = Feeds(
                {name: await upstream(name, app) for name, app in apps.items()}, DashboardSettings()
            )
            comparisons = Comparisons(feeds, period_s=1.0)
            begun = await comparisons.start(asked)
            if drive is not None:
                await drive(comparisons, begun)
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


async def test_an_episode_of_a_station_is_compared_with_its_recording(compare):
    """The twin cannot place its objects; the toy model imagines exactly what was recorded."""
    twin, model = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)
    view = await compare(twin, model, StartComparison(episode_id="of-a-station"))
    assert (view.state, view.worlds) == ("finished", {"real": "recording", "imagined": "dream"})
    assert (twin.rows, len(model.rows), view.real_success) == ([], toy.STEPS - 1, True)
    assert view.num_steps == 80
    np.testing.assert_array_equal(view.pixel_error, np.zeros(toy.STEPS))


async def test_a_part_of_a_recording_has_no_outcome(compare, monkeypatch):
    monkeypatch.setattr(comparison, "MAX_STEPS", 76)
    worlds = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)
    view = await compare(*worlds, StartComparison(episode_id="of-a-station"))
    assert (view.num_steps, view.real_success) == (76, None)


async def test_of_two_that_begin_at_once_one_is_ended(compare):
    worlds = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)
    runs = []

    async def drive(comparisons, _):
        ends = comparisons._supervise

        async def supervise(run, actions):
            runs.append(run)
            await ends(run, actions)

        comparisons._supervise = supervise
        asked = StartComparison(task="reach")
        await asyncio.gather(*(comparisons.start(asked) for _ in range(2)))
        await asyncio.gather(comparisons.stop(), comparisons.stop())
        assert [run.view.state for run in runs] == ["stopped", "stopped"]

    view = await compare(*worlds, StartComparison(task="reach"), drive)
    assert view.id == runs[-1].view.id


async def test_one_that_is_over_ends_its_rollouts_though_stopped_meanwhile(compare, monkeypatch):
    ending, allowed, ended = asyncio.Event(), asyncio.Event(), []

    async def end(side):
        ending.set()
        await allowed.wait()
        ended.append(side.name)

    async def drive(comparisons, _):
        await ending.wait()
        stopping = asyncio.create_task(comparisons.stop())
        await asyncio.sleep(0)
        allowed.set()
        await stopping

    monkeypatch.setattr(comparison.WorldSide, "end", end)
    await compare(NotedWorld("twin", judge=True), NotedWorld("dream", judge=False), drive=drive)
    assert ended == ["twin", "dream"]


class SharingWorld(NotedWorld):
    """Reports how much of its bound every chunk uses."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed, selector=selector)
        return replace(stepped, info={"uncertainty/bound_share": state.step / 40})


async def test_uncertainty_is_known_as_often_as_the_worlds_allow(compare):
    view = await compare(NotedWorld("twin", judge=True), SharingWorld("dream", judge=False))
    spans = [(one.first_step, one.last_step) for one in view.uncertainties]
    assert spans == [(first, first + 3) for first in range(1, 81, 4)]
    assert [one.bound_share for one in view.uncertainties] == [
        step / 40 for step in range(0, 80, 4)
    ]


async def test_hands_are_moved_in_both_worlds_within_their_speed(compare, monkeypatch):
    twin, model = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)

    built = []
    monkeypatch.setattr(
        hand_driving, "RobotHand", lambda side: built.append(side) or RobotHand(side)
    )

    async def drive(comparisons, begun):
        for move in ({"right": 1.0, "up": 1.0, "close": 1.0}, {"turn": -1.0}, {}):
            moves = Moves.model_validate({"hands": {"right": move}})
            view = await comparisons.move(begun.id, moves)
        assert view.num_chunks == 4
        with pytest.raises(NotFoundError, match="it is over"):
            await comparisons.move("x", moves)
        await comparisons.stop()

    view = await compare(twin, model, StartComparison(task="reach", seed=5), drive)
    assert (view.state, len(view.pixel_error)) == ("stopped", 13)
    assert built == ["left", "right"]
    rows = unpack_action(np.array(twin.rows))
    np.testing.assert_array_equal(twin.rows, model.rows)
    places_m = rows.wrist_right[:, :3]
    steps_m = np.linalg.norm(np.diff(places_m, axis=0, prepend=np.zeros((1, 3))), axis=1)
    # 0.25 m/s at 15 steps a second, along the diagonal of two axes; then none.
    np.testing.assert_allclose(steps_m, [0.25 / 15] * 4 + [0] * 8, atol=1e-12)
    # The toy's camera has the axes of its world, whose z is up.
    np.testing.assert_allclose(places_m[3], [4 / 15 * 0.25 / 2**0.5, 0, 4 / 15 * 0.25 / 2**0.5])
    turned = Rotation.from_matrix(rotation_from_6d(rows.wrist_right[:, 3:])).as_rotvec()
    np.testing.assert_allclose(turned[:4], np.zeros((4, 3)), atol=1e-12)
    np.testing.assert_allclose(turned[7], [0, 0, 4 / 15 * 1.5], atol=1e-12)
    joints, hand = rows.joints_right_rad, RobotHand("right")
    assert np.abs(np.diff(joints, axis=0)).max() <= 2.0 / 15 + 1e-12
    assert joints[3].max() == pytest.approx(4 * 2.0 / 15)
    assert (joints <= hand.upper_rad).all()
    np.testing.assert_array_equal(rows.wrist_left, np.tile(EPISODE.commanded[0][:9], (12, 1)))


async def test_hands_that_nobody_moves_are_given_back(compare, monkeypatch):
    monkeypatch.setattr(comparison, "LEASE_S", 0.05)
    worlds = NotedWorld("twin", judge=True), NotedWorld("dream", judge=False)
    view = await compare(*worlds, StartComparison(task="reach"))
    assert (view.state, view.note) == ("finished", "Nobody moved the hands for 0 s.")


@pytest.mark.parametrize(("shape", "size"), [((4, 6), (2, 2)), ((8, 8), (2, 2)), ((4, 4), (4, 4))])
def test_images_of_another_size_keep_their_middle(shape, size):
    images = np.arange(np.prod(shape), dtype=np.uint8).reshape(1, *shape, 1).repeat(3, axis=-1)
    wanted = Image.fromarray(images[0]).crop(
        ((shape[1] - shape[0]) / 2, 0, (shape[1] + shape[0]) / 2, shape[0])
    )
    expected = np.asarray(wanted.resize(size, Image.Resampling.NEAREST))
    np.testing.assert_array_equal(fitted(images, size)[0], expected)


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
