"""Streams of a short, made-up episode for tests of the recording path."""

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.devices.robot_state import STREAM_SIZES
from services.acquisition.mocks.replay import ReplayStream


def stream(name, kind, rate_hz, values, unit, seconds):
    count = round(rate_hz * seconds)
    t_ns = np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    values = np.asarray(values(t_ns * 1e-9))
    descriptor = StreamDescriptor(
        name=name,
        kind=kind,
        shape=values.shape[1:],
        dtype=values.dtype.name,
        unit=unit,
        nominal_rate_hz=rate_hz,
    )
    return ReplayStream(descriptor, t_ns, values)


def pose(t_s, phase):
    angle = 0.4 * np.sin(2 * t_s + phase)
    zeros = np.zeros_like(t_s)
    position = [0.2 * np.sin(3 * t_s + phase), 0.1 * np.cos(2 * t_s), 1.0 + 0.05 * t_s]
    return np.stack([*position, np.cos(angle / 2), zeros, np.sin(angle / 2), zeros], axis=1)


def tactile(t_s, phase):
    wave = np.sin(2 * np.pi * t_s[:, None] + phase + np.arange(320) / 40)
    return (20 * np.maximum(0, wave)).astype(np.float32)


def keypoints(t_s, phase):
    base = np.random.default_rng(3).uniform(-0.1, 0.1, (25, 3))
    return base + 0.02 * np.sin(4 * t_s + phase)[:, None, None]


def images(t_s, size=32):
    rows = (np.arange(size)[:, None] + 50 * t_s[:, None, None]) % 256
    picture = np.broadcast_to(rows, (len(t_s), size, size))
    return np.repeat(picture[..., None], 3, axis=-1).astype(np.uint8)


def human_streams(seconds=1.5, cameras=("camera_head",)):
    made = []
    for phase, side in enumerate(("left", "right")):
        made += [
            stream(
                f"tactile_{side}", "tactile", 60, lambda t, p=phase: tactile(t, p), "kPa", seconds
            ),
            stream(
                f"keypoints_{side}",
                "keypoints",
                120,
                lambda t, p=phase: keypoints(t, p),
                "m",
                seconds,
            ),
            stream(
                f"wrist_{side}", "pose", 100, lambda t, p=phase: pose(t, p), "pose_m_wxyz", seconds
            ),
        ]
    made.append(stream("head", "pose", 100, lambda t: pose(t, 5), "pose_m_wxyz", seconds))
    made += [stream(name, "image", 30, images, "rgb8", seconds) for name in cameras]
    return made


def robot_streams(seconds=1.5):
    made = [
        s
        for s in human_streams(seconds)
        if not s.descriptor.name.startswith(("keypoints", "wrist"))
    ]
    for index, (name, size) in enumerate(STREAM_SIZES.items()):
        if size == 7:
            made.append(
                stream(name, "pose", 100, lambda t, p=index: pose(t, p), "pose_m_wxyz", seconds)
            )
        else:
            joints = lambda t: np.sin(t[:, None] + np.arange(40) / 9)  # noqa: E731
            made.append(stream(name, "robot_state", 100, joints, "rad", seconds))
    return made
