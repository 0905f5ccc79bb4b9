"""A toy world for the model's tests: two hands over a table, one bright box, pressure by depth."""

import numpy as np
import pytest
import torch

from dextouch.geometry.cameras import pinhole_matrix, project
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import apply, invert, transform
from dextouch.hands.actions import HandTrajectory, actions_from_poses
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.training.dataset import EpisodeArrays

PX = 32
K_HEAD = pinhole_matrix(width_px=PX, height_px=PX, fovy_rad=np.deg2rad(60))
# Camera 0.5 m above the table, looking straight down: x right, y towards the body, z down.
T_WORLD_CAMERA = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def tiny_config():
    return NetworkConfig(
        image_px=PX, video_width=32, tactile_width=32, num_layers=2, num_heads=2, head_width=16,
        codec_channels=12, palm_channels=8,
    )  # fmt: skip


@pytest.fixture
def tiny_model(tiny_config):
    torch.manual_seed(0)
    return JointWorldModel(tiny_config).eval()


@pytest.fixture
def toy_episode():
    return make_episode


@pytest.fixture
def toy_episodes():
    return [make_episode(seed) for seed in range(6)]


def make_episode(seed, num_steps=41):
    rng = np.random.default_rng(seed)
    commanded = _trajectory(rng, num_steps)
    measured = _lagging(commanded)
    box_m = np.array([*rng.uniform(-0.12, 0.12, 2), 0.02])
    anchor = measured.anchor(0)
    return EpisodeArrays(
        episode_id=f"toy-{seed}",
        task="push_box",
        instruction="push the box with both hands",
        seed=seed,
        images=_images(measured, box_m),
        tactile_kpa=_touch(measured, box_m),
        tactile_valid=np.ones((num_steps, 2), dtype=bool),
        actions={
            "measured": actions_from_poses(measured, anchor),
            "commanded": actions_from_poses(commanded, anchor),
        },
        anchor=anchor,
        K_head=K_HEAD,
        model_rate_hz=15.0,
    )


def _trajectory(rng, num_steps):
    phase = np.linspace(0, 2 * np.pi, num_steps)[:, None]

    def wrist(side):
        start = np.array([0.12 * side, 0.0, 0.12])
        swing = rng.uniform(-0.12, 0.12, 3) * [1, 1, 0.3]
        swing[2] = -abs(swing[2])
        R = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
        return transform(
            np.broadcast_to(R, (num_steps, 3, 3)), start + np.sin(phase + rng.uniform(0, 6)) * swing
        )

    joints = 0.5 + 0.4 * np.sin(phase + rng.uniform(0, 6, (2, 1, 20)))
    camera = np.broadcast_to(T_WORLD_CAMERA, (num_steps, 4, 4))
    return HandTrajectory(wrist(-1), wrist(1), joints[0], joints[1], camera)


def _lagging(commanded):
    def late(values):
        return np.concatenate([values[:1], values[:-1]])

    return HandTrajectory(
        late(commanded.Ts_world_wrist_left),
        late(commanded.Ts_world_wrist_right),
        late(commanded.joints_left_rad),
        late(commanded.joints_right_rad),
        commanded.Ts_world_camera_head,
    )


def _images(trajectory, box_m):
    images = []
    grid = np.stack(np.meshgrid(np.arange(PX) + 0.5, np.arange(PX) + 0.5), axis=-1)
    for left, right in zip(
        trajectory.Ts_world_wrist_left, trajectory.Ts_world_wrist_right, strict=True
    ):
        points = np.stack([box_m, left[:3, 3], right[:3, 3]])
        pixels, _ = project(K_HEAD, apply(invert(T_WORLD_CAMERA), points))
        image = np.full((PX, PX, 3), 60.0)
        for pixel, colour in zip(
            pixels, ((220, 60, 40), (40, 200, 60), (50, 80, 230)), strict=True
        ):
            weight = np.exp(-np.square(grid - pixel).sum(-1, keepdims=True) / 8)
            image = image * (1 - weight) + weight * np.array(colour)
        images.append(image)
    return np.stack(images).astype(np.uint8)


def _touch(trajectory, box_m):
    touch = np.zeros((len(trajectory.joints_left_rad), 2, 320), dtype=np.float32)
    profile = np.linspace(0.2, 1.0, 320, dtype=np.float32)
    for hand, Ts in enumerate((trajectory.Ts_world_wrist_left, trajectory.Ts_world_wrist_right)):
        gap_m = np.linalg.norm(Ts[:, :3, 3] - box_m, axis=-1) - 0.1
        depth = np.clip(-gap_m, 0, None).astype(np.float32)
        touch[:, hand] = 400.0 * depth[:, None] * profile
    return touch
