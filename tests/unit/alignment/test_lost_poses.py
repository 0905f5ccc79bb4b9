"""Poses that a tracker lost, as zeros or as NaN, are gaps of one stream and end no alignment."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.geometry import pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.schemas import matrix_rows
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from tests.unit.alignment import recordings

# Of 10 ms each: short enough to be bridged.
LOST = slice(100, 103)
T_TRACKER_WRIST = transform(rotation_from_vector(np.array([0.3, -0.2, 0.5])), np.array([0, 0, 0.1]))


def zero_quaternion(poses):
    return np.where(np.arange(7) < 3, poses, 0.0)


@pytest.mark.parametrize("mount", [None, T_TRACKER_WRIST], ids=["at the wrist", "on a mount"])
@pytest.mark.parametrize(
    "lost",
    [zero_quaternion, np.zeros_like, lambda poses: np.full_like(poses, np.nan)],
    ids=["zero quaternion", "all zero", "NaN"],
)
def test_lost_poses_are_dropped_and_counted(tmp_path, lost, mount):
    def edit(name, values):
        if name == "wrist_left":
            values[LOST] = lost(values[LOST])
        return values

    store = EpisodeStore(tmp_path)
    calibration = {} if mount is None else {"T_tracker_left_wrist_left": matrix_rows(mount)}
    recordings.write_recording(store, "take", calibration=calibration, edit=edit)
    report = align_recording(store, "take", AlignmentOptions())
    assert report.quality["wrist_left_num_incomplete"] == 3
    # Every pose that is kept is the one at which the robot stands still.
    kept = store.open(report.episode_id).read("wrist_left").values
    expected = transform(np.eye(3), recordings.POSE[:3])
    if mount is not None:
        expected = expected @ mount
    assert len(kept) > 150
    np.testing.assert_allclose(
        kept, np.tile(pose_from_transform(expected), (len(kept), 1)), atol=1e-9
    )
