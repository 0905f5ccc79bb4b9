"""Small episodes with chosen attributes, written for tests of the catalog and of windows."""

import numpy as np

from dextouch.hands.actions import IDENTITY_POSE_9D, pack_action
from dextouch.schemas import EpisodeAttributes, RecordingAttributes
from dextouch.streams import StreamDescriptor

IDENTITY_ROWS = [[float(i == j) for j in range(4)] for i in range(4)]
POSES = ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head")


def write_episode(store, episode_id, *, num_steps=9, **changes):
    """An episode of a stand_bottle robot from the twin, unless changed."""
    attributes = EpisodeAttributes.model_validate(
        {
            "episode_id": episode_id,
            "task": "stand_bottle",
            "instruction": "do it",
            "domain": "robot",
            "origin": "twin",
            "success": True,
            "anchor": dict.fromkeys(POSES, IDENTITY_ROWS),
            "K_head": [[60, 0, 16], [0, 60, 16], [0, 0, 1]],
            **changes,
        }
    )
    pose = np.tile(IDENTITY_POSE_9D, (num_steps, 1))
    pose[:, 0] = 0.01 * np.arange(num_steps)
    joints = np.zeros((num_steps, 20))
    actions = pack_action(
        wrist_left=pose,
        wrist_right=pose,
        joints_left_rad=joints,
        joints_right_rad=joints,
        camera_head=np.tile(IDENTITY_POSE_9D, (num_steps, 1)),
    )
    grid_ns = np.array([round(k * 1e9 / 15) for k in range(num_steps)])
    image = np.arange(32 * 32 * 3).reshape(32, 32, 3) % 251
    images = ((image + np.arange(num_steps)[:, None, None, None]) % 256).astype("u1")
    tactile = np.random.default_rng(0).gamma(2.0, 2.0, size=(num_steps, 320)).astype("f4")
    blocks = [
        ("action", "robot_state", "float64", "action", actions),
        ("camera_head", "image", "uint8", "rgb8", images),
        ("tactile_left", "tactile", "float32", "kPa", tactile),
    ]
    with store.writer(attributes=attributes) as writer:
        for name, kind, dtype, unit, values in blocks:
            writer.add_stream(
                StreamDescriptor(
                    name=name,
                    kind=kind,
                    shape=values.shape[1:],
                    dtype=dtype,
                    unit=unit,
                    nominal_rate_hz=15,
                )
            )
            writer.append(name, values=values, t_ref_ns=grid_ns)
    return store.open(episode_id)


def write_recording(store, recording_id, *, num_samples=30, **changes):
    """A recording of one tracked wrist at 30 Hz, of a human who stands a bottle, unless changed."""
    attributes = RecordingAttributes.model_validate(
        {
            "recording_id": recording_id,
            "task": "stand_bottle",
            "instruction": "do it",
            "domain": "human",
            "station": "bench",
            **changes,
        }
    )
    numbers = np.arange(num_samples, dtype=np.int64)
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.add_stream(
            StreamDescriptor(
                name="wrist_left",
                kind="pose",
                shape=(7,),
                dtype="float64",
                unit="pose_m_wxyz",
                nominal_rate_hz=30,
            )
        )
        stamps_ns = numbers * 33_333_333
        writer.append(
            "wrist_left",
            values=np.ones((num_samples, 7)),
            t_host_ns=stamps_ns,
            t_device_ns=stamps_ns,
            sequence=numbers,
        )
    return store.recording(recording_id)


def write_take(store, recording_id, *, num_steps=9, quality=None, clocks=(), **changes):
    """A recording and the episode that alignment would make of it, `ID-aligned`."""
    recording = write_recording(store, recording_id, num_samples=2 * num_steps, **changes)
    about = recording.attributes
    source = {"kind": "recording", "id": recording_id, "sha256": recording.content_sha256}
    return write_episode(
        store,
        f"{recording_id}-aligned",
        num_steps=num_steps,
        origin="recorded",
        created_at=about.started_at,
        lineage=[source],
        quality=quality or {},
        clocks=clocks,
        **{
            name: getattr(about, name)
            for name in ("task", "instruction", "domain", "station", "operator", "success")
        },
    )
