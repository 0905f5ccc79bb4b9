"""A toy world for the model's tests: two hands over a table, one bright box, pressure by depth."""

import shutil
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore
from dextouch.geometry import apply, invert, pinhole_matrix, project, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory, actions_from_poses
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor
from dextouch.tactile import DEXTOUCH_V1
from services.world_model.checkpoints import (
    CheckpointMetadata,
    read_checkpoint,
    write_checkpoint,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import OptimizerSettings, TrainSettings, WindowSettings
from services.world_model.training.distribution import ALONE
from services.world_model.training.joint_dataset import EpisodeArrays, WindowSampler
from services.world_model.training.joint_objective import LossOptions, errors, examples_of

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


def losses(model, batch, *, generator, options=LossOptions(), processes=ALONE):  # noqa: B008
    """Errors of the prediction at random times."""
    examples = examples_of(model, batch, generator=generator, options=options, processes=processes)
    return errors(model, examples, options.precision)


def make_episode(seed, num_steps=41):
    """A copy of its own, since tests change it; drawn once."""
    return deepcopy(_drawn_episode(seed, num_steps))


@cache
def _drawn_episode(seed, num_steps):
    rng = np.random.default_rng(seed)
    commanded = _trajectory(rng, num_steps)
    measured = _lagging(commanded)
    box_m = np.array([*rng.uniform(-0.12, 0.12, 2), 0.02])
    anchor = measured.anchor(0)
    return EpisodeArrays(
        episode_id=f"toy-{seed}",
        task="push_box",
        instruction="push the box with both hands",
        scene=f"push_box/{seed}",
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
        content_sha256=f"{seed:064x}",
        object_poses=np.tile(np.float32([*box_m, 1, 0, 0, 0]), (num_steps, 1, 1)),
        boxes_m=np.array([[0, 0, 0, 0.03, 0.03, 0.02]]),
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


def write_episode(store, episode, image_every=1, *, success=None):
    """The toy episode in a real store: every stream at the model rate, images if asked sparser."""
    stamps = (np.arange(len(episode)) * 1_000_000_000) // 15
    streams = {
        "tactile_left": ("tactile", episode.tactile_kpa[:, 0], "kPa"),
        "tactile_right": ("tactile", episode.tactile_kpa[:, 1], "kPa"),
        "camera_head": ("image", episode.images, "rgb8"),
        "action": ("robot_state", episode.actions["measured"], "action67"),
    }
    for side, images in zip(("left", "right"), episode.further, strict=False):
        if images is not None:
            streams[f"camera_wrist_{side}"] = ("image", images, "rgb8")
    if "commanded" in episode.actions:
        streams["action_commanded"] = ("robot_state", episode.actions["commanded"], "action67")
    if episode.object_poses is not None:
        streams["object_poses"] = ("pose", episode.object_poses, "pose_m_wxyz")
    attributes = EpisodeAttributes(
        episode_id=episode.episode_id,
        task=episode.task,
        instruction=episode.instruction,
        domain=episode.domain,
        origin="twin",
        seed=int(episode.scene.split("/")[1]),
        model_rate_hz=episode.model_rate_hz,
        anchor=StoredAnchor.from_poses(episode.anchor),
        K_head=matrix_rows(episode.K_head),
        object_names=("box",),
        object_boxes_m=tuple(map(tuple, episode.boxes_m.tolist())),
        success=success,
    )
    with store.writer(attributes=attributes) as writer:
        for name, (kind, values, unit) in streams.items():
            writer.add_stream(
                StreamDescriptor(
                    name=name, kind=kind, shape=values.shape[1:], dtype=values.dtype.name,
                    unit=unit, nominal_rate_hz=15.0,
                    layout=_named_layout(episode) if kind == "tactile" else None,
                )
            )  # fmt: skip
            every = image_every if kind == "image" else 1
            writer.append(name, values=values[::every], t_ref_ns=stamps[::every])


def _named_layout(episode):
    return None if episode.tactile_layout == DEXTOUCH_V1 else episode.tactile_layout


def human_episode(seed, task="fold_cloth"):
    """A toy episode of a person: another task, measured actions only."""
    episode = make_episode(seed)
    return replace(
        episode,
        episode_id=f"human-{seed}",
        task=task,
        domain="human",
        actions={"measured": episode.actions["measured"]},
    )


@pytest.fixture
def human_store(tmp_path):
    """A store with five episodes of people and one of a robot, which is never read."""
    store = EpisodeStore(tmp_path / "human")
    for seed in range(100, 105):
        write_episode(store, human_episode(seed))
    write_episode(store, make_episode(50))
    return store


@pytest.fixture(scope="session")
def written_store(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("toys") / "store")
    for seed in range(6):
        write_episode(store, make_episode(seed))
    return store


@pytest.fixture
def toy_store(tmp_path, written_store):
    """A copy of its own of the store with the toy episodes."""
    shutil.copytree(written_store.root, tmp_path / "store")
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def train_settings(tmp_path, tiny_config):
    return TrainSettings(
        episodes=str(tmp_path / "store"),
        output=tmp_path / "model.safetensors",
        network=tiny_config,
        optimizer=OptimizerSettings(batch=4, warmup_steps=10),
        windows=WindowSettings(fit_windows=16),
        max_steps=12,
    )


@pytest.fixture
def checkpoint(tiny_model, toy_episodes, tmp_path):
    """An untrained but fitted model, through a file."""
    batch = WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(16, 17)
    tiny_model.codec.fit(batch.images)
    tiny_model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
    path = tmp_path / "untrained.safetensors"
    write_checkpoint(path, tiny_model, make_metadata(tiny_model.config))
    return read_checkpoint(path)


def make_metadata(config):
    return CheckpointMetadata(
        name="tiny", network=config, tasks=("push_box",), command="test", seed=0,
        training_steps=0, training_cpu_s=0.0, train_episode_ids=(), train_fingerprints=(),
        data_hash="0",
    )  # fmt: skip


@pytest.fixture
def metadata(tiny_config):
    return make_metadata(tiny_config)
