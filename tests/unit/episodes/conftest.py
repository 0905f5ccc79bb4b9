"""A small twin-like episode with every stream of the plan, as arrays and in a store."""

import resource
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, select_episodes
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import actions as act
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor

RATES_HZ = {"tactile": 60, "pose": 100, "image": 30, "robot_state": 15}


@dataclass
class MadeEpisode:
    """An episode's descriptors, stamps, values and absolute poses."""

    attributes: EpisodeAttributes
    descriptors: list
    stamps_ns: dict
    values: dict
    trajectory: act.HandTrajectory

    def write(self, store, **changes):
        attributes = self.attributes.model_copy(update=changes)
        with store.writer(attributes=attributes) as writer:
            for descriptor in self.descriptors:
                writer.add_stream(descriptor)
                name = descriptor.name
                writer.append(name, values=self.values[name], t_ref_ns=self.stamps_ns[name])
        return store.open(attributes.episode_id)


def grid_ns(rate_hz, count):
    return np.array([round(k * 1e9 / rate_hz) for k in range(count)], dtype=np.int64)


def random_trajectory(rng, count):
    def poses():
        rotation = rotation_from_vector(np.cumsum(0.05 * rng.normal(size=(count, 3)), axis=0))
        return transform(rotation, np.cumsum(0.01 * rng.normal(size=(count, 3)), axis=0))

    return act.HandTrajectory(
        poses(), poses(), rng.normal(size=(count, 20)), rng.normal(size=(count, 20)), poses()
    )


def episode_of(num_steps=21, *, camera_unit="rgb8", seed=3):
    rng = np.random.default_rng(seed)
    trajectory = random_trajectory(rng, num_steps)
    measured = act.actions_from_poses(trajectory, trajectory.anchor(0))
    duration_s = (num_steps - 1) / 15
    plan = [
        ("tactile_left", "tactile", (320,), "float32", "kPa"),
        ("tactile_right", "tactile", (320,), "float32", "kPa"),
        ("wrist_left", "pose", (7,), "float64", "pose_m_wxyz"),
        ("camera_head", "image", (64, 64, 3), "uint8", camera_unit),
        ("camera_wrist_left", "image", (64, 64, 3), "uint8", camera_unit),
        ("camera_wrist_right", "image", (64, 64, 3), "uint8", camera_unit),
        ("action", "robot_state", (67,), "float64", "action"),
        ("action_commanded", "robot_state", (67,), "float64", "action"),
    ]
    descriptors, stamps_ns, values = [], {}, {}
    ramp = np.add.outer(np.arange(64), np.arange(64))[..., None] + np.array([0, 50, 90])
    for name, kind, shape, dtype, unit in plan:
        rate_hz = RATES_HZ[kind]
        count = round(duration_s * rate_hz) + 1
        descriptors.append(
            StreamDescriptor(
                name=name, kind=kind, shape=shape, dtype=dtype, unit=unit, nominal_rate_hz=rate_hz
            )
        )
        stamps_ns[name] = grid_ns(rate_hz, count)
        if kind == "image":
            values[name] = ((ramp + np.arange(count)[:, None, None, None] * 3) % 200).astype("u1")
        else:
            values[name] = rng.gamma(2.0, 3.0, size=(count, *shape)).astype(dtype)
    values["action"] = measured
    values["action_commanded"] = measured.copy()
    values["action_commanded"][:, :3] += 0.01
    attributes = EpisodeAttributes(
        episode_id="stand-bottle-0003",
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="robot",
        origin="twin",
        seed=seed,
        anchor=StoredAnchor.from_poses(trajectory.anchor(0)),
        K_head=matrix_rows(np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]])),
        success=True,
    )
    return MadeEpisode(attributes, descriptors, stamps_ns, values, trajectory)


@pytest.fixture
def make_episode():
    return episode_of


@pytest.fixture
def made():
    return episode_of()


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def file_size_limit():
    """The kernel refuses to let any file grow beyond a size: a full disk in small."""

    @contextmanager
    def limit(num_bytes):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limit


def chosen(store):
    """Ids of the episodes that learners take."""
    return [reader.item_id for reader in select_episodes([store])]
