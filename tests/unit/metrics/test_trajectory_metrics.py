"""Pose errors against displacements and turns of known size."""

import numpy as np
import pytest

from dextouch.errors import ShapeError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import transform
from dextouch.metrics.trajectory import pose_error, position_errors_m, rotation_errors_rad


def test_known_displacement_and_turn():
    rng = np.random.default_rng(7)
    R = rotation_from_vector(rng.normal(size=(3, 3)))
    true = transform(R, rng.normal(size=(3, 3)))
    turn = rotation_from_vector(np.array([[0.0, 0.0, 0.0], [0.3, 0, 0], [0, 0, -0.4]]))
    moved = transform(R @ turn, true[:, :3, 3] + [[0, 0, 0], [0.03, 0, 0], [0, 0.04, 0]])
    error = pose_error(Ts_world_reached=moved, Ts_world_true=true)
    assert error.position_rms_m == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 3))
    assert error.position_max_m == pytest.approx(0.04)
    assert error.rotation_rms_rad == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 3))
    assert error.rotation_max_rad == pytest.approx(0.4)


def test_batches_keep_their_shape():
    points = np.zeros((4, 5, 3))
    assert position_errors_m(reached_m=points + 1, true_m=points).shape == (4, 5)
    half_turn = rotation_from_vector(np.array([np.pi, 0, 0]))
    angle = rotation_errors_rad(R_world_reached=half_turn, R_world_true=np.eye(3))
    assert angle == pytest.approx(np.pi)


def test_other_shapes_are_refused():
    with pytest.raises(ShapeError, match="4, 4"):
        pose_error(Ts_world_reached=np.zeros((3, 4)), Ts_world_true=np.zeros((3, 4)))
