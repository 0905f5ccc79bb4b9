"""Twists, closed-form calibration of two sensors that move together, and what they must show.

With X = T_tracker_camera and Z = T_world_board every view says T_world_tracker · X · T_camera_board
= Z; two give A X = X B for their motions (Park and Martin 1994). A twist is [..., 6]: rotation
vector in rad, then translation in m. T · move(twist) turns T in its own frame about its own origin
and shifts it along its own axes.
"""

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert, rigid_error, transform
from dextouch.geometry.rotations import (
    SERIES_ANGLE_RAD,
    rotation_angle,
    rotation_from_vector,
    vector_from_rotation,
)

# One sigma of a good mount: at 0.5 m from the camera both move a point by 0.8 mm at most, a quarter
# of a taxel. A tracker with noise of 0.05 degrees and 0.5 mm gets there in about 30 places.
WANTED_ROTATION_RAD: Final = float(np.deg2rad(0.06))
WANTED_TRANSLATION_M: Final = 8e-4

MIN_VIEWS = 4
MAX_PAIRS = 5000
# The second largest spread of turns must reach this, or part of the mount cannot be seen.
MIN_SECOND_SPREAD_RAD = np.deg2rad(10.0)
# Smallest over largest eigenvalue of what the turns say of the mount's place.
MIN_EIGENVALUE_RATIO = 1e-4
AXIS_NAMES = ("x", "y", "z")
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
# Directions of which the fitted unknowns leave less than this say nothing of their own.
MIN_INDEPENDENCE = 1e-4
# Fitted unknowns may be nearly the same, of which a fit makes use to the last digit.
MIN_INDEPENDENCE_OF_FITTED = 1e-10
# Views belong to one place where both series moved less. Ten times and more the noise of a tracker,
# and what a hand sways that holds a camera; the mean of such poses is exact to 0.1 mm.
MAX_SAME_PLACE_RAD, MAX_SAME_PLACE_M = np.deg2rad(2.0), 0.01
# Probability that a healthy calibration is refused for a change.
MAX_CHANCE = 1e-6
# Changes that are smaller than this many lengths of the expected noise are part of the sigmas.
MIN_CHANGE = 2.0
# Of neighbours; independent errors have less in 98 of 100 series.
MIN_CORRELATION_SIGMAS = 2.0
# A sensor that is mounted farther from the other is none: both series are inverted or exchanged,
# which fits as well, with the mount and the target's pose exchanged (chosen).
MAX_MOUNT_M = 0.5
# From so many places on 36 functions of the pose are told from noise; what chance would rarely show
# is part of the sigmas.
MIN_PLACES_BY_POSE, MAX_POSE_P = 18, 0.01
# Places on either side of a change; a pose has as many numbers as one of them.
MIN_SIDE = 3


class DegenerateMotionError(InvalidInputError):
    """The motion does not determine the result; the message names the missing motion."""


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
    """Series of the agreeing views, their indices, X and Z, and indices of views left out."""

    series: Series
    views: np.ndarray
    left_out: tuple[int, ...]
    X: Float64[np.ndarray, "4 4"]
    Z: Float64[np.ndarray, "4 4"]
    is_mount_known: bool

    @property
    def predicted(self) -> Float64[np.ndarray, "n 4 4"]:
        """Poses of the target in the mounted frame at which the body's poses put it."""
        return invert(self.series.Ts_world_body @ self.X) @ self.Z


def checked_poses(task: str, **series: np.ndarray) -> list[Float64[np.ndarray, "n 4 4"]]:
    """Series as float64 [n ≥ 4, 4, 4]; raises ShapeError, NonFiniteError, InvalidInputError."""
    arrays = {name: np.asarray(poses, dtype=np.float64) for name, poses in series.items()}
    shapes = [array.shape for array in arrays.values()]
    if len(set(shapes)) != 1 or len(shapes[0]) != 3 or shapes[0][1:] != (4, 4):
        raise ShapeError(f"{task}: got poses {shapes}, expected all [n, 4, 4] of one length")
    for name, poses in arrays.items():
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if bad.size:
            raise NonFiniteError(
                f"{task}: {name} holds NaN or infinity in views {bad[:8].tolist()}; leave those "
                "views out of all series",
                views=bad.tolist(),
            )
        if rigid_error(poses) > 1e-3:
            raise InvalidInputError(f"{task}: {name} holds matrices that are no rigid transforms")
    if shapes[0][0] < MIN_VIEWS:
        raise InvalidInputError(
            f"{task}: got {shapes[0][0]} views, expected at least {MIN_VIEWS}, better 20"
        )
    return list(arrays.values())


def view_pairs(num_views: int) -> np.ndarray:
    """Pairs of views [p, 2]: all of them, or every n-th of very many."""
    pairs = np.column_stack(np.triu_indices(num_views, 1))
    return pairs[:: max(1, len(pairs) // MAX_PAIRS)]


def check_turns(task: str, body: str, Ts_world_body: np.ndarray) -> None:
    """Refuse poses [n, 4, 4] that turn about one axis, or hardly; raises DegenerateMotionError."""
    pairs = view_pairs(len(Ts_world_body))
    A = invert(Ts_world_body[pairs[:, 1]]) @ Ts_world_body[pairs[:, 0]]
    turns_rad = vector_from_rotation(A[:, :3, :3])
    _, spread_rad, axes = np.linalg.svd(turns_rad / np.sqrt(len(turns_rad)), full_matrices=False)
    shown = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    eigenvalues = np.linalg.eigvalsh(shown.T @ shown)
    ratio = float(eigenvalues[0] / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0
    if spread_rad[1] >= MIN_SECOND_SPREAD_RAD and ratio >= MIN_EIGENVALUE_RATIO:
        return
    is_seen = spread_rad[0] >= MIN_SECOND_SPREAD_RAD
    names = missing_axes(axes[1:] if is_seen else axes)
    spread = "/".join(f"{value:.1f}" for value in np.rad2deg(spread_rad))
    seen = f" (all turns are about {np.round(axes[0], 2).tolist()})" if is_seen else ""
    raise DegenerateMotionError(
        f"{task}: turns of the {body} spread {spread} degrees along three axes{seen}, expected the "
        f"second at least {np.rad2deg(MIN_SECOND_SPREAD_RAD):.0f}; also turn the {body} by 30 "
        f"degrees and more about its {' and '.join(names)} axis",
        spread_deg=[float(value) for value in np.rad2deg(spread_rad)],
        eigenvalue_ratio=ratio,
        missing_axes=names,
    )


def missing_axes(missing: np.ndarray) -> list[str]:
    """Names of the axes closest to the m missing directions [m, 3]."""
    depth = np.square(missing).sum(axis=0)
    deepest = sorted(np.argsort(-depth, kind="stable")[: len(missing)])
    return [AXIS_NAMES[index] for index in deepest]


def agreeing_views(series: Series, mount: np.ndarray | None = None) -> Agreement:
    """Mount (in closed form, unless it is given) and target, without outlier views.

    Raises DegenerateMotionError: the views that agree show no mount; InvalidInputError: the views
    contradict each other (an inverted series is named).
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
        if mount is None and not (_rms(errors) < EXACT).all():
            check_sides(used, errors)
            check_scale(used, errors)
        ratios = (errors / np.maximum(np.median(errors, axis=0), EXACT)).max(axis=1)
        if ratios.max() <= OUTLIER_RATIO:
            rms = _rms(errors)
            if rms[0] > MAX_ROTATION_RMS_RAD or rms[1] > MAX_TRANSLATION_RMS_M:
                raise InvalidInputError(
                    f"{series.task}: the views contradict each other by {_rms_text(errors)} RMS, "
                    f"expected at most {np.rad2deg(MAX_ROTATION_RMS_RAD):.0f} degrees and "
                    f"{MAX_TRANSLATION_RMS_M * 1e3:.0f} mm; check that both series were taken at "
                    "the same times and the target did not move"
                )
            left_out = tuple(sorted(set(range(num_views)) - set(views.tolist())))
            return Agreement(used, views, left_out, X, Z, mount is not None)
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
    R, left, shifts, targets = _park_equations(Ts_world_body, Ts_mounted_target)
    t, *_ = np.linalg.lstsq(left, targets - shifts, rcond=None)
    return transform(R, t)


def scaled_park(
    Ts_world_body: np.ndarray, Ts_mounted_target: np.ndarray
) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """As `park`, with true over measured lengths of the target's series as a fourth unknown."""
    R, left, shifts, targets = _park_equations(Ts_world_body, Ts_mounted_target)
    found, *_ = np.linalg.lstsq(np.column_stack([left, -targets]), -shifts, rcond=None)
    return transform(R, found[:3]), float(found[3])


def _park_equations(
    Ts_world_body: np.ndarray, Ts_mounted_target: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The mount's rotation R, and the equations left @ t = targets - shifts of its place t."""
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
    return R, left, A[:, :3, 3].reshape(-1), (R @ B[:, :3, 3:]).reshape(-1)


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
    """Refuse and name a side whose inverse fits much better, of two that of the shorter mount."""
    body, target = series.Ts_world_body, series.Ts_mounted_target
    limit = INVERTED_SHARE * _rms(errors)
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
    fixed_camera = (
        "; or the camera stands still and the tracker is on the board, which is not calibrated here"
    )
    raise InvalidInputError(
        f"{series.task}: {name} is probably inverted: the views contradict each other by "
        f"{_rms_text(errors)} RMS as given and by {_rms_text(again)} when {name} is turned round "
        f"(the mount is then {length_m * 1e3:.0f} mm long); pass the inverse of each matrix of "
        f"{name}{fixed_camera if name == 'Ts_camera_board' else ''}",
        inverted=name,
    )


def check_mount(task: str, names: tuple[str, str], X: np.ndarray) -> None:
    """Refuse a mount that is too long to be one; raises InvalidInputError."""
    length_m = float(np.linalg.norm(X[:3, 3]))
    if length_m > MAX_MOUNT_M:
        raise InvalidInputError(
            f"{task}: the mount would be {length_m:.2f} m long, expected at most {MAX_MOUNT_M:g}; "
            f"{names[0]} and {names[1]} are probably both inverted, or exchanged, which fits with "
            "another meaning; check the direction and order of both",
            length_m=length_m,
        )


def check_scale(series: Series, errors: np.ndarray) -> None:
    """Refuse a target's series in another unit or size than entered; raises InvalidInputError."""
    X, scale = scaled_park(series.Ts_world_body, series.Ts_mounted_target)
    if scale <= 0:
        return
    rescaled = series.Ts_mounted_target.copy()
    rescaled[:, :3, 3] *= scale
    _, again = view_errors(series._replace(Ts_mounted_target=rescaled), X)
    if _rms(again)[1] < INVERTED_SHARE * _rms(errors)[1]:
        raise wrong_scale(series.task, series.names, scale)


def wrong_scale(
    task: str, names: tuple[str, str], scale: float, sigma: float | None = None
) -> InvalidInputError:
    """Error for two series that measure lengths differently."""
    known = f"{scale:.4g}" if sigma is None else f"{scale:.4f} ± {sigma:.4f}"
    return InvalidInputError(
        f"{task}: lengths of {names[0]} are {known} times those of {names[1]}, expected 1; give "
        "both in metres; measure the printed board over several squares and enter that size "
        "(printers scale pages), and check that the camera's K is of this camera and image size; "
        "of a robot, check its model and the tracker's set-up of the room",
        scale=scale,
    )


def _rms(errors: np.ndarray) -> Float64[np.ndarray, "2"]:
    return np.sqrt(np.square(errors).mean(axis=0))


def _rms_text(errors: np.ndarray) -> str:
    rms = _rms(errors)
    return f"{np.rad2deg(rms[0]):.2f} degrees and {rms[1] * 1e3:.1f} mm"


def hat(vectors: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Skew-symmetric (cross product) matrices of vectors [..., 3]."""
    # The columns are vector × unit vector.
    columns = np.cross(np.asarray(vectors, dtype=np.float64)[..., None, :], np.eye(3))
    return np.swapaxes(columns, -1, -2)


def adjoint(T_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 6 6"]:
    """Takes twists of frame b to frame a: T · move(v) = move(adjoint(T) @ v) · T to first order."""
    R = T_a_b[..., :3, :3]
    full = np.zeros((*R.shape[:-2], 6, 6))
    full[..., :3, :3] = full[..., 3:, 3:] = R
    full[..., 3:, :3] = hat(T_a_b[..., :3, 3]) @ R
    return full


def move(twists: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """Transforms of twists [..., 6]; rotation and translation side by side, not a screw."""
    return transform(rotation_from_vector(twists[..., :3]), twists[..., 3:])


def twist(T: np.ndarray) -> Float64[np.ndarray, "*batch 6"]:
    """Twists of transforms; the inverse of `move`."""
    return np.concatenate([vector_from_rotation(T[..., :3, :3]), T[..., :3, 3]], axis=-1)


def right_jacobian_inverse(vectors_rad: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Inverse right Jacobian of SO(3) below half a turn (Solà et al. 2018, eq. 144)."""
    angle = np.linalg.norm(vectors_rad, axis=-1)[..., None, None]
    small = angle < SERIES_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    factor = np.where(
        small, 1 / 12 + angle**2 / 720, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe))
    )
    crossed = hat(vectors_rad)
    return np.eye(3) + 0.5 * crossed + factor * (crossed @ crossed)


def twist_jacobian(Ts: np.ndarray) -> Float64[np.ndarray, "n 6 6"]:
    """Jacobian of the twists of transforms [n, 4, 4] by T · move(v)."""
    J = np.zeros((len(Ts), 6, 6))
    J[:, :3, :3] = right_jacobian_inverse(twist(Ts)[:, :3])
    J[:, 3:, 3:] = Ts[:, :3, :3]
    return J


def nearest_pose(Ts: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """Mean of poses [n, 4, 4]: rotation nearest to the mean matrix, mean translation."""
    return transform(nearest_rotation(Ts[:, :3, :3].mean(axis=0)), Ts[:, :3, 3].mean(axis=0))


def nearest_rotation(matrix: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """The rotation nearest to a 3 by 3 matrix (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def place_labels(series: Series, *, min_places: int = MIN_VIEWS) -> Int64[np.ndarray, " n"]:
    """Place of each view, numbered by first visit; raises InvalidInputError for too few places."""
    labels = np.full(len(series.Ts_world_body), -1)
    num_places = 0
    for index in range(len(labels)):
        if labels[index] < 0:
            is_near = labels < 0
            for Ts in (series.Ts_world_body, series.Ts_mounted_target):
                shifts_m = np.linalg.norm(Ts[:, :3, 3] - Ts[index, :3, 3], axis=1)
                turns_rad = rotation_angle((invert(Ts[index]) @ Ts)[:, :3, :3])
                is_near &= (turns_rad < MAX_SAME_PLACE_RAD) & (shifts_m < MAX_SAME_PLACE_M)
            labels[is_near] = num_places
            num_places += 1
    if num_places < min_places:
        raise InvalidInputError(
            f"{series.task}: {len(labels)} views are of {num_places} places, expected at least "
            f"{min_places}, better 20: views within {np.rad2deg(MAX_SAME_PLACE_RAD):.0f} degrees "
            f"and {MAX_SAME_PLACE_M * 1e3:.0f} mm of each other count once"
        )
    return labels


def mean_series(series: Series, labels: np.ndarray) -> Series:
    """One view for each place, the mean of its views."""
    body, target = (
        np.array([nearest_pose(Ts[labels == place]) for place in range(labels.max() + 1)])
        for Ts in (series.Ts_world_body, series.Ts_mounted_target)
    )
    return series._replace(Ts_world_body=body, Ts_mounted_target=target)


def excess_over_time(
    series: Series,
    residuals: Float64[np.ndarray, "n 6"],
    J: Float64[np.ndarray, "n 6 13"],
    C: Float64[np.ndarray, "n 6 6"],
    free: np.ndarray,
    expected: tuple[float, float],
) -> float:
    """By how much variances exceed those of independent errors, from places in their order.

    Residual twists [n, 6] are whitened; they change by J with mount, target and scale, the unknowns
    `free` of which were fitted, and by C with errors of the body's poses, whose `expected` noise is
    in rad and m an axis. Raises InvalidInputError: mount, target or the body's frame moved, or the
    clocks differ.
    """
    num_places = len(residuals)
    left, fitted = residuals.ravel(), J[:, :, free].reshape(6 * num_places, -1)
    W = series.Ts_world_body
    last, following = np.maximum(np.arange(num_places) - 1, 0), np.arange(1, num_places + 1)
    passed = twist(invert(W[last]) @ W[np.minimum(following, num_places - 1)])
    late = (C @ passed[..., None]).reshape(6 * num_places, 1)
    changes = {}
    for at in range(MIN_SIDE, num_places - MIN_SIDE + 1):
        after = J * (np.arange(num_places) >= at)[:, None, None]
        for name, unknowns in (("mount", slice(6)), ("target", slice(6, 12))):
            functions = after[:, :, unknowns].reshape(6 * num_places, -1)
            changes[name, at] = _change(left, fitted, functions)
    changes["clock", 0] = _change(left, fitted, late)
    (name, at), worst = min(changes.items(), key=lambda change: change[1].p_value)
    size = worst.coefficients
    if name == "clock":
        size = size * np.sqrt(np.square(passed).mean(axis=0))
    lengths = np.linalg.norm(size.reshape(2, 3), axis=1)
    is_large = lengths > MIN_CHANGE * np.sqrt(3) * np.array(expected)
    if worst.p_value * len(changes) < MAX_CHANCE and is_large.any():
        raise InvalidInputError(_refusal(series, name, at, worst))
    times = np.linspace(-1, 1, num_places)[:, None, None]
    trends = (times * J[:, :, :12]).reshape(6 * num_places, -1)
    found = structure(left, fitted, np.column_stack([trends, late]))
    by_pose = _excess_by_pose(series, left, J, fitted, expected)
    return max(found.ratio, by_pose, _num_together(left), 1.0)


def _excess_by_pose(
    series: Series, left: np.ndarray, J: np.ndarray, fitted: np.ndarray, expected: tuple[float, ...]
) -> float:
    """As `excess_over_time`, of mounts that seem to change with the pose.

    So do joints that are off zero, arms that bend, and lenses that are not the camera's.
    """
    if len(J) < MIN_PLACES_BY_POSE:
        return 1.0
    T = invert(series.Ts_mounted_target)
    poses = twist(invert(nearest_pose(T)) @ T)
    found = _change(left, fitted, (J[:, :, :6, None] * poses[:, None, None]).reshape(left.size, -1))
    explained = (left - found.remaining).reshape(-1, 6, 1)
    squares = np.square(np.linalg.solve(J[:, :, :6], explained)[..., 0]).mean(axis=0)
    lengths = np.sqrt(squares.reshape(2, 3).sum(axis=1))
    is_large = lengths > MIN_CHANGE * np.sqrt(3) * np.array(expected)
    if found.p_value < MAX_CHANCE and is_large.any():
        raise InvalidInputError(
            f"{series.task}: the mount on the {series.body} seems to change with the pose, by "
            f"{np.rad2deg(lengths[0]):.2f} degrees and {lengths[1] * 1e3:.1f} mm RMS; check that "
            "the camera's K and distortion are of this lens and image size, or that the robot's "
            "joint zeros and units are right, and hold still for each view"
        )
    return found.ratio if found.p_value < MAX_POSE_P else 1.0


class Structure(NamedTuple):
    """How much of the residuals some functions explain.

    Attributes:
        ratio: mean square of what they explain over that of the rest (an F statistic).
        p_value: how probable so large a ratio is for independent Gaussian errors.
        explained: sum of squares that they explain.
        rest: mean square of what they do not, by each of its `freedom` degrees of freedom.
        coefficients: of the functions; `remaining` are the residuals that they do not explain.
    """

    ratio: float
    p_value: float
    explained: float
    rest: float
    freedom: int
    coefficients: Float64[np.ndarray, " m"]
    remaining: Float64[np.ndarray, " n"]


def structure(
    residuals: Float64[np.ndarray, " n"],
    fitted: Float64[np.ndarray, "n p"],
    functions: Float64[np.ndarray, "n m"],
    *,
    num_others: int = 0,
    num_together: float = 1.0,
) -> Structure:
    """Test whether functions explain residuals of a fit better than chance.

    Independent errors leave as much in any direction of the residuals as in any other. Residuals
    are whitened; `fitted` says how they change with the unknowns that were fitted, `num_others`
    counts fitted unknowns of which nothing is left in any of the three, `num_together` errors in
    turn that are alike, and count as one.
    """
    # Here, since commands that measure nothing import this module on stations without scipy.
    from scipy.special import fdtrc

    U, s, _ = np.linalg.svd(fitted / _lengths(fitted), full_matrices=False)
    Q = U[:, s > MIN_INDEPENDENCE_OF_FITTED]
    lengths = _lengths(functions)
    own = functions / lengths
    own, left = own - Q @ (Q.T @ own), residuals - Q @ (Q.T @ residuals)
    U, s, Vt = np.linalg.svd(own, full_matrices=False)
    U, s, Vt = (part[s > MIN_INDEPENDENCE] for part in (U.T, s, Vt))
    along = U @ left
    explained, num = float(along @ along), len(s)
    freedom = max(len(residuals) - num_others - Q.shape[1] - num, 1)
    rest = max(float(left @ left) - explained, np.finfo(float).tiny) / freedom
    ratio = explained / max(num, 1) / rest / num_together
    p_value = float(fdtrc(max(num, 1), freedom / num_together, ratio))
    return Structure(
        ratio, p_value, explained, rest, freedom, (Vt.T @ (along / s)) / lengths, left - U.T @ along
    )


def _lengths(columns: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)


def _change(left: np.ndarray, fitted: np.ndarray, functions: np.ndarray) -> Structure:
    """Test for a change among errors that may be alike from one place to the next."""
    found = structure(left, fitted, functions)
    return structure(left, fitted, functions, num_together=_num_together(found.remaining))


def _num_together(residuals: np.ndarray) -> float:
    """How many places in turn err alike, by the correlation of neighbours (autoregressive)."""
    errors = residuals.reshape(-1, 6)
    correlation = float((errors[1:] * errors[:-1]).sum() / np.square(errors).sum())
    if correlation < MIN_CORRELATION_SIGMAS / np.sqrt(errors.size):
        return 1.0
    return (1 + correlation) / (1 - correlation)


def _refusal(series: Series, name: str, at: int, worst: Structure) -> str:
    turn_deg = np.rad2deg(np.linalg.norm(worst.coefficients[:3]))
    if name == "clock":
        return (
            f"{series.task}: the poses of {series.names[0]} are of other times than those of "
            f"{series.names[1]}, by {abs(worst.coefficients[0]) * 2:.2f} of the time from one "
            "place to the next; hold still for each view, or calibrate the time offset first"
        )
    moved = {
        "mount": f"the mount on the {series.body} slipped",
        "target": f"the target or the frame of {series.names[0]} moved",
    }[name]
    return (
        f"{series.task}: {moved} by {turn_deg:.2f} degrees and "
        f"{np.linalg.norm(worst.coefficients[3:]) * 1e3:.1f} mm before place {at} of "
        f"{len(series.Ts_world_body)}, in the order of the views; fasten it and take all views anew"
    )
