"""Closed-form hand-eye calibration, and the selection of views that agree with it.

With X = T_tracker_camera and Z = T_world_board every view says T_world_tracker · X · T_camera_board
= Z. Two views give A X = X B for their relative motions; the rotation vectors of A and B differ by
R_X alone (Park and Martin 1994), which gives the rotation; the translation is linear.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_angle, vector_from_rotation
from services.alignment.calibration.motion import MIN_VIEWS, check_turns, view_pairs
from services.alignment.calibration.twists import nearest_pose, nearest_rotation

# Near half a turn the sign of a rotation vector is noise; near none its direction is.
USABLE_ANGLE_RAD = (np.deg2rad(2.0), np.deg2rad(165.0))
# Residuals above this are no noise: frames are mixed up.
MAX_ROTATION_RMS_RAD = np.deg2rad(5.0)
MAX_TRANSLATION_RMS_M = 0.05
# A view so many times farther off than the middle one is no noise either.
OUTLIER_RATIO = 8.0
MAX_OUTLIER_SHARE = 0.2
# Views better than this are exact; ratios to them say nothing (rad, m).
EXACT = (np.deg2rad(0.01), 1e-4)
# An inverted series is named where turning it round leaves less than this share of the error.
INVERTED_SHARE = 0.2


class Series(NamedTuple):
    """Two series of simultaneous poses, with their names in messages."""

    task: str
    body: str
    Ts_world_body: Float64[np.ndarray, "n 4 4"]
    Ts_mounted_target: Float64[np.ndarray, "n 4 4"]
    names: tuple[str, str]

    def only(self, views: np.ndarray) -> "Series":
        """A subset of the views."""
        body, target = self.Ts_world_body[views], self.Ts_mounted_target[views]
        return self._replace(Ts_world_body=body, Ts_mounted_target=target)


class Agreement(NamedTuple):
    """Consistent views, with the mount X and the target's pose Z that they determine."""

    views: np.ndarray
    X: Float64[np.ndarray, "4 4"]
    Z: Float64[np.ndarray, "4 4"]

    def predicted(self, series: Series) -> Float64[np.ndarray, "n 4 4"]:
        """Poses of the target in the mounted frame at which the body's poses put it."""
        return invert(series.Ts_world_body @ self.X) @ self.Z

    def left_out(self, series: Series) -> tuple[int, ...]:
        """The views of a whole series that do not count."""
        return tuple(sorted(set(range(len(series.Ts_world_body))) - set(self.views.tolist())))


def agreeing_views(series: Series, mount: np.ndarray | None = None) -> Agreement:
    """Mount (in closed form, unless it is given) and target, without outlier views.

    Raises:
        DegenerateMotionError: the views that agree show no mount.
        InvalidInputError: the views contradict each other; an inverted series is named.
    """
    num_views = len(series.Ts_world_body)
    views = np.arange(num_views)
    min_views = max(MIN_VIEWS, int(np.ceil((1 - MAX_OUTLIER_SHARE) * num_views)))
    while True:
        used = series.only(views)
        if mount is None:
            check_turns(series.task, series.body, used.Ts_world_body)
        X = park(used.Ts_world_body, used.Ts_mounted_target) if mount is None else mount
        Z, errors = view_errors(used, X)
        if mount is None:
            check_sides(used, errors)
        ratios = (errors / np.maximum(np.median(errors, axis=0), EXACT)).max(axis=1)
        if ratios.max() <= OUTLIER_RATIO:
            _check_noise(series.task, errors)
            return Agreement(views, X, Z)
        if len(views) <= min_views:
            far_off = views[ratios > OUTLIER_RATIO].tolist()
            raise InvalidInputError(
                f"{series.task}: more than {MAX_OUTLIER_SHARE:.0%} of {num_views} views disagree "
                f"with the others, among them {far_off}; check that both series are of the same "
                "moments and the target did not move",
                views=far_off,
            )
        views = np.delete(views, int(np.argmax(ratios)))


def park(Ts_world_body: np.ndarray, Ts_mounted_target: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """Hand-eye solution of Park and Martin (1994): rotation first, then translation."""
    pairs = view_pairs(len(Ts_world_body))
    A = invert(Ts_world_body[pairs[:, 1]]) @ Ts_world_body[pairs[:, 0]]
    B = Ts_mounted_target[pairs[:, 1]] @ invert(Ts_mounted_target[pairs[:, 0]])
    a_rad, b_rad = vector_from_rotation(A[:, :3, :3]), vector_from_rotation(B[:, :3, :3])
    low, high = USABLE_ANGLE_RAD
    angles = np.linalg.norm(a_rad, axis=1), np.linalg.norm(b_rad, axis=1)
    use = np.logical_and.reduce([(angle > low) & (angle < high) for angle in angles])
    if use.sum() < 2:
        use = np.ones(len(a_rad), dtype=bool)
    R = nearest_rotation(a_rad[use].T @ b_rad[use])
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = ((R @ B[:, :3, 3:])[..., 0] - A[:, :3, 3]).reshape(-1)
    t, *_ = np.linalg.lstsq(left, right, rcond=None)
    return transform(R, t)


def view_errors(
    series: Series, X: np.ndarray
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "n 2"]]:
    """Mean target pose, and each view's deviation from it: angle (rad), distance (m)."""
    Ts_world_target = series.Ts_world_body @ X @ series.Ts_mounted_target
    Z = nearest_pose(Ts_world_target)
    E = invert(Z) @ Ts_world_target
    angles_rad = rotation_angle(E[:, :3, :3])
    return Z, np.column_stack([angles_rad, np.linalg.norm(E[:, :3, 3], axis=1)])


def check_sides(series: Series, errors: np.ndarray) -> None:
    """Refuse a series that fits much better when one side is inverted.

    Consistency alone cannot show which side is wrong: with both turned round the views agree again,
    on mount and target exchanged. The shorter mount is the likelier one.

    Raises:
        InvalidInputError: names the side.
    """
    body, target = series.Ts_world_body, series.Ts_mounted_target
    limit = INVERTED_SHARE * _rms(errors)
    if (_rms(errors) < EXACT).all():
        return
    fits = []
    sides = ((invert(body), target), (body, invert(target)))
    for name, other in zip(series.names, sides, strict=True):
        X = park(*other)
        turned = series._replace(Ts_world_body=other[0], Ts_mounted_target=other[1])
        _, again = view_errors(turned, X)
        if (_rms(again) < limit).all():
            fits.append((float(np.linalg.norm(X[:3, 3])), name, again))
    if not fits:
        return
    length_m, name, again = min(fits, key=lambda fit: fit[0])
    raise InvalidInputError(
        f"{series.task}: {name} is probably inverted: the views contradict each other by "
        f"{_told(errors)} RMS as given and by {_told(again)} when {name} is turned round (the "
        f"mount is then {length_m * 1e3:.0f} mm long); pass the inverse of each matrix of {name}",
        inverted=name,
    )


def _check_noise(task: str, errors: np.ndarray) -> None:
    """Refuse views that contradict each other by more than any noise."""
    rms = _rms(errors)
    if rms[0] > MAX_ROTATION_RMS_RAD or rms[1] > MAX_TRANSLATION_RMS_M:
        raise InvalidInputError(
            f"{task}: the views contradict each other by {_told(errors)} RMS, expected at most "
            f"{np.rad2deg(MAX_ROTATION_RMS_RAD):.0f} degrees and {MAX_TRANSLATION_RMS_M * 1e3:.0f} "
            "mm; check that both series were taken at the same times and the target did not move"
        )


def _rms(errors: np.ndarray) -> Float64[np.ndarray, "2"]:
    return np.sqrt(np.square(errors).mean(axis=0))


def _told(errors: np.ndarray) -> str:
    rms = _rms(errors)
    return f"{np.rad2deg(rms[0]):.2f} degrees and {rms[1] * 1e3:.1f} mm"
