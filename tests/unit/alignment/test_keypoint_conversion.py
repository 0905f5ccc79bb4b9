"""Keypoints in a tracker's own axes: turned by the recording's calibration, refused without it."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.schemas import matrix_rows
from services.alignment.jobs import align_recording
from services.alignment.retargeting.wrist import calibration_name
from services.alignment.settings import AlignmentOptions
from tests.accuracy.test_alignment import EpisodeStore, truth_streams, write_recording

R_TRACKER_WRIST = rotation_from_vector(np.array([[0.0, 1.2, 0.9]]))[0]


def turned(recorded, calibration, *, calibrated):
    for side in ("left", "right"):
        columns = recorded[f"keypoints_{side}"][1]
        columns[3] = (columns[3].astype(float) @ R_TRACKER_WRIST.T).astype(np.float32)
        if calibrated:
            T = np.eye(4)
            T[:3, :3] = R_TRACKER_WRIST
            calibration[calibration_name(side)] = matrix_rows(T)


@pytest.mark.long
def test_calibrated_axes_give_the_same_joints(tmp_path):
    store = EpisodeStore(tmp_path)
    streams = truth_streams("human")
    write_recording(store, streams, "human", recording_id="straight")
    write_recording(
        store,
        streams,
        "human",
        recording_id="turned",
        edit=lambda recorded, calibration: turned(recorded, calibration, calibrated=True),
    )
    straight, back = (
        store.open(align_recording(store, name, AlignmentOptions()).episode_id)
        for name in ("straight", "turned")
    )
    np.testing.assert_allclose(
        back.read("keypoints_left").values, straight.read("keypoints_left").values, atol=1e-6
    )
    apart = np.abs(back.read("action").values - straight.read("action").values)
    assert np.median(apart[:, 18:58]) < 1e-4


def test_axes_that_nobody_calibrated_are_refused(tmp_path):
    store = EpisodeStore(tmp_path)
    write_recording(
        store,
        truth_streams("human"),
        "human",
        edit=lambda recorded, calibration: turned(recorded, calibration, calibrated=False),
    )
    with pytest.raises(InvalidInputError, match="wrist's axes"):
        align_recording(store, "take", AlignmentOptions())
    assert store.list() == []
