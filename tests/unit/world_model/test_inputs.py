"""Requests become tensors once, the same way for everyone, or are refused with a reason."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dextouch.errors import (
    DegenerateRotationError,
    InvalidInputError,
    NonFiniteError,
    ShapeError,
    UnknownNameError,
)
from dextouch.geometry import transform
from dextouch.hands.actions import AnchorPoses
from dextouch.hands.robot_hand import RobotHand
from services.world_model.network.attention import (
    MIRROR_WRIST,
    camera_features,
    hand_features,
    left_joint_signs,
)
from services.world_model.network.conditioning import ActionNormalizer, SceneEncoder
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.inputs import blots, build_inputs, pose_raster
from services.world_model.network.instruction import NO_WORD, instruction_ids
from services.world_model.training.joint_dataset import WindowPosition

# The rotation columns of both wrists and the head camera in a 67-D action.
POSE_COLUMNS = np.array([[*range(3, 9)], [*range(12, 18)], [*range(61, 67)]])


@pytest.fixture
def request_(toy_episode):
    return toy_episode(3).cut(WindowPosition(0, 5, 17, action_kind="commanded")).request


def test_the_left_hand_is_the_mirror_image_of_the_right():
    joints = np.random.default_rng(0).uniform(-0.3, 1.0, (20, 20))
    left = RobotHand("left").fingertips_m(joints) * MIRROR_WRIST
    right = RobotHand("right").fingertips_m(joints * left_joint_signs())
    # The two tables differ by up to 3 mm; without the mirror the difference is 160 mm.
    assert np.abs(left - right).max() < 0.003
    assert np.abs(left / MIRROR_WRIST - right).max() > 0.1


def test_mirrored_motions_give_equal_features(toy_episode):
    actions = toy_episode(0).actions["measured"]
    S = np.diag(MIRROR_WRIST)
    mirrored = actions.copy()
    R = actions[:, 12:18].reshape(-1, 2, 3).transpose(0, 2, 1)
    mirrored[:, 0:3] = actions[:, 9:12] @ S
    mirrored[:, 3:9] = (S @ R @ S[:2, :2]).transpose(0, 2, 1).reshape(-1, 6)
    mirrored[:, 18:38] = actions[:, 38:58] * left_joint_signs()
    features = hand_features(mirrored)
    np.testing.assert_allclose(features[:, 0], features[:, 1], atol=1e-12)


def test_a_camera_shift_to_the_right_is_one_to_the_left_for_the_left_hand():
    actions = np.zeros((1, 67))
    actions[0, 58:67] = [0.1, 0.2, 0.3, 1, 0, 0, 0, 1, 0]
    camera = camera_features(actions)
    np.testing.assert_allclose(camera[0, 0], [-0.1, 0.2, 0.3, 1, 0, 0, 0, 1, 0])
    np.testing.assert_allclose(camera[0, 1], actions[0, 58:67])


def test_each_hand_sees_itself_first_then_the_other_within_ten_deviations(request_, tiny_config):
    inputs = build_inputs([request_], tiny_config)
    hands, camera = torch.empty_like(inputs.hands), torch.zeros_like(inputs.camera)
    hands[:, :, 0], hands[:, :, 1] = 2.0, -30.0
    # Turns are relative to none, shifts in 5 cm.
    camera[..., 3] = camera[..., 7] = 1.0
    camera[:, :, 0, 0] = 0.1
    camera[:, :, 1, 0] = 9.0
    # Places are in 10 cm from half a metre before the camera.
    layout = torch.zeros_like(inputs.layout)
    layout[:, 0, 2], layout[:, 1, :3] = 0.7, torch.tensor([0.1, 0.0, 0.5])
    seen = ActionNormalizer()(replace(inputs, hands=hands, camera=camera, layout=layout))
    left, right = [2.0] * 29, [-10.0] * 29
    rows = [[*left, *right, 2.0, *[0.0] * 8], [*right, *left, 10.0, *[0.0] * 8]]
    torch.testing.assert_close(seen.per_hand[0, 5], torch.tensor(rows))
    near, aside = [0.0, 0.0, 2.0, *[0.0] * 6], [1.0, *[0.0] * 8]
    torch.testing.assert_close(seen.layout[0], torch.tensor([near + aside, aside + near]))


def test_the_raster_shows_the_hands_where_they_are(toy_episode, tiny_config):
    episode = toy_episode(1)
    request = episode.cut(WindowPosition(0, 0, 17)).request
    raster = build_inputs([request], tiny_config).raster[0].numpy()
    cells = tiny_config.raster_cells
    for hand, T in enumerate(request.anchor.as_tuple()[:2]):
        # The camera looks straight down from 0.5 m: x right, y up in the image.
        depth_m = 0.5 - T[2, 3]
        focal_cells = episode.K_head[0, 0] * cells / tiny_config.image_px
        column = cells / 2 + focal_cells * T[0, 3] / depth_m
        row = cells / 2 - focal_cells * T[1, 3] / depth_m
        assert raster[0, hand, int(row), int(column)] > 0.4
    assert raster.min() >= 0
    assert raster.max() <= 1


def test_the_raster_moves_against_the_head():
    # Both wrists 1 m in front of a camera of 200 px focal length, whose head then moves 100 mm to
    # its right: the wrist moves 20 of 100 px, so 10 of 50 cells, to the left in the image, and the
    # fingertips, 0.2 m nearer along the wrist's -z, 12.5 cells.
    actions = np.zeros((1, 2, 67))
    actions[..., POSE_COLUMNS] = [1, 0, 0, 0, 1, 0]
    actions[0, 1, 58] = 0.1
    wrist = transform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    anchors = np.stack([wrist, wrist, np.eye(4)])[None]
    K_head = np.array([[[200.0, 0, 50], [0, 200.0, 50], [0, 0, 1]]])
    raster = pose_raster(actions, anchors, K_head, image_px=100, cells=50)[0]
    weight = raster / raster.sum(axis=(-2, -1), keepdims=True)
    columns = (weight.sum(axis=-2) * np.arange(50)).sum(axis=-1)
    rows = (weight.sum(axis=-1) * np.arange(50)).sum(axis=-1)
    shift = columns[1] - columns[0]
    assert ((shift > -12.5) & (shift < -10.0)).all()
    np.testing.assert_allclose(rows[1], rows[0], atol=0.1)


def test_the_left_hands_place_is_mirrored_into_the_rights(request_, tiny_config):
    # A left hand that is the mirror image of the right one, in a camera that looks along +z.
    R = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    T_camera_right = transform(R, np.array([0.11, 0.06, 0.42]))
    mirror_camera = np.diag([-1.0, 1.0, 1.0])
    mirror_wrist = np.diag([1.0, -1.0, 1.0])
    T_camera_left = transform(mirror_camera @ R @ mirror_wrist, np.array([-0.11, 0.06, 0.42]))
    T_world_camera = np.asarray(request_.anchor.T_world_camera_head)
    anchor = AnchorPoses(
        T_world_camera @ T_camera_left, T_world_camera @ T_camera_right, T_world_camera
    )
    layout = build_inputs([replace(request_, anchor=anchor)], tiny_config).layout[0].numpy()
    expected = [0.11, 0.06, 0.42, *R[:, 0], *R[:, 1]]
    np.testing.assert_allclose(layout[1], expected, atol=1e-6)
    np.testing.assert_allclose(layout[0], expected, atol=1e-6)


def test_the_left_hand_sees_the_scene_mirrored(request_, tiny_config):
    inputs = build_inputs([request_], tiny_config)
    mirrored = replace(
        inputs, first_image=inputs.first_image.flip(2), raster=inputs.raster.flip(2).flip(-1)
    )
    torch.manual_seed(0)
    scene = SceneEncoder(8)
    here, there = scene(inputs)[0], scene(mirrored)[0]
    torch.testing.assert_close(there[0], here[1], rtol=0, atol=1e-5)
    torch.testing.assert_close(there[1], here[0], rtol=0, atol=1e-5)
    assert (here[0] - here[1]).abs().max() > 1e-3


def test_points_behind_the_camera_leave_no_blot():
    pixels = np.full((2, 3, 2), 10.0)
    visible = np.array([[True] * 3, [False] * 3])
    shown = blots(pixels, visible, image_px=32, cells=16)
    assert shown[0].max() > 0.5
    assert shown[1].max() == 0


def test_the_raster_follows_the_kind_of_action_given(toy_episode, tiny_config):
    episode = toy_episode(3)
    kinds = ("measured", "commanded")
    requests = [episode.cut(WindowPosition(0, 5, 17, action_kind=kind)).request for kind in kinds]
    inputs = build_inputs(requests, tiny_config)
    assert (inputs.raster[0, 1:] - inputs.raster[1, 1:]).abs().max() > 0.05
    assert inputs.commanded.tolist() == [0.0, 1.0]


def test_one_request_means_the_same_alone_and_in_a_batch(toy_episodes, tiny_config):
    requests = [episode.cut(WindowPosition(0, 3, 9)).request for episode in toy_episodes]
    together = build_inputs(requests, tiny_config)
    for index, request in enumerate(requests):
        alone = build_inputs([request], tiny_config)
        for name, tensor in vars(alone).items():
            both = tensor[0], getattr(together, name)[index]
            same = both[0] == both[1] if name == "instructions" else torch.equal(*both)
            assert same, name


def test_row_zero_is_the_anchor_whatever_its_pose_says(request_, tiny_config):
    moved = request_.actions.copy()
    moved[0, :3] = 0.3
    a = build_inputs([request_], tiny_config)
    b = build_inputs([replace(request_, actions=moved)], tiny_config)
    assert torch.equal(a.raster, b.raster)
    assert torch.equal(a.hands, b.hands)


def _with(request, **changes):
    actions = request.actions.copy()
    for (row, column), value in changes.pop("at", {}).items():
        actions[row, column] = value
    return replace(request, actions=actions, **changes)


@pytest.mark.parametrize(
    ("at", "error"),
    [
        ({(2, 0): np.nan}, NonFiniteError),
        ({(2, 5): np.inf}, NonFiniteError),
        ({(3, 1): 5.0}, InvalidInputError),
        ({(3, 1): 1e300}, InvalidInputError),
        ({(3, 11): -5.0}, InvalidInputError),
        ({(4, 40): -50.0}, InvalidInputError),
        ({(4, 20): 50.0}, InvalidInputError),
        ({(4, c): 0.0 for c in range(3, 9)}, DegenerateRotationError),
        ({(4, 6): 1.0, (4, 7): 0.0, (4, 3): 1.0, (4, 4): 0.0, (4, 5): 0.0, (4, 8): 0.0},
         DegenerateRotationError),
    ],
)  # fmt: skip
def test_actions_that_no_hand_can_follow_are_refused(request_, tiny_config, at, error):
    with pytest.raises(error):
        build_inputs([_with(request_, at=at)], tiny_config)


def test_foreign_shapes_names_and_numbers_are_refused(request_, tiny_config):
    eye = np.eye(4)
    no_rotation = AnchorPoses(eye, 2 * eye, eye)
    cases = [
        ({"first_image": np.zeros((16, 16, 3), np.uint8)}, ShapeError),
        ({"actions": request_.actions[:16]}, ShapeError),
        ({"actions": np.concatenate([request_.actions, request_.actions[:4]])}, ShapeError),
        ({"first_tactile_kpa": np.full((2, 320), np.nan, np.float32)}, NonFiniteError),
        ({"first_tactile_kpa": np.full((2, 320), 1e9, np.float32)}, InvalidInputError),
        ({"action_kind": "wished"}, UnknownNameError),
        ({"anchor": no_rotation}, InvalidInputError),
        ({"K_head": -np.eye(3)}, InvalidInputError),
    ]
    for changes, error in cases:
        broken = object.__new__(type(request_))
        broken.__dict__.update({**vars(request_), **changes})
        with pytest.raises(error):
            build_inputs([broken], tiny_config)
    with pytest.raises(InvalidInputError, match="no request"):
        build_inputs([], tiny_config)
    short = replace(request_, actions=request_.actions[:9])
    with pytest.raises(ShapeError, match="one length"):
        build_inputs([request_, short], tiny_config)


def test_words_are_hashed_alike_and_padded():
    config = NetworkConfig(num_word_buckets=64)
    words = instruction_ids("Stand the BOTTLE, upright!", config)
    assert torch.equal(words, instruction_ids("stand the bottle upright", config))
    assert (words != NO_WORD).sum() == 4
    assert (instruction_ids("", config) == NO_WORD).all()
    assert (instruction_ids("x " * 100, config) != NO_WORD).all()
