"""Poses that a robot tells in its own base come to the world by calibration, or are refused."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.geometry import pose_from_transform, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.schemas import RecordingAttributes, matrix_rows
from dextouch.streams import StreamDescriptor
from services.alignment.synchronization.recorded_streams import date_stream

RNG = np.random.default_rng(4)


def random_transforms(count):
    turns = rotation_from_vector(RNG.normal(size=(count, 3)))
    return transform(turns, RNG.normal(size=(count, 3)))


T_WORLD_BASE, T_TRACKER_WRIST = random_transforms(2)
TS_BASE_TRACKER = random_transforms(100)


def recording(folder, frame, calibration):
    store = EpisodeStore(folder)
    attributes = RecordingAttributes(
        recording_id="take",
        task="stand-bottle",
        instruction="",
        domain="robot",
        station="test",
        started_t_host_ns=0,
        calibration={name: matrix_rows(matrix) for name, matrix in calibration.items()},
    )
    t_ns = np.arange(100, dtype=np.int64) * 10_000_000
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.add_stream(
            StreamDescriptor(
                name="wrist_left",
                kind="pose",
                shape=(7,),
                dtype="float64",
                unit="pose_m_wxyz",
                frame=frame,
                nominal_rate_hz=100,
            )
        )
        writer.append(
            "wrist_left",
            values=pose_from_transform(TS_BASE_TRACKER),
            t_host_ns=t_ns,
            t_device_ns=t_ns,
        )
    return store.recording("take")


@pytest.mark.parametrize("mount", [None, T_TRACKER_WRIST], ids=["at the wrist", "on a mount"])
def test_base_poses_come_to_the_world(tmp_path, mount):
    calibration = {"T_world_base": T_WORLD_BASE}
    expected = T_WORLD_BASE @ TS_BASE_TRACKER
    if mount is not None:
        calibration["T_tracker_left_wrist_left"] = mount
        expected = expected @ mount
    dated = date_stream(recording(tmp_path, "base", calibration), "wrist_left")
    np.testing.assert_allclose(transform_from_pose(dated.load().values), expected, atol=1e-12)
    assert dated.descriptor.frame == "world"


def test_world_poses_stay(tmp_path):
    dated = date_stream(recording(tmp_path, "world", {"T_world_base": T_WORLD_BASE}), "wrist_left")
    np.testing.assert_allclose(
        transform_from_pose(dated.load().values), TS_BASE_TRACKER, atol=1e-12
    )


def test_an_unknown_base_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"T_world_base.*missing"):
        date_stream(recording(tmp_path, "base", {}), "wrist_left")
    skewed = T_WORLD_BASE.copy()
    skewed[0, 0] += 0.5
    with pytest.raises(InvalidInputError, match="T_world_base"):
        date_stream(recording(tmp_path / "b", "base", {"T_world_base": skewed}), "wrist_left")
