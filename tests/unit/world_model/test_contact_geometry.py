"""Contact geometry as a condition of the joint model: where objects are changes what is felt."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.streams import HEAD_CAMERA
from services.world_model.checkpoints import read_checkpoint, write_checkpoint
from services.world_model.dynamics.features import NEAR_M, hand_motion
from services.world_model.joint_world import JointWorld
from services.world_model.network.inputs import (
    GEOMETRY_SIZE,
    ObjectsAtStart,
    build_inputs,
    contact_geometry,
)
from services.world_model.network.model import JointWorldModel, stack_noise
from services.world_model.predicted_world import SceneReader
from services.world_model.training.distribution import Processes
from services.world_model.training.joint_dataset import WindowPosition, WindowSampler
from services.world_model.training.joint_objective import own_context
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.other_gloves import small_layout
from tests.unit.world_model.conftest import make_metadata
from tests.unit.world_model.test_joint_world import make_start

PER_POINT, POINTS = 7, 11


@pytest.fixture
def window(toy_episode):
    return toy_episode(0).cut(WindowPosition(0, 5, 17))


@pytest.fixture
def config(tiny_config):
    return tiny_config.model_copy(update={"use_contact_geometry": True})


def shaken(config):
    torch.manual_seed(0)
    model = JointWorldModel(config).eval()
    for parameter in model.parameters():
        parameter.data.add_(0.03 * torch.randn(parameter.shape))
    return model


def test_distances_are_those_of_the_hand_points_to_a_turned_box(window):
    request = window.request
    pose = np.array([0.1, -0.05, 0.02, 0.5, 0.5, -0.5, 0.5])
    box = np.array([0.01, 0.0, 0.02, 0.05, 0.02, 0.03])
    seen = ObjectsAtStart(pose[None], box[None])
    features = contact_geometry(request.actions, request.anchor, seen)
    points_m = hand_motion(request.actions, request.anchor).points_m[:, :, 1:].astype(np.float64)
    local = apply(invert(transform_from_pose(pose)), points_m.reshape(-1, 3)) - box[:3]
    nearest = local.clip(-box[3:], box[3:])
    outside_m = np.linalg.norm(local - nearest, axis=-1)
    inside_m = np.minimum((np.abs(local) - box[3:]).max(-1), 0)
    expected = np.arcsinh((outside_m + inside_m) / NEAR_M) / 2
    got = features[:, :, : POINTS * PER_POINT].reshape(17, 2, POINTS, PER_POINT)[..., 0]
    np.testing.assert_allclose(got.reshape(-1), expected, atol=2e-4)


def test_slots_without_an_object_are_empty(window):
    request = window.request
    none = contact_geometry(request.actions, request.anchor, None)
    assert none.shape == (17, 2, GEOMETRY_SIZE)
    assert np.count_nonzero(none[..., :-1]) == 0
    np.testing.assert_array_equal(none[0, :, -1], [-1, 1])
    with pytest.raises(InvalidInputError, match="at most 3"):
        ObjectsAtStart(np.zeros((4, 7)), np.zeros((4, 6)))


def test_a_window_has_the_objects_of_its_first_step(toy_episode):
    episode = toy_episode(1)
    episode.object_poses[:, 0, 0] = np.arange(len(episode)) * 0.01
    request = episode.cut(WindowPosition(0, 7, 9)).request
    assert request.objects.poses[0, 0] == pytest.approx(0.07)
    unknown = replace(episode, object_poses=None)
    assert unknown.cut(WindowPosition(0, 7, 9)).request.objects is None


@torch.no_grad()
def test_a_model_with_it_sees_where_objects_are_and_one_without_does_not(
    config, tiny_config, window
):
    request = window.request
    shift = np.array([0.005, 0, 0, 0, 0, 0, 0])
    elsewhere = replace(request.objects, poses=request.objects.poses + shift)
    moved = replace(request, objects=elsewhere)
    for one, depends in ((config, True), (tiny_config, False)):
        model = shaken(one)
        noise = stack_noise([model.noise(17, torch.Generator().manual_seed(0))])
        touch = [
            model.predict(build_inputs([each], one), noise).tactile_kpa for each in (request, moved)
        ]
        assert torch.equal(*touch) is not depends


@pytest.fixture
def checkpoint(config, toy_episodes, tmp_path):
    model = shaken(config)
    batch = WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(16, 17)
    model.codec.fit(batch.images)
    model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
    path = tmp_path / "near.safetensors"
    write_checkpoint(path, model, make_metadata(model.config))
    return read_checkpoint(path)


@pytest.fixture
def reader():
    """Untrained start readers of the task."""
    one = untrained_state_checkpoint()
    tasks = one.metadata.dynamics.model_copy(update={"tasks": ("push_box",)})
    boxes = {"push_box": one.metadata.object_boxes_m["stand_bottle"]}
    metadata = one.metadata.model_copy(update={"dynamics": tasks, "object_boxes_m": boxes})
    return SceneReader(replace(one, metadata=metadata))


def test_a_served_model_needs_start_readers_of_its_tasks(checkpoint):
    for reader in (None, SceneReader(untrained_state_checkpoint())):
        with pytest.raises(InvalidInputError, match="--objects"):
            JointWorld(checkpoint, reader=reader)


def test_start_readers_of_another_glove_are_refused(checkpoint, reader):
    reader.tactile_layout = small_layout()
    with pytest.raises(InvalidInputError, match=r"'small' .138.*'dextouch_v1' .320.*--objects"):
        JointWorld(checkpoint, reader=reader)


def test_a_rollout_reads_the_objects_of_every_chunk(checkpoint, reader, toy_episode, monkeypatch):
    world, asked = JointWorld(checkpoint, reader=reader), []
    read = reader.objects

    def objects(requests, tasks):
        asked.append([request.first_image for request in requests])
        return read(requests, tasks)

    monkeypatch.setattr(reader, "objects", objects)
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    actions = episode.actions["commanded"][1:17]
    one = world.step(state, actions, seed=0)
    again = world.step(world.restore(world.snapshot(state)), actions, seed=0)
    np.testing.assert_array_equal(one.observation.tactile_kpa, again.observation.tactile_kpa)
    world.step(one.state, actions, seed=0)
    np.testing.assert_array_equal(asked[-1][0], one.observation.images[HEAD_CAMERA][-1])


def test_chained_training_is_refused(config, toy_episodes):
    batch = WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(2, 17)
    with pytest.raises(InvalidInputError, match="contact geometry"):
        own_context(shaken(config), batch, generator=torch.Generator(), processes=Processes())
