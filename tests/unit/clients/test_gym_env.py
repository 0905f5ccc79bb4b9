"""The gymnasium environments: gymnasium's own checker and vector, matched seeds, ends, masks."""

import sys
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from dextouch.clients import RolloutClient
from dextouch.clients.gym_env import ENV_ID, RolloutEnv, WorldEnv, WorldVectorEnv, make_vector
from dextouch.errors import InvalidInputError, UnavailableError, UnknownNameError
from dextouch.schemas import ReturnSelector
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from tests.unit.worlds.fakes import K_HEAD, SumWorld, actions, anchor, observation
from tests.unit.worlds.running import served

ASKED = {"task": "stand_bottle", "instruction": "stand the bottle"}


@pytest.fixture(scope="module")
def url():
    world = SumWorld()
    worlds = {"sum": world, "copy-first": CopyFirstWorld.beside(world.description)}
    with served(create_world_app(worlds, WorldServiceSettings())) as address:
        yield address


@pytest.fixture(scope="module")
def client(url):
    with RolloutClient(url) as opened:
        yield opened


@pytest.fixture
def make_envs(url):
    """Several single environments, each with its own client."""
    with ExitStack() as opened:

        def make(num_envs, kind=WorldEnv, **given):
            given = {"world": "sum", "chunk_steps": 4, "max_chunks": 3} | ASKED | given
            clients = [opened.enter_context(RolloutClient(url)) for _ in range(num_envs)]
            return [kind(each, **given) for each in clients]

        yield make


@pytest.fixture
def vector(make_envs):
    made = WorldVectorEnv(make_envs(3))
    yield made
    made.close()


@pytest.fixture
def env(client):
    made = WorldEnv(client, world="sum", chunk_steps=4, max_chunks=3, **ASKED)
    yield made
    made.close()


def test_gymnasium_accepts_it(env):
    check_env(env, skip_render_check=True)


@pytest.fixture
def made(url):
    """The registered environment, found by the name of its module."""
    opened = []

    def make(**options):
        given = {"world": "sum", "chunk_steps": 4, "max_chunks": 3} | ASKED | options
        opened.append(gymnasium.make(f"dextouch.clients.gym_env:{ENV_ID}", url=url, **given))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


def test_gymnasium_makes_it_by_name_and_accepts_its_images(made):
    env = made(render_mode="rgb_array")
    assert isinstance(env.unwrapped, WorldEnv)
    # Makes it again in each of its render modes.
    check_env(env.unwrapped)
    seen, _ = env.reset(seed=3)
    cameras = env.unwrapped.description.cameras
    np.testing.assert_array_equal(
        env.render(), np.concatenate([seen[name] for name in cameras], axis=1)
    )
    assert env.metadata["render_fps"] == 15 / 4


@pytest.mark.parametrize("cameras", [("camera_wrist_left",), ()])
def test_observations_are_of_the_cameras_that_the_client_selects(client, cameras):
    few = client.selecting(ReturnSelector(cameras=cameras, steps="last"))
    mode = "rgb_array" if cameras else None
    env = WorldEnv(few, world="sum", chunk_steps=4, max_chunks=3, render_mode=mode, **ASKED)
    check_env(env, skip_render_check=True)
    seen, _ = env.reset(seed=3)
    assert {*seen} == {*cameras, "tactile_kpa", "action_reached"}
    if cameras:
        np.testing.assert_array_equal(env.render(), seen[cameras[0]])
    else:
        with pytest.raises(InvalidInputError, match="has no camera"):
            WorldEnv(few, world="sum", render_mode="rgb_array", **ASKED)
    env.close()


def test_a_list_has_every_step_of_the_chunk_once(made):
    env = made(render_mode="rgb_array_list")
    assert env.metadata["render_fps"] == 15
    env.reset(seed=3)
    assert [len(env.render()), len(env.render())] == [1, 0]
    seen, *_ = env.step(actions(4))
    images = env.render()
    assert len(images) == 4
    np.testing.assert_array_equal(
        images[-1][:, : seen["camera_head"].shape[1]], seen["camera_head"]
    )


def test_gymnasium_records_videos_of_it(made, tmp_path, monkeypatch):
    # What encodes the images is left out: moviepy brings 68 MB of ffmpeg.
    clips = []

    class ImageSequenceClip:
        def __init__(self, images, fps):
            clips.append((images, fps))

        def write_videofile(self, path, **_):
            Path(path).touch()

    name = "moviepy.video.io.ImageSequenceClip"
    for module in ("moviepy", "moviepy.video", "moviepy.video.io", name):
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
    monkeypatch.setattr(sys.modules[name], "ImageSequenceClip", ImageSequenceClip, raising=False)
    env = RecordVideo(made(render_mode="rgb_array"), str(tmp_path / "videos"))
    env.reset(seed=3)
    first, ended = env.unwrapped.render(), False
    while not ended:
        *_, terminated, truncated, _ = env.step(actions(4))
        ended = terminated or truncated
    last = env.unwrapped.render()
    env.close()
    ((images, fps),) = clips
    # The start, and the end of three chunks.
    assert len(images) == 4
    assert fps == 15 / 4
    np.testing.assert_array_equal(images[0], first)
    np.testing.assert_array_equal(images[-1], last)
    assert len({image.shape for image in images}) == 1
    assert images[0].dtype == np.uint8


def test_success_ends_and_length_truncates(env):
    env.reset(seed=0)
    outcomes = [env.step(actions(4))[1:4] for _ in range(3)]
    assert outcomes == [(0.0, False, False), (0.0, False, False), (0.0, False, True)]
    _, info = env.reset(seed=99)
    assert info["success"] is False
    seen, reward, terminated, truncated, info = env.step(actions(4, 10.0))
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert info["last_step"] == 4
    assert seen["tactile_kpa"].min() > 100


def test_a_rollout_that_its_world_ends_is_truncated(env):
    env.reset(seed=0)
    before, *_, info = env.step(actions(4))
    assert (info["ended"], info["uncertainty"], info["rollout_uncertainty"]) == (None, None, None)
    seen, reward, terminated, truncated, info = env.step(actions(4, 4e6))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["ended"] == "too many to count"
    np.testing.assert_array_equal(seen["tactile_kpa"], before["tactile_kpa"])


def test_without_a_seed_starts_differ(env):
    first, _ = env.reset()
    second, _ = env.reset()
    assert first["tactile_kpa"][0, 0] != second["tactile_kpa"][0, 0]


def test_it_can_begin_from_an_observation(client):
    env = WorldEnv(client, world="copy-first", chunk_steps=4, **ASKED)
    first = observation(seed=9)
    seen, _ = env.reset(seed=1, options={"init": (first, anchor(), K_HEAD)})
    np.testing.assert_array_equal(seen["tactile_kpa"], first.tactile_kpa[0])
    env.close()


def test_wrong_use_is_named(client, env):
    with pytest.raises(UnknownNameError, match="valid: copy-first, sum"):
        WorldEnv(client, world="moon", **ASKED)
    with pytest.raises(InvalidInputError, match="multiple of 4"):
        WorldEnv(client, world="sum", chunk_steps=6, **ASKED)
    with pytest.raises(UnknownNameError, match="valid: rgb_array, rgb_array_list"):
        WorldEnv(client, world="sum", render_mode="depth", **ASKED)
    with pytest.raises(InvalidInputError, match="call reset first"):
        env.step(actions(4))
    with pytest.raises(UnknownNameError, match="valid: init"):
        env.reset(options={"start": None})


@pytest.mark.long
def test_abandoned_episodes_are_ended_at_the_service(client):
    env = WorldEnv(client, world="sum", chunk_steps=4, **ASKED)
    for seed in range(100):  # More than the service keeps alive.
        env.reset(seed=seed)
    env.close()


def assert_equal(ours, theirs):
    """Equal in keys, dtypes, shapes and values."""
    if isinstance(theirs, dict):
        assert list(ours) == list(theirs)
        for name in theirs:
            assert_equal(ours[name], theirs[name])
    elif isinstance(theirs, tuple):
        for one, other in zip(ours, theirs, strict=True):
            assert_equal(one, other)
    else:
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
        np.testing.assert_array_equal(ours, theirs)


def test_the_vector_is_that_of_gymnasium(make_envs, vector):
    """SyncVectorEnv of the same single environments, which steps one after the other."""
    makers = [lambda env=env: env for env in make_envs(3)]
    theirs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
    assert vector.metadata == theirs.metadata
    assert vector.observation_space == theirs.observation_space
    assert vector.action_space == theirs.action_space
    assert_equal(vector.reset(seed=[97, 3, 98]), theirs.reset(seed=[97, 3, 98]))
    chunks = np.stack([actions(4), actions(4), actions(4, 10.0)])
    ours = vector.step(chunks)
    assert_equal(ours, theirs.step(chunks))
    terminations, truncations = ours[2:4]
    assert terminations.tolist() == [False, False, True]
    mask = terminations | truncations
    for _ in range(2):
        with pytest.raises(InvalidInputError, match=r"environments \[2\] have no episode"):
            vector.step(chunks)
    again = [one.reset(seed=40, options={"reset_mask": mask.copy()}) for one in (vector, theirs)]
    assert_equal(*again)
    rest = np.stack([actions(4)] * 3)
    assert_equal(vector.step(rest), theirs.step(rest))
    theirs.close()


def test_the_vector_keeps_gymnasiums_promises(vector):
    first, info = vector.reset(seed=5)
    assert vector.observation_space.contains(first)
    kept = {name: array.copy() for name, array in first.items()}
    vector.action_space.seed(1)
    assert vector.action_space.contains(np.stack([actions(4)] * 3))
    seen, rewards, *_ = vector.step(np.stack([actions(4, 0.2)] * 3))
    assert vector.observation_space.contains(seen)
    assert rewards.dtype == np.float64
    assert_equal(first, kept)
    assert_equal(vector.reset(seed=5), (first, info))
    wrapped = DictInfoToList(RecordEpisodeStatistics(vector))
    _, infos = wrapped.reset(seed=5)
    assert [one["last_step"] for one in infos] == [0, 0, 0]


def test_the_vector_steps_all_at_the_same_time(make_envs):
    meet = threading.Barrier(4, timeout=30)

    class Meeting(WorldEnv):
        def reset(self, **given):
            meet.wait()
            return super().reset(**given)

        def step(self, action):
            meet.wait()
            return super().step(action)

    env = WorldVectorEnv(make_envs(4, Meeting))
    env.reset(seed=0)
    env.step(np.stack([actions(4)] * 4))
    env.close()


def test_each_of_the_vector_begins_from_its_own_observation(make_envs):
    env = WorldVectorEnv(make_envs(2, world="copy-first"))
    starts = [observation(seed=7), observation(seed=8)]
    inits = [(start, anchor(), K_HEAD) for start in starts]
    seen, _ = env.reset(seed=1, options={"inits": inits})
    for tactile_kpa, start in zip(seen["tactile_kpa"], starts, strict=True):
        np.testing.assert_array_equal(tactile_kpa, start.tactile_kpa[0])
    env.close()


@pytest.fixture
def closed(monkeypatch):
    """Clients that were closed."""
    clients, close = [], RolloutClient.close
    monkeypatch.setattr(RolloutClient, "close", lambda one: (clients.append(one), close(one)))
    return clients


def test_an_environment_that_cannot_be_made_leaves_no_client_open(url, closed):
    for num_failed, make in enumerate([RolloutEnv, partial(make_vector, num_envs=2)], start=1):
        with pytest.raises(UnknownNameError, match="moon"):
            make(url=url, world="moon", **ASKED)
        assert len(closed) == num_failed


def test_everything_is_closed_where_the_service_is_gone(url, closed, monkeypatch):
    vector = make_vector(num_envs=2, url=url, world="sum", chunk_steps=4, **ASKED)
    vector.reset(seed=0)
    gone = Mock(side_effect=UnavailableError("the service does not answer"))
    monkeypatch.setattr("dextouch.clients.rollouts.Rollout.close", gone)
    vector.close()
    assert (gone.call_count, len(closed)) == (2, 2)
    assert vector._threads._shutdown


def test_make_vec_gives_starts_that_are_asked_for(url):
    given = {"url": url, "world": "sum", "chunk_steps": 4, "max_chunks": 1} | ASKED
    env = gymnasium.make_vec(f"dextouch.clients.gym_env:{ENV_ID}", num_envs=2, **given)
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    env.reset(seed=[3, 4])
    env.step(np.stack([actions(4)] * 2))
    with pytest.raises(InvalidInputError, match=r"environments \[0, 1\] have no episode"):
        env.step(np.stack([actions(4)] * 2))
    env.close()


def test_wrong_use_of_the_vector_is_named(make_envs, vector):
    envs = make_envs(2)
    with pytest.raises(InvalidInputError, match="same client"):
        WorldVectorEnv([envs[0], envs[0]])
    with pytest.raises(InvalidInputError, match="spaces differ"):
        WorldVectorEnv([envs[0], *make_envs(1, chunk_steps=8)])
    with pytest.raises(InvalidInputError, match=r"environments \[0, 1, 2\] have no episode"):
        vector.step(np.stack([actions(4)] * 3))
    vector.reset(seed=5)
    for num_chunks in (0, 2, 4):
        with pytest.raises(InvalidInputError, match=f"got {num_chunks} chunks, expected 3"):
            vector.step(np.zeros((num_chunks, 4, 67)))
    # None has advanced.
    _, _, _, _, infos = vector.step(np.stack([actions(4)] * 3))
    assert infos["last_step"].tolist() == [4, 4, 4]
    with pytest.raises(UnknownNameError, match="valid: inits, reset_mask"):
        vector.reset(options={"init": None})
    for seed in ([1, 2], range(4)):
        with pytest.raises(InvalidInputError, match=r"seed: got \d, expected 3"):
            vector.reset(seed=seed)
    with pytest.raises(InvalidInputError, match="none at the first reset"):
        WorldVectorEnv(make_envs(3)).reset(options={"reset_mask": np.array([True, False, True])})
    for mask in ([True, False], [1, 0, 1], [False] * 3, "all"):
        with pytest.raises(InvalidInputError, match="reset_mask: got"):
            vector.reset(options={"reset_mask": mask})


def test_a_step_that_fails_in_one_environment_needs_a_reset_of_all(vector):
    vector.reset(seed=0)
    with pytest.raises(InvalidInputError, match="joint 1e6"):
        vector.step(np.stack([actions(4), actions(4, 1e6), actions(4)]))
    with pytest.raises(InvalidInputError, match=r"environments \[0, 1, 2\]"):
        vector.step(np.stack([actions(4)] * 3))
    vector.reset(seed=0)
    vector.step(np.stack([actions(4)] * 3))
