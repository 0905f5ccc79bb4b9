"""Small twin-like episodes for the LeRobot bridge, written into a store."""

from dataclasses import dataclass

import numpy as np

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import actions as act
from dextouch.schemas import EpisodeAttributes, LineageEntry, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor

CAMERAS = ("camera_head", "camera_wrist_left")
SIZE_PX = (48, 64)


@dataclass
class Made:
    """An episode as arrays, ready to be written."""

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

    def drop(self, *names):
        self.descriptors = [d for d in self.descriptors if d.name not in names]

    def set_unit(self, unit, camera=None):
        names = CAMERAS if camera is None else (camera,)
        self.descriptors = [
            d.model_copy(update={"unit": unit}) if d.name in names else d for d in self.descriptors
        ]


def grid_ns(rate_hz, count):
    return np.array([round(k * 1e9 / rate_hz) for k in range(count)], dtype=np.int64)


def _poses(rng, count):
    rotation = rotation_from_vector(np.cumsum(0.05 * rng.normal(size=(count, 3)), axis=0))
    return transform(rotation, np.cumsum(0.01 * rng.normal(size=(count, 3)), axis=0))


def pictures(count, seed=0):
    """A smooth moving pattern, so that lossy video stays close to it."""
    rows, columns = np.mgrid[: SIZE_PX[0], : SIZE_PX[1]]
    images = np.empty((count, *SIZE_PX, 3), dtype=np.uint8)
    for index in range(count):
        for channel in range(3):
            phase = 0.12 * index + channel + seed
            wave = np.sin(rows / 11 + phase) + np.cos(columns / 13 - phase)
            images[index, :, :, channel] = 128 + 50 * wave
    return images


def make_episode(*, num_steps=17, seed=3, unit="rgb8", camera_hz=30, commanded=True):
    """Two cameras, both tactile hands, measured and (perhaps) commanded actions."""
    rng = np.random.default_rng(seed)
    trajectory = act.HandTrajectory(
        _poses(rng, num_steps),
        _poses(rng, num_steps),
        rng.normal(size=(num_steps, 20)),
        rng.normal(size=(num_steps, 20)),
        _poses(rng, num_steps),
    )
    measured = act.actions_from_poses(trajectory, trajectory.anchor(0))
    # As recordings are made: the anchor itself is exactly the identity.
    for part in act.POSE_SLICES:
        measured[0, part] = act.IDENTITY_POSE_9D
    sent = measured.copy()
    sent[:, :3] += 0.01
    duration_s = (num_steps - 1) / 15
    images, touch = round(duration_s * camera_hz) + 1, round(duration_s * 60) + 1
    plan = {
        "tactile_left": ("tactile", "kPa", 60, rng.gamma(2.0, 3.0, (touch, 320)).astype("f4")),
        "tactile_right": ("tactile", "kPa", 60, rng.gamma(2.0, 3.0, (touch, 320)).astype("f4")),
        "camera_head": ("image", unit, camera_hz, pictures(images, seed)),
        "camera_wrist_left": ("image", unit, camera_hz, pictures(images, seed + 1)),
        "action": ("robot_state", "action", 15, measured),
    }
    if commanded:
        plan["action_commanded"] = ("robot_state", "action", 15, sent)
    descriptors, stamps_ns, values = [], {}, {}
    for name, (kind, name_of_unit, rate_hz, array) in plan.items():
        descriptors.append(
            StreamDescriptor(
                name=name,
                kind=kind,
                shape=array.shape[1:],
                dtype=str(array.dtype),
                unit=name_of_unit,
                nominal_rate_hz=rate_hz,
            )
        )
        stamps_ns[name], values[name] = grid_ns(rate_hz, len(array)), array
    attributes = EpisodeAttributes(
        episode_id=f"stand-bottle-{seed:04d}",
        task="stand_bottle",
        instruction="stand the bottle up" if seed % 2 else "lift the bottle",
        domain="robot" if commanded else "human",
        origin="twin",
        seed=seed,
        anchor=StoredAnchor.from_poses(trajectory.anchor(0)),
        K_head=matrix_rows(np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])),
        success=True,
        calibration={"T_tracker_left_wrist_left": matrix_rows(np.eye(4))},
        lineage=(LineageEntry(kind="recording", id="take-7", sha256="ab" * 32),),
    )
    return Made(attributes, descriptors, stamps_ns, values, trajectory)
