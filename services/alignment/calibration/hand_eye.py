"""Poses of a tracker and of a board seen by its camera in, the camera's place on the tracker out.

With X = T_tracker_camera and Z = T_world_board every view says T_world_tracker · X · T_camera_board
= Z. Two views give A X = X B for their relative motions; the rotation vectors of A and B differ by
R_X alone (Park and Martin 1994), which gives a closed form. It starts a refinement of X and Z
together, weighted by the noise that the residuals show, whose covariance is the answer's sigma.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector, vector_from_rotation
from dextouch.geometry.transforms import invert, transform

MIN_VIEWS = 4
MAX_PAIRS = 5000
# The second largest spread of rotation axes must reach this, or part of X cannot be seen.
MIN_SECOND_SPREAD_RAD = np.deg2rad(10.0)
# Near half a turn the sign of a rotation vector is noise; near none its direction is.
USABLE_ANGLE_RAD = (np.deg2rad(2.0), np.deg2rad(165.0))
# Residuals above this are no noise: frames are mixed up.
MAX_ROTATION_RMS_RAD = np.deg2rad(5.0)
MAX_TRANSLATION_RMS_M = 0.05
NOISE_ROUNDS = 3
NOISE_FLOOR = (1e-6, 1e-6)
AXIS_NAMES = ("x", "y", "z")


class DegenerateMotionError(InvalidInputError):
    """The motion does not show what is asked for; the message names the missing motion."""


@dataclass(frozen=True)
class HandEyeResult:
    """Where the camera sits on the tracker, and how well that is known (one sigma).

    Attributes:
        T_tracker_camera: the mount.
        sigma_rotation_rad: of the mount's rotation, length of the three axes' sigmas.
        sigma_translation_m: of its translation, likewise.
        T_world_board: where the board stood.
        rotation_rms_rad: what is left of the views' rotations.
        translation_rms_m: what is left of their translations.
    """

    T_tracker_camera: Float64[np.ndarray, "4 4"]
    sigma_rotation_rad: float
    sigma_translation_m: float
    T_world_board: Float64[np.ndarray, "4 4"]
    rotation_rms_rad: float
    translation_rms_m: float


def solve_hand_eye(Ts_world_tracker: np.ndarray, Ts_camera_board: np.ndarray) -> HandEyeResult:
    """Mount of a camera on a tracker, from views of a board that stands still.

    Args:
        Ts_world_tracker: [n ≥ 4, 4, 4] poses of the tracker in the world.
        Ts_camera_board: [n, 4, 4] poses of the board in the camera, same moments.

    Raises:
        DegenerateMotionError: the tracker was turned too little, or about one axis only.
        InvalidInputError: too few views, or views that contradict each other (one of the two
            series is probably inverted; the message says so where that is seen).
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    tracker, board = _checked(Ts_world_tracker, Ts_camera_board)
    a_rad, b_rad, A, B = _relative_motions(tracker, board)
    _check_motion(a_rad)
    start = _closed_form(a_rad, b_rad, A, B)
    result = _refine(tracker, board, start)
    if (
        result.rotation_rms_rad > MAX_ROTATION_RMS_RAD
        or result.translation_rms_m > MAX_TRANSLATION_RMS_M
    ):
        raise InvalidInputError(_contradiction(tracker, board, result))
    return result


def _checked(
    Ts_world_tracker: np.ndarray, Ts_camera_board: np.ndarray
) -> tuple[Float64[np.ndarray, "n 4 4"], Float64[np.ndarray, "n 4 4"]]:
    tracker = np.asarray(Ts_world_tracker, dtype=np.float64)
    board = np.asarray(Ts_camera_board, dtype=np.float64)
    if tracker.ndim != 3 or tracker.shape[1:] != (4, 4) or tracker.shape != board.shape:
        raise ShapeError(
            f"hand-eye: got poses {tracker.shape} and {board.shape}, expected two [n, 4, 4]"
        )
    for name, poses in (("Ts_world_tracker", tracker), ("Ts_camera_board", board)):
        if not np.isfinite(poses).all():
            raise NonFiniteError(f"hand-eye: {name} holds NaN or infinity; leave those views out")
        R = poses[:, :3, :3]
        if not np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-3):
            raise InvalidInputError(f"hand-eye: {name} holds matrices that are no rigid transforms")
    if len(tracker) < MIN_VIEWS:
        raise InvalidInputError(
            f"hand-eye: got {len(tracker)} views, expected at least {MIN_VIEWS}, better 20"
        )
    return tracker, board


def _relative_motions(
    tracker: np.ndarray, board: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rotation vectors and transforms of A and B for pairs of views, A X = X B."""
    pairs = np.array(list(combinations(range(len(tracker)), 2)))
    pairs = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    A = invert(tracker[pairs[:, 1]]) @ tracker[pairs[:, 0]]
    B = board[pairs[:, 1]] @ invert(board[pairs[:, 0]])
    a_rad, b_rad = vector_from_rotation(A[:, :3, :3]), vector_from_rotation(B[:, :3, :3])
    return a_rad, b_rad, A, B


def _check_motion(a_rad: np.ndarray) -> None:
    """Refuse turns about one axis only; `a_rad` are turns in the tracker's own frame."""
    _, spread, axes = np.linalg.svd(a_rad / np.sqrt(len(a_rad)), full_matrices=False)
    if spread[1] >= MIN_SECOND_SPREAD_RAD:
        return
    told = "/".join(f"{value:.1f}" for value in np.rad2deg(spread))
    wanted = [axes[1], axes[2]] if spread[0] >= MIN_SECOND_SPREAD_RAD else list(axes)
    names = sorted({AXIS_NAMES[int(np.argmax(np.abs(axis)))] for axis in wanted})
    raise DegenerateMotionError(
        f"hand-eye: turns of the tracker spread {told} degrees along three axes, expected the "
        f"second at least {np.rad2deg(MIN_SECOND_SPREAD_RAD):.0f}; also turn the tracker by 30 "
        f"degrees and more about its {' and '.join(names)} axis",
        spread_deg=[float(value) for value in np.rad2deg(spread)],
        missing_axes=names,
    )


def _closed_form(
    a_rad: np.ndarray, b_rad: np.ndarray, A: np.ndarray, B: np.ndarray
) -> Float64[np.ndarray, "4 4"]:
    """Park's rotation by an orthogonal fit of rotation vectors, then linear translation."""
    low, high = USABLE_ANGLE_RAD
    angles = np.linalg.norm(a_rad, axis=1), np.linalg.norm(b_rad, axis=1)
    use = np.logical_and.reduce([(angle > low) & (angle < high) for angle in angles])
    if use.sum() < 2:
        use = np.ones(len(a_rad), dtype=bool)
    U, _, Vt = np.linalg.svd(a_rad[use].T @ b_rad[use])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = ((R @ B[:, :3, 3:])[..., 0] - A[:, :3, 3]).reshape(-1)
    t, *_ = np.linalg.lstsq(left, right, rcond=None)
    return transform(R, t)


def _refine(tracker: np.ndarray, board: np.ndarray, start: np.ndarray) -> HandEyeResult:
    """Gauss–Newton on X and Z; the noise of rotation and translation is taken from what is left."""
    views = tracker @ start @ board
    X, Z = start, _mean_pose(views)
    noise = np.array([1e-2, 1e-2])
    covariance = np.eye(12)
    for _ in range(NOISE_ROUNDS):

        def weighted(
            step: np.ndarray,
            X: np.ndarray = X,
            Z: np.ndarray = Z,
            noise: np.ndarray = noise,
        ) -> np.ndarray:
            rotation, translation = _residuals(
                tracker, board, _moved(X, step[:6]), _moved(Z, step[6:])
            )
            return np.concatenate([rotation / noise[0], translation / noise[1]], axis=None)

        fit = least_squares(weighted, np.zeros(12), x_scale="jac")
        X, Z = _moved(X, fit.x[:6]), _moved(Z, fit.x[6:])
        rotation, translation = _residuals(tracker, board, X, Z)
        # 12 of the 6 n numbers are used up by the unknowns.
        unused = 1 - 12 / (6 * len(tracker))
        left = [float(np.mean(part**2)) / unused for part in (rotation, translation)]
        noise = np.maximum(np.sqrt(left), NOISE_FLOOR)
        jacobian: np.ndarray = np.array(fit.jac)
        covariance = np.linalg.pinv(jacobian.T @ jacobian)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
    return HandEyeResult(
        T_tracker_camera=X,
        sigma_rotation_rad=float(np.linalg.norm(sigma[:3])),
        sigma_translation_m=float(np.linalg.norm(sigma[3:6])),
        T_world_board=Z,
        rotation_rms_rad=float(np.sqrt((rotation**2).sum(axis=1).mean())),
        translation_rms_m=float(np.sqrt((translation**2).sum(axis=1).mean())),
    )


def _residuals(
    tracker: np.ndarray, board: np.ndarray, X: np.ndarray, Z: np.ndarray
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """What separates each view's board from Z: rotation vectors and translations, board axes."""
    E = invert(Z) @ tracker @ X @ board
    return vector_from_rotation(E[:, :3, :3]), E[:, :3, 3]


def _moved(T: np.ndarray, step: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """T after a small turn in its own frame and a shift in its parent's."""
    return transform(T[:3, :3] @ rotation_from_vector(step[:3]), T[:3, 3] + step[3:])


def _mean_pose(Ts: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """Rotation nearest to the mean matrix (chordal mean), mean translation."""
    U, _, Vt = np.linalg.svd(Ts[:, :3, :3].mean(axis=0))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return transform(R, Ts[:, :3, 3].mean(axis=0))


def _contradiction(tracker: np.ndarray, board: np.ndarray, result: HandEyeResult) -> str:
    hint = "check that both series belong to the same moments and the board stood still"
    for name, other in (
        ("Ts_world_tracker", (invert(tracker), board)),
        ("Ts_camera_board", (tracker, invert(board))),
    ):
        motions = _relative_motions(*other)
        again = _refine(*other, _closed_form(*motions))
        if again.translation_rms_m < 0.2 * result.translation_rms_m:
            hint = f"{name} is probably inverted: the views agree when it is turned round"
    return (
        f"hand-eye: the views contradict each other by {np.rad2deg(result.rotation_rms_rad):.1f} "
        f"degrees and {result.translation_rms_m * 1e3:.0f} mm RMS, expected at most "
        f"{np.rad2deg(MAX_ROTATION_RMS_RAD):.0f} and {MAX_TRANSLATION_RMS_M * 1e3:.0f}; {hint}"
    )


def mount_difference(
    T_tracker_camera_a: np.ndarray, T_tracker_camera_b: np.ndarray
) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two mounts."""
    T_a_b = invert(T_tracker_camera_a) @ T_tracker_camera_b
    return float(rotation_angle(T_a_b[:3, :3])), float(np.linalg.norm(T_a_b[:3, 3]))
