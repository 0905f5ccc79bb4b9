"""Differences of poses, and matrices that are no rigid transform."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.schemas import matrix_rows
from services.alignment.recording_error import pose_difference
from services.alignment.retargeting.wrist import calibrated_transform


def test_difference_of_poses_is_in_metres_and_radians():
    shifted = transform(
        rotation_from_vector(np.array([[0.0, 0.3, 0.0]])), np.array([[0.0, 0.4, 0.3]])
    )
    distance_m, angle_rad = pose_difference(np.eye(4)[None], shifted)
    np.testing.assert_allclose((distance_m[0], angle_rad[0]), (0.5, 0.3), atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "error", "words"),
    [
        (np.eye(3), ShapeError, "got shape"),
        (np.full((4, 4), np.nan), NonFiniteError, "NaN"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), InvalidInputError, "det -1.00"),
        (np.diag([1.001, 1.0, 1.0, 1.0]), InvalidInputError, "no rigid transform"),
        (np.eye(4) * 2 - np.eye(4)[:, ::-1], InvalidInputError, "no rigid transform"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), InvalidInputError, "last row"),
    ],
)
def test_calibrations_that_are_no_transforms_are_refused_by_name(matrix, error, words):
    with pytest.raises(error, match=f"T_world_base.*{words}"):
        calibrated_transform({"T_world_base": matrix_rows(matrix)}, "T_world_base")
