"""Packets of version 1 as docs/device_packets.md describes them, byte for byte."""

import hashlib

import numpy as np
import pytest

from dextouch.streams import StreamDescriptor
from services.acquisition.devices.robot_state import STREAM_SIZES
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.gloves import GloveCalibration, TactileGloveSource
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import (
    CameraSource,
    FingerTrackerSource,
    PoseTrackerSource,
    RobotStateSource,
)

FLAT = GloveCalibration(np.full(360, 120.0), np.full(360, 40.0))


def stream(name, kind, values):
    descriptor = StreamDescriptor(
        name=name,
        kind=kind,
        shape=values.shape[1:],
        dtype=values.dtype.name,
        unit="any",
        nominal_rate_hz=1,
    )
    return ReplayStream(descriptor, np.arange(len(values), dtype=np.int64), values)


def glove():
    pressures = stream("tactile_left", "tactile", np.arange(320, dtype=np.float32)[None] / 16)
    return TactileGloveSource(pressures, side="left", calibration=FLAT)


def fingers():
    points = stream("keypoints_right", "keypoints", np.arange(75.0).reshape(1, 25, 3) / 64)
    rng = np.random.default_rng(1)
    return FingerTrackerSource(points, side="right", rng=rng)


def tracker():
    pose = np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]])
    rng = np.random.default_rng(1)
    return PoseTrackerSource(stream("head", "pose", pose), faults=DeviceFaults(), rng=rng)


def camera():
    return CameraSource(
        stream("camera_head", "image", np.arange(24, dtype=np.uint8).reshape(1, 2, 4, 3))
    )


def robot():
    return RobotStateSource(
        {
            name: stream(name, "robot_state", np.arange(float(size))[None])
            for name, size in STREAM_SIZES.items()
        }
    )


HEADERS = {
    "glove": "44585447 01 01 d0020000 04030201 0807060504030201",
    "fingers": "01 04 00 06 3b 44584654 01 02 30010000 04030201 0807060504030201",
    "tracker": "01 04 00 01 3a 44585054 01 03 20000000 04030201 0807060504030201",
    "camera": "44584349 01 00 20000000 04030201 0807060504030201",
    "robot": "44585253 01 00 60030000 04030201 0807060504030201",
}
DIGESTS = {
    "glove": "309fbe538ed4ae5a",
    "fingers": "c7a6f273ef145da4",
    "tracker": "fac6e74d1c0acadc",
    "camera": "b9c84fa25a94d808",
    "robot": "12dd8422d3ff6c53",
}
MAKERS = {"glove": glove, "fingers": fingers, "tracker": tracker, "camera": camera, "robot": robot}


@pytest.mark.parametrize("kind", MAKERS)
def test_bytes_never_change(kind):
    units = MAKERS[kind]().units(0, 0x01020304, 0x0102030405060708)
    assert units[0].hex().startswith(HEADERS[kind].replace(" ", ""))
    assert hashlib.sha256(b"".join(units)).hexdigest()[:16] == DIGESTS[kind]
