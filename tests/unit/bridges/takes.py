"""A small episode and a small recording with every kind of stream, and where two of them differ."""

from datetime import UTC, datetime

import numpy as np

from dextouch.geometry import pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import actions as act
from dextouch.images import encode_jpeg
from dextouch.schemas import (
    EpisodeAttributes,
    LedgerEntry,
    RecordingAttributes,
    StoredAnchor,
    matrix_rows,
)
from dextouch.streams import StreamDescriptor, encoded_values

K_HEAD = np.array([[60.0, 0, 32], [0, 61, 31.5], [0, 0, 1]])
DISTORTION = (-0.1, 0.02, 0.001, -0.002, 0.003)
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")


def descriptor(name, kind, shape, dtype, unit, rate_hz, frame=None):
    return StreamDescriptor(
        name=name,
        kind=kind,
        shape=shape,
        dtype=dtype,
        unit=unit,
        nominal_rate_hz=rate_hz,
        frame=frame,
    )


def grid_ns(rate_hz, count):
    return np.array([round(k * 1e9 / rate_hz) for k in range(count)], dtype=np.int64)


def trajectory_of(rng, count):
    def poses():
        rotation = rotation_from_vector(np.cumsum(0.05 * rng.normal(size=(count, 3)), axis=0))
        return transform(rotation, np.cumsum(0.01 * rng.normal(size=(count, 3)), axis=0))

    joints = rng.normal(size=(2, count, 20))
    return act.HandTrajectory(poses(), poses(), joints[0], joints[1], poses())


def images_of(count, size_px, offset=0):
    ramp = np.add.outer(np.arange(size_px), np.arange(size_px))[..., None] + np.array([0, 50, 90])
    return ((ramp + np.arange(count)[:, None, None, None] * 3 + offset) % 200).astype("u1")


def write_episode(
    store,
    episode_id="stand-bottle-0003",
    *,
    num_steps=21,
    unit="rgb8",
    seed=3,
    cameras=CAMERAS,
    lineage=(),
):
    """A robot episode with everything a twin writes; its reader comes back."""
    rng = np.random.default_rng(seed)
    trajectory = trajectory_of(rng, num_steps)
    seconds = (num_steps - 1) / 15
    streams = {}

    def add(name, kind, values_of, rate_hz, unit, frame=None):
        values = values_of(round(seconds * rate_hz) + 1)
        shape, dtype = values.shape[1:], str(values.dtype)
        described = descriptor(name, kind, shape, dtype, unit, rate_hz, frame)
        streams[name] = (described, grid_ns(rate_hz, len(values)), values)

    def touch(n):
        return rng.gamma(2.0, 3.0, (n, 320)).astype("f4")

    def poses(n):
        return pose_from_transform(trajectory_of(rng, n).Ts_world_wrist_left)

    for side in ("left", "right"):
        add(f"tactile_{side}", "tactile", touch, 60, "kPa")
        add(
            f"keypoints_{side}",
            "keypoints",
            lambda n: rng.normal(size=(n, 25, 3)),
            120,
            "m",
            f"wrist_{side}",
        )
        add(f"wrist_{side}", "pose", poses, 100, "pose_m_wxyz", "world")
    add("head", "pose", poses, 100, "pose_m_wxyz", "world")
    add(
        "object_poses",
        "pose",
        lambda n: np.stack([poses(n), poses(n)], axis=1),
        100,
        "pose_m_wxyz",
        "world",
    )
    add("joints_measured", "robot_state", lambda n: rng.normal(size=(n, 40)), 100, "rad")
    for index, camera in enumerate(cameras):
        add(camera, "image", lambda n, i=index: images_of(n, 64, 20 * i + seed), 30, unit)
    measured = act.actions_from_poses(trajectory, trajectory.anchor(0))
    add("action", "robot_state", lambda _: measured, 15, "action")
    add("action_commanded", "robot_state", lambda _: measured + 1e-3, 15, "action")
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="robot",
        origin="twin",
        seed=seed,
        anchor=StoredAnchor.from_poses(trajectory.anchor(0)),
        K_head=matrix_rows(K_HEAD),
        success=True,
        quality={"coverage": 0.75},
        created_at=datetime(2026, 1, 2, tzinfo=UTC),
        lineage=lineage,
    )
    with store.writer(attributes=attributes) as writer:
        for described, t_ref_ns, values in streams.values():
            writer.add_stream(described)
            writer.append(described.name, values=values, t_ref_ns=t_ref_ns)
    return store.open(episode_id)


def write_recording(store, recording_id="take-0001", *, count=70, station="bench-2", **more):
    """A raw take: counts, NaN poses, JPEG images, repeated stamps, absent device stamps."""
    rng = np.random.default_rng(11)
    t_host_ns = 10**15 + np.sort(rng.integers(0, 10**9, count))
    t_host_ns[25:33] = t_host_ns[min(25, count - 1)]
    device_ns = rng.integers(0, 2**62, count)
    device_ns[3] = -1
    sequence = np.arange(count) + 2**40
    sequence[4] = -1
    poses = rng.normal(size=(count, 7))
    poses[2] = np.nan
    jpegs = encoded_values([encode_jpeg(image) for image in images_of(count, 32)])
    values = {
        "tactile_left": rng.integers(0, 65536, (count, 360)).astype("u2"),
        "keypoints_left": rng.normal(size=(count, 25, 3)).astype("f4"),
        "wrist_left": poses,
        "camera_head": jpegs,
        "button": rng.integers(-(2**62), 2**62, (count, 1)),
        "flags": rng.integers(0, 256, (count, 3)).astype("u1"),
    }
    described = [
        descriptor("tactile_left", "tactile", (360,), "uint16", "counts", 100),
        descriptor("keypoints_left", "keypoints", (25, 3), "float32", "m", 120, "wrist_left"),
        descriptor("wrist_left", "pose", (7,), "float64", "pose_m_wxyz", 100, "world"),
        descriptor("camera_head", "image", (32, 32, 3), "uint8", "jpeg", 30),
        descriptor("button", "scalar", (1,), "int64", "count", 10),
        descriptor("flags", "scalar", (3,), "uint8", "bits", 10),
    ]
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="human",
        station=station,
        operator="p17",
        consent=True,
        calibration={"K_head": matrix_rows(K_HEAD), "distortion_head": (DISTORTION,)},
        ledger=(LedgerEntry(stream="wrist_left", event="lost", count=2),),
        **more,
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for stream in described:
            writer.add_stream(stream)
            writer.append(
                stream.name,
                values=values[stream.name],
                t_host_ns=t_host_ns,
                t_device_ns=device_ns,
                sequence=sequence,
            )
    return store.recording(recording_id)


def differing_streams(one, other):
    """Names of streams whose stamps or values are not the same bytes in two readers."""
    names = sorted(set(one.streams) | set(other.streams))
    return [name for name in names if _bytes_of(one, name) != _bytes_of(other, name)]


def _bytes_of(reader, name):
    if name not in reader.streams:
        return None
    data = reader.read(name)
    stamps = [
        getattr(data, key)
        for key in ("t_ref_ns", "t_host_ns", "t_device_ns", "sequence")
        if hasattr(data, key)
    ]
    encoded = []
    if reader.streams[name].unit in {"jpeg", "h264"}:
        encoded = reader.encoded_images(name, 0, reader.num_samples(name))
    described = reader.streams[name].model_dump()
    return [described, *(s.tobytes() for s in stamps), data.values.tobytes(), *encoded]
