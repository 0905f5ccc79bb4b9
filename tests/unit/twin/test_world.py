"""The twin as a world: a rollout replays its demonstration to the last bit."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.schemas import ReturnSelector, RolloutStart, reported_milestones
from services.twin.cameras import CameraRig
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task
from services.twin.world import TwinWorld

SMALL = TwinSettings(image_height_px=16, image_width_px=16)
CHUNK = 16


@pytest.fixture(scope="module")
def world():
    return TwinWorld(SMALL)


@pytest.mark.long
@pytest.mark.parametrize("task", ["stand_bottle", "stack_bowls"])
def test_replaying_the_commanded_actions_reproduces_the_demonstration(world, task):
    episode = record(Stage(task, "robot", SMALL), 11, TakeOptions(images=("camera_head",)))
    commanded = episode.streams["action_commanded"].values
    started = world.reset(RolloutStart(task, 11, ""))
    state, seen = started.state, [started.observation]
    reached_by: dict[str, int] = {}
    for first in range(1, 81, CHUNK):
        stepped = world.step(state, commanded[first : first + CHUNK], seed=first)
        told = reported_milestones(stepped.info)
        assert tuple(told) == get_task(task).milestones
        for name in (name for name, value in told.items() if value):
            reached_by.setdefault(name, first + CHUNK)
        state = world.restore(world.snapshot(stepped.state))
        seen.append(stepped.observation)
    reached = np.concatenate([observation.action_reached for observation in seen])
    np.testing.assert_array_equal(reached, episode.streams["action"].values)
    images = np.concatenate([observation.images["camera_head"] for observation in seen])
    np.testing.assert_array_equal(images, episode.streams["camera_head"].values[::2])
    tactile = np.concatenate([observation.tactile_kpa for observation in seen])
    native = np.stack([episode.streams[f"tactile_{s}"].values for s in ("left", "right")], axis=1)
    expected = native[1:].reshape(80, 4, 2, 320).mean(axis=1, dtype=np.float64)
    np.testing.assert_allclose(tactile[1:], expected, atol=1e-5)
    np.testing.assert_array_equal(tactile[0], native[0])
    assert seen[-1].success is True
    assert episode.attributes.success is True
    # The recorder notes the time of the same milestones, to a step.
    steps = {name: 15 * time_s for name, time_s in episode.attributes.event_times_s.items()}
    assert reached_by.keys() == steps.keys()
    for name, step in steps.items():
        assert reached_by[name] - CHUNK <= round(step) < reached_by[name]


def test_standing_still_does_not_succeed(world):
    started = world.reset(RolloutStart("stack_bowls", 2, ""))
    still = np.repeat(started.observation.action_reached, CHUNK, axis=0)
    stepped = world.step(started.state, still, seed=0)
    assert stepped.observation.success is False
    np.testing.assert_allclose(stepped.observation.action_reached[:, :58], still[:, :58], atol=1e-6)


def test_a_start_with_an_observation_is_refused(world):
    started = world.reset(RolloutStart("stand_bottle", 0, ""))
    with pytest.raises(InvalidInputError, match="task and seed"):
        world.reset(RolloutStart("stand_bottle", 0, "", observation=started.observation))


def test_leaving_cameras_out_changes_nothing_else(world):
    one_eyed = TwinWorld(SMALL.model_copy(update={"cameras": ("camera_head",)}))
    start = RolloutStart("stack_bowls", 4, "")
    plain, fast = world.reset(start), one_eyed.reset(start)
    still = np.repeat(plain.observation.action_reached, CHUNK, axis=0)
    expected = world.step(plain.state, still, seed=0).observation
    got = one_eyed.step(fast.state, still, seed=0).observation
    assert set(got.images) == {"camera_head"}
    np.testing.assert_array_equal(got.images["camera_head"], expected.images["camera_head"])
    np.testing.assert_array_equal(got.tactile_kpa, expected.tactile_kpa)
    np.testing.assert_array_equal(got.action_reached, expected.action_reached)


@pytest.mark.parametrize(
    ("asked", "num_images"),
    [({"steps": "last"}, 3), ({"cameras": ("camera_head",)}, 4), ({"cameras": ()}, 0)],
)
def test_only_asked_images_are_drawn(world, monkeypatch, asked, num_images):
    started = world.reset(RolloutStart("stand_bottle", 1, ""))
    drawn, image = [], CameraRig.image

    def noting(rig, simulation, camera):
        drawn.append(camera)
        return image(rig, simulation, camera)

    monkeypatch.setattr(CameraRig, "image", noting)
    still = np.repeat(started.observation.action_reached, 4, axis=0)
    world.step(started.state, still, seed=0, selector=ReturnSelector(**asked))
    assert len(drawn) == num_images


def test_an_unknown_camera_is_refused():
    with pytest.raises(UnknownNameError, match="camera_head"):
        TwinWorld(SMALL.model_copy(update={"cameras": ("camera_knee",)}))


def test_a_snapshot_of_another_twin_is_refused(world):
    other = TwinWorld(TwinSettings(image_height_px=32, image_width_px=32))
    state = other.reset(RolloutStart("stand_bottle", 0, "")).state
    with pytest.raises(InvalidInputError, match="version"):
        world.restore(other.snapshot(state))
