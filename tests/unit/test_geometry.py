"""Rotations, transforms and re-anchoring: group axioms, both sides of every series switch."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dextouch.errors import DegenerateRotationError, InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import rotations, transforms

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


@given(vectors)
def test_exponential_and_logarithm_are_inverse(vector):
    R = rotations.rotation_from_vector(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    again = rotations.rotation_from_vector(rotations.vector_from_rotation(R))
    np.testing.assert_allclose(again, R, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-3, 1.01e-3, 1.0, np.pi - 1e-7, np.pi])
def test_angle_is_kept_at_the_switch_points(angle):
    R = rotations.rotation_from_vector(np.array([0.0, 0.6, 0.8]) * angle)
    assert rotations.rotation_angle(R) == pytest.approx(angle, abs=1e-12, rel=1e-9)


@given(vectors)
def test_6d_and_quaternion_round_trips(vector):
    R = rotations.rotation_from_vector(vector)
    np.testing.assert_allclose(
        rotations.rotation_from_6d(rotations.rotation_to_6d(R)), R, atol=1e-12
    )
    q = rotations.quaternion_from_rotation(R)
    np.testing.assert_allclose(rotations.rotation_from_quaternion(q), R, atol=1e-12)


def test_vectors_and_quaternions_are_those_of_scipy():
    # Random rotations of every kind, half turns among them: scipy's vectors have 0 … π, its
    # canonical quaternions w ≥ 0.
    theirs = Rotation.random(2000, random_state=7)
    R = theirs.as_matrix()
    vectors = rotations.vector_from_rotation(R)
    np.testing.assert_allclose(vectors, theirs.as_rotvec(), atol=1e-7)
    assert np.linalg.norm(vectors, axis=-1).max() <= np.pi
    x, y, z, w = theirs.as_quat(canonical=True).T
    q_wxyz = rotations.quaternion_from_rotation(R)
    np.testing.assert_allclose(q_wxyz, np.stack([w, x, y, z], axis=-1), atol=1e-12)
    np.testing.assert_allclose(rotations.rotation_angle(R), theirs.magnitude(), atol=1e-7)
    np.testing.assert_allclose(rotations.rotation_from_vector(theirs.as_rotvec()), R, atol=1e-12)


def test_nearly_parallel_columns_still_give_orthogonal_matrices():
    rng = np.random.default_rng(3)
    first = rng.normal(size=(500, 3))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = first + 2e-6 * rng.normal(size=(500, 3)) / np.sqrt(3)
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    columns = np.concatenate([first, second], axis=-1)[sine > 1.1e-6]
    R = rotations.rotation_from_6d(columns)
    assert len(R) > 100
    np.testing.assert_allclose(
        np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14
    )


@pytest.mark.parametrize(
    "columns", [np.zeros(6), [1, 0, 0, 2, 0, 0], [1, 0, 0, -1, 1e-9, 0], [0, 0, 0, 0, 1, 0]]
)
def test_degenerate_columns_are_refused(columns):
    with pytest.raises(DegenerateRotationError):
        rotations.rotation_from_6d(np.array(columns, dtype=float))


def test_tiny_and_huge_columns_survive():
    columns = np.array([[1e-200, 0, 0, 0, 1e200, 0], [1, 0, 0, 1, 1e-5, 0]])
    R = rotations.rotation_from_6d(columns)
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-14
    )


def test_a_quarter_of_the_way_is_three_parts_of_the_earlier_sample():
    t_ns, at_ns = np.array([0, 100, 200]), np.array([25, 100, 150])
    left, weight, valid = transforms.bracket(t_ns, at_ns, max_gap_ns=100)
    assert valid.all()
    values = transforms.interpolate_linear(np.array([0.0, 8.0, 10.0]), left, weight)
    np.testing.assert_allclose(values, [2.0, 8.0, 9.0])


def test_the_nearest_sample_of_two_equally_near_ones_is_the_earlier():
    t_ns = np.array([0, 10, 20])
    at_ns = np.array([-3, 4, 5, 6, 15, 16, 99])
    assert transforms.nearest_index(t_ns, at_ns).tolist() == [0, 0, 0, 1, 1, 2, 2]


def test_a_pinhole_camera_sees_its_field_of_view_edge_to_edge():
    # 90° high: half the height is seen at 45°, so that the focal length is half the height.
    K = transforms.pinhole_matrix(width_px=640, height_px=480, fovy_rad=np.pi / 2)
    np.testing.assert_allclose(K, [[240, 0, 320], [0, 240, 240], [0, 0, 1]])
    points = np.array([[0.0, 0.0, 2.0], [0.0, 2.0, 2.0], [-1.0, 0.0, 2.0], [0.0, 0.0, -1.0]])
    pixels, in_front = transforms.project(K, points)
    np.testing.assert_allclose(pixels[:3], [[320, 240], [320, 480], [200, 240]])
    assert in_front.tolist() == [True, True, True, False]


def test_nan_and_wrong_shapes_are_refused():
    with pytest.raises(NonFiniteError):
        rotations.rotation_from_6d(np.full(6, np.nan))
    with pytest.raises(ShapeError):
        rotations.rotation_to_6d(np.zeros((2, 3)))
    with pytest.raises(DegenerateRotationError):
        rotations.rotation_from_quaternion(np.zeros(4))


@given(vectors, vectors)
def test_inverse_cancels(vector, translation):
    T = transforms.transform(rotations.rotation_from_vector(vector), translation)
    np.testing.assert_allclose(T @ transforms.invert(T), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        transforms.transform_from_pose(transforms.pose_from_transform(T)), T, atol=1e-12
    )


@settings(max_examples=30)
@given(st.integers(0, 2**31))
def test_interpolated_poses_follow_a_screw(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    t_ns = np.cumsum(rng.integers(5_000_000, 12_000_000, size=20))
    Ts = transforms.transform(
        rotations.rotation_from_vector(t_ns[:, None] * 1e-9 * axis * 4), t_ns[:, None] * 1e-9 * axis
    )
    at_ns = rng.integers(t_ns[0], t_ns[-1], size=50)
    left, weight, valid = transforms.bracket(t_ns, at_ns, max_gap_ns=20_000_000)
    got = transforms.interpolate_poses(Ts, left, weight)
    expected = transforms.transform(
        rotations.rotation_from_vector(at_ns[:, None] * 1e-9 * axis * 4),
        at_ns[:, None] * 1e-9 * axis,
    )
    assert valid.all()
    np.testing.assert_allclose(got, expected, atol=1e-9)


def test_gaps_and_outside_are_marked_not_filled():
    t_ns = np.array([0, 10, 100, 110])
    _, _, valid = transforms.bracket(t_ns, np.array([-1, 5, 10, 50, 100, 110, 111]), max_gap_ns=20)
    assert valid.tolist() == [False, True, True, False, True, True, False]
    with pytest.raises(InvalidInputError):
        transforms.bracket(np.array([0, 0]), np.array([0]), max_gap_ns=1)


def test_the_error_of_transforms_that_are_not_rigid():
    R = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()
    T = transforms.transform(R, np.array([1.0, 2.0, 3.0]))
    assert transforms.rigid_error(np.stack([T, np.eye(4)])) < 1e-12
    # By hand: stretched by 1 %, RᵀR is 1.0201 I; the last row is half a metre off.
    stretched, moved = np.eye(4), np.eye(4)
    stretched[:3, :3] *= 1.01
    moved[3, 0] = 0.5
    assert transforms.rigid_error(stretched) == pytest.approx(0.0201)
    assert transforms.rigid_error(np.stack([T, moved])) == 0.5
    assert transforms.rigid_error(np.zeros((0, 4, 4))) == 0.0
    for entry, value in (((0, 0), np.nan), ((0, 3), np.inf), ((2, 2), -1.0)):
        wrong = np.eye(4)
        wrong[entry] = value
        assert transforms.rigid_error(wrong) == np.inf
