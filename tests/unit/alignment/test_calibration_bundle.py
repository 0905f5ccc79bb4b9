"""Parts of the calibration bundle against plain, slow ways to the same numbers."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares

from benchmarks.simulated.board_scenes import DISTORTION, K, Motion, board_points, make_scene
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_from_vector, vector_from_rotation
from services.alignment.calibration.bundle import (
    Component,
    estimate_sigmas,
    pose_measurement,
    predicted_jacobians,
    solve_bundle,
)
from services.alignment.calibration.hand_eye import (
    BoardViews,
    _check_lens,
    polish,
    project,
    solve_hand_eye,
)
from services.alignment.calibration.motion import (
    adjoint,
    check_turns,
    hat,
    move,
    right_jacobian_inverse,
    twist,
)


def some_poses(num, seed=0):
    rng = np.random.default_rng(seed)
    return transform(rotation_from_vector(rng.normal(size=(num, 3))), rng.normal(size=(num, 3)))


def test_hat_multiplies_crosswise():
    a, b = np.random.default_rng(0).normal(size=(2, 5, 3))
    np.testing.assert_allclose((hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


def test_adjoints_carry_twists_between_frames():
    (T,) = some_poses(1)
    small = 1e-6 * np.random.default_rng(1).normal(size=6)
    np.testing.assert_allclose(T @ move(small), move(adjoint(T) @ small) @ T, atol=1e-11)


def test_twists_undo_moves():
    small = 0.5 * np.random.default_rng(2).normal(size=(7, 6))
    np.testing.assert_allclose(twist(move(small)), small, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-5, 0.99e-3, 1.01e-3, 0.1, 2.0])
def test_the_right_jacobian_is_the_derivative_of_the_logarithm(angle_rad):
    v = angle_rad * np.array([0.6, -0.48, 0.64])
    R = rotation_from_vector(v)
    step = 1e-6
    columns = [
        (
            vector_from_rotation(R @ rotation_from_vector(step * e))
            - vector_from_rotation(R @ rotation_from_vector(-step * e))
        )
        / (2 * step)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(right_jacobian_inverse(v), np.array(columns).T, atol=1e-8)


def test_projection_and_its_jacobian_are_opencvs_and_the_numeric_one():
    import cv2

    points, scene = board_points(), make_scene(0, Motion(num_views=4))
    for T in scene.Ts_camera_board:
        pixels, J = project(points[None], T[None], K, DISTORTION)
        theirs, _ = cv2.projectPoints(
            points, vector_from_rotation(T[:3, :3]), T[:3, 3], K, DISTORTION
        )
        np.testing.assert_allclose(pixels[0], theirs[:, 0], atol=1e-9)

        def moved(small, T=T):
            return project(points[None], (T @ move(small))[None], K, DISTORTION)[0].ravel()

        numeric = approx_fprime(np.zeros(6), moved, 1e-7)
        np.testing.assert_allclose(J.reshape(-1, 6), numeric, atol=2e-3, rtol=1e-4)


def test_points_behind_the_camera_are_refused():
    with pytest.raises(InvalidInputError, match="behind"):
        project(board_points()[None], np.eye(4)[None] * 1.0, K, DISTORTION)


@pytest.mark.parametrize(("depth_m", "is_refused"), [(-0.01, True), (0.0, True), (0.01, False)])
def test_one_corner_behind_the_camera_is_enough(depth_m, is_refused):
    """Nor has a corner in the plane of the camera's centre an image."""
    corners = np.array([[[0.0, 0, 0.5], [0.001, 0, depth_m], [0.1, 0, 0.5]]])
    if is_refused:
        with pytest.raises(InvalidInputError, match="behind"):
            project(corners, np.eye(4)[None], K, DISTORTION)
    else:
        assert np.isfinite(project(corners, np.eye(4)[None], K, DISTORTION)[0]).all()


def test_predicted_poses_move_as_their_jacobians_say():
    W, X, Z = some_poses(1, 1), some_poses(1, 2)[0], some_poses(1, 3)[0]
    X_B = invert(W) @ Z
    Ts = invert(X) @ X_B
    J, C = predicted_jacobians(Ts, X_B, 1.25)
    rng = np.random.default_rng(4)
    x, z, d = 1e-6 * rng.normal(size=(3, 6))
    moved = invert(X @ move(x)) @ invert(W @ move(d)) @ Z @ move(z)
    expected = J @ np.array([*x, *z, 2e-6]) + C @ d
    measured, moved_measured = Ts.copy(), moved.copy()
    measured[:, :3, 3] /= 1.25
    moved_measured[:, :3, 3] /= 1.25 * np.exp(2e-6)
    np.testing.assert_allclose(twist(invert(measured) @ moved_measured), expected, atol=5e-11)


def test_the_schur_complement_gives_what_all_unknowns_together_give():
    """Against a plain least-squares solver that carries every view's correction."""
    scene = make_scene(3, Motion(num_views=6))
    W, B = scene.Ts_world_tracker, scene.Ts_camera_board
    X, Z = scene.T_tracker_camera, scene.T_world_board
    sigma = np.repeat([9e-4, 5e-4], 3)
    weights = 1 / np.array([1.5e-3, 1.5e-3, 5e-4, 1.5e-4, 1.5e-4, 4e-4])

    def residuals(all_unknowns):
        x, z, log_scale = all_unknowns[:6], all_unknowns[6:12], all_unknowns[12]
        d = all_unknowns[13:].reshape(-1, 6)
        Ts = invert(X @ move(x)) @ invert(W @ move(d)) @ (Z @ move(z))
        Ts[:, :3, 3] /= np.exp(log_scale)
        errors = np.concatenate([weights * twist(invert(B) @ Ts), d / sigma]).ravel()
        return np.append(errors, log_scale / 0.004)

    plain = least_squares(
        residuals,
        np.zeros(49),
        x_scale=np.insert(np.tile(sigma, 8), 12, 1e-3),
        xtol=1e-14,
        ftol=1e-14,
    )
    information = np.broadcast_to(np.diag(weights**2), (6, 6, 6))
    bundle = solve_bundle(
        W, pose_measurement(B, information), (9e-4, 5e-4), (X, Z), scale_sigma=0.004
    )
    np.testing.assert_allclose(np.log(bundle.scale), plain.x[12], atol=1e-7)
    np.testing.assert_allclose(bundle.X, X @ move(plain.x[:6]), atol=1e-7)
    np.testing.assert_allclose(bundle.Z, Z @ move(plain.x[6:12]), atol=1e-7)
    covariance = np.linalg.inv(plain.jac.T @ plain.jac)[:13, :13]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(bundle.covariance / scale, covariance / scale, atol=3e-3)


def test_corners_and_poses_with_their_information_say_the_same():
    scene = make_scene(5)
    pixels = scene.views.measurement(0.3)
    B = polish(pixels, scene.Ts_camera_board)
    start = scene.T_tracker_camera, scene.T_world_board
    by_pixels = solve_bundle(scene.Ts_world_tracker, pixels, (8.7e-4, 5e-4), start)
    poses = pose_measurement(B, pixels(B).information)
    by_poses = solve_bundle(scene.Ts_world_tracker, poses, (8.7e-4, 5e-4), start)
    apart = twist(invert(by_pixels.X) @ by_poses.X)
    sigmas = np.sqrt(np.diag(by_pixels.covariance)[:6])
    assert np.abs(apart / sigmas).max() < 0.1


def test_sizes_of_noise_are_found_again():
    rng = np.random.default_rng(6)
    num, true = 400, np.array([2.0, 0.5])
    shapes = np.zeros((2, num, 6, 6))
    shapes[0, :, :3, :3] = np.eye(3)
    mixed = rng.normal(size=(num, 6, 6))
    shapes[1] = mixed @ np.swapaxes(mixed, 1, 2)
    J = rng.normal(size=(num, 6, 12))
    left_over = (J @ rng.normal(size=(12, 1)))[..., 0]
    left_over[:, :3] += true[0] * rng.normal(size=(num, 3))
    left_over += true[1] * (mixed @ rng.normal(size=(num, 6, 1)))[..., 0]
    for factor in (0.25, 4.0):
        declared = [Component(factor * s, m) for s, m in zip(true, shapes, strict=True)]
        np.testing.assert_allclose(estimate_sigmas(left_over, J, declared), true, rtol=0.1)


def test_views_without_spread_stay_near_what_was_declared():
    """Exact views must not make a size of zero, with which nothing could be solved."""
    shapes = np.broadcast_to(np.eye(6), (10, 6, 6))
    J = np.random.default_rng(7).normal(size=(10, 6, 12))
    (sigma,) = estimate_sigmas(np.zeros((10, 6)), J, [Component(1.0, shapes)])
    assert 0 < sigma < 1


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda points, pixels: (points[:3], pixels[:3]), InvalidInputError),
        (lambda points, pixels: (points, pixels[:-1]), ShapeError),
        (lambda points, pixels: (points, pixels * np.nan), NonFiniteError),
    ],
)
def test_corners_that_do_not_fit_are_refused(change, error):
    views = make_scene(0, Motion(num_views=4)).views
    points, pixels = change(views.points_board[1], views.pixels_px[1])
    with pytest.raises(error, match="board view 1"):
        BoardViews([views.points_board[0], points], [views.pixels_px[0], pixels], K, DISTORTION)
    with pytest.raises(ShapeError, match="same number"):
        BoardViews(views.points_board, views.pixels_px[:2], K, DISTORTION)


def test_corners_must_be_given_for_every_pose():
    scene = make_scene(0)
    few = scene.views.only(np.arange(5))
    with pytest.raises(ShapeError, match="5 views of corners and 20 poses"):
        solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board, views=few)


def test_views_may_have_different_numbers_of_corners():
    """As ChArUco boards do: corners that are not seen count nothing."""
    scene = make_scene(8)
    keep = [np.arange(54) if k % 2 else np.arange(20) for k in range(20)]
    views = BoardViews(
        [p[k] for p, k in zip(scene.views.points_board, keep, strict=True)],
        [p[k] for p, k in zip(scene.views.pixels_px, keep, strict=True)],
        K,
        DISTORTION,
    )
    B = polish(scene.views.measurement(0.3), scene.Ts_camera_board)
    all_seen, some = scene.views.measurement(0.3)(B), views.measurement(0.3)(B)
    np.testing.assert_allclose(some.information[1::2], all_seen.information[1::2])
    for k in range(0, 20, 2):
        alone = views.only(np.array([k])).measurement(0.3)(B[k : k + 1])
        np.testing.assert_allclose(some.information[k], alone.information[0])
        np.testing.assert_allclose(some.gradient[k], alone.gradient[0])


@pytest.mark.parametrize("num_views", [4, 6])
def test_few_corners_say_nothing_against_a_lens(num_views):
    """A square marker has four; their poses leave less than ten of the residuals free."""
    for seed in range(10):
        views = make_scene(seed, Motion(num_views=num_views)).views
        # The corners of the 9 x 6 board.
        corners = np.array([0, 8, 45, 53])
        pixels = [one[corners] for one in views.pixels_px]
        few = BoardViews([one[corners] for one in views.points_board], pixels, K, DISTORTION)
        scene = make_scene(seed, Motion(num_views=num_views))
        _check_lens(few, polish(few.measurement(1.0), scene.Ts_camera_board))


def test_the_gate_lets_two_axes_pass():
    turns = np.zeros((9, 3))
    turns[1:5, 0], turns[5:, 1] = np.linspace(-0.6, 0.6, 4), np.linspace(-0.6, 0.6, 4)
    check_turns("test", "body", transform(rotation_from_vector(turns), np.zeros((9, 3))))


def test_sizes_of_noise_count_the_unknowns_that_were_fitted():
    """Ten views leave 48 of 60 numbers to judge by; to forget that would say 0.89."""
    rng = np.random.default_rng(9)
    shapes = np.broadcast_to(np.eye(6), (10, 6, 6))
    found = []
    for _ in range(40):
        J, left_over = rng.normal(size=(10, 6, 12)), rng.normal(size=(10, 6))
        found.append(estimate_sigmas(left_over, J, [Component(1.0, shapes)])[0])
    assert 0.96 < np.sqrt(np.mean(np.square(found))) < 1.04
