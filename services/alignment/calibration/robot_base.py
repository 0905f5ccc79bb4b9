"""Calibration of the pose of a robot's base in the tracked world.

A tracker on the robot's end effector says T_world_tracker = T_world_base · T_base_effector ·
T_effector_tracker in every pose. Where the tracker sits on the effector is found too, unless it
is given; both as in hand-eye calibration, with the base in the place of the board.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert
from services.alignment.calibration.bundle import (
    Bundle,
    pose_measurement,
    predicted_jacobians,
    solve_bundle,
)
from services.alignment.calibration.closed_form import (
    Agreement,
    Series,
    agreeing_views,
    agreeing_with_mount,
    view_errors,
)
from services.alignment.calibration.motion import DegenerateMotionError, checked_poses
from services.alignment.calibration.noise_components import (
    Component,
    estimate_sigmas,
    sensor_components,
)
from services.alignment.calibration.twists import adjoint, twist

TASK = "robot base"
# Where the tracker's place is given, the effector must at least move so far in two directions.
MIN_SECOND_SPREAD_M = 0.05
MAX_SIGMA_ROTATION_RAD = np.deg2rad(0.5)
MAX_SIGMA_TRANSLATION_M = 0.01


@dataclass(frozen=True)
class RobotBaseNoise:
    """Expected noise, one sigma for each axis; refined from the pairs."""

    tracker_rotation_rad: float = 8.7e-4
    tracker_translation_m: float = 5e-4
    robot_rotation_rad: float = 3e-4
    robot_translation_m: float = 2e-4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InvalidInputError(f"{TASK}: noise {name} is {value}, expected above zero")


@dataclass(frozen=True)
class RobotBaseResult:
    """Pose of the robot's base in the tracked world, with standard deviations.

    Attributes:
        T_world_base: the base.
        T_effector_tracker: where the tracker sits; as given, or found.
        sigma_rotation_rad: of the base's rotation, length of the three axes' sigmas.
        sigma_translation_m: of its translation, likewise.
        covariance: [6, 6] of its twist: turn (rad) and shift (m) along the base's own axes.
        rotation_rms_rad: how far the pairs turn the base from there.
        translation_rms_m: how far they put it from there.
        noise: estimated noise (one sigma per axis).
        left_out_pairs: pairs that were far off and did not count.
    """

    T_world_base: Float64[np.ndarray, "4 4"]
    T_effector_tracker: Float64[np.ndarray, "4 4"]
    sigma_rotation_rad: float
    sigma_translation_m: float
    covariance: Float64[np.ndarray, "6 6"]
    rotation_rms_rad: float
    translation_rms_m: float
    noise: dict[str, float]
    left_out_pairs: tuple[int, ...]


def solve_robot_base(
    Ts_world_tracker: np.ndarray,
    Ts_base_effector: np.ndarray,
    *,
    T_effector_tracker: np.ndarray | None = None,
    noise: RobotBaseNoise | None = None,
) -> RobotBaseResult:
    """Estimate the robot's base in the tracked world from simultaneous pairs of poses.

    Args:
        Ts_world_tracker: [n ≥ 4, 4, 4] poses of a tracker that the effector carries.
        Ts_base_effector: [n, 4, 4] poses of the effector, from the robot's own joints.
        T_effector_tracker: where the tracker sits; the identity where both series are of the same
            frame; None to find it.
        noise: what to expect; default `RobotBaseNoise()`.

    Raises:
        DegenerateMotionError: the effector was turned too little or about one axis only (or,
            where the tracker's place is given, hardly moved), or the base stays less known than
            half a degree and 10 mm.
        InvalidInputError: too few pairs, or pairs that contradict each other (an inverted series
            is named).
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    tracker, effector = checked_poses(
        TASK, Ts_world_tracker=Ts_world_tracker, Ts_base_effector=Ts_base_effector
    )
    names = ("Ts_world_tracker", "Ts_base_effector")
    series = Series(TASK, "effector", tracker, invert(effector), names)
    is_mount_known = T_effector_tracker is not None
    if T_effector_tracker is None:
        agreed = agreeing_views(series)
    else:
        _check_places(effector)
        agreed = agreeing_with_mount(series, invert(_checked_mount(T_effector_tracker)))
    series = series.only(agreed.views)
    bundle, sigmas = _weighted(
        series, agreed, noise or RobotBaseNoise(), is_mount_known=is_mount_known
    )
    variances = np.diag(bundle.covariance[6:, 6:])
    _, errors = view_errors(series, bundle.X)
    rms = np.sqrt(np.square(errors).mean(axis=0))
    result = RobotBaseResult(
        T_world_base=bundle.Z,
        T_effector_tracker=invert(bundle.X),
        sigma_rotation_rad=float(np.sqrt(variances[:3].sum())),
        sigma_translation_m=float(np.sqrt(variances[3:].sum())),
        covariance=bundle.covariance[6:, 6:],
        rotation_rms_rad=float(rms[0]),
        translation_rms_m=float(rms[1]),
        noise=sigmas,
        left_out_pairs=tuple(sorted(set(range(len(tracker))) - set(agreed.views.tolist()))),
    )
    _check_budget(result)
    return result


def _checked_mount(T_effector_tracker: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    mount = np.asarray(T_effector_tracker, dtype=np.float64)
    repeated = np.broadcast_to(mount, (4, *mount.shape))
    return checked_poses(f"{TASK}, T_effector_tracker", T_effector_tracker=repeated)[0][0]


def _check_places(Ts_base_effector: np.ndarray) -> None:
    """Refuse places along one line, or all the same: they do not determine the base's rotation."""
    places = Ts_base_effector[:, :3, 3]
    places = places - places.mean(axis=0)
    _, spread_m, axes = np.linalg.svd(places / np.sqrt(len(places)), full_matrices=False)
    if spread_m[1] >= MIN_SECOND_SPREAD_M:
        return
    is_seen = spread_m[0] >= MIN_SECOND_SPREAD_M
    depth = np.square(axes[1:] if is_seen else axes).sum(axis=0)
    names = ["xyz"[index] for index in sorted(np.argsort(-depth)[: 2 if is_seen else 3])]
    told = "/".join(f"{value * 1e3:.0f}" for value in spread_m)
    raise DegenerateMotionError(
        f"{TASK}: places of the effector spread {told} mm along three directions, expected the "
        f"second at least {MIN_SECOND_SPREAD_M * 1e3:.0f}; also move the effector by 20 cm and "
        f"more along the base's {' and '.join(names)} axis",
        spread_m=[float(value) for value in spread_m],
        missing_axes=names,
    )


def _weighted(
    series: Series, agreed: Agreement, noise: RobotBaseNoise, *, is_mount_known: bool
) -> tuple[Bundle, dict[str, float]]:
    """The bundle weighted with the noise estimated from the pairs, and that noise."""
    tracker, measured = series.Ts_world_body, series.Ts_mounted_target
    X_B = invert(tracker) @ agreed.Z
    Ts = invert(agreed.X) @ X_B
    J, C = predicted_jacobians(Ts, X_B)
    components = sensor_components(
        "tracker", C, (noise.tracker_rotation_rad, noise.tracker_translation_m)
    )
    # The robot errs in the effector's axes.
    own = sensor_components(
        "robot", adjoint(invert(Ts)), (noise.robot_rotation_rad, noise.robot_translation_m)
    )
    components |= own
    unknowns = J[:, :, 6:] if is_mount_known else J
    left_over = twist(invert(measured) @ Ts)
    found = estimate_sigmas(left_over, unknowns, list(components.values()))
    sigmas = dict(zip(components, (float(value) for value in found), strict=True))
    shares = [Component(sigmas[name], own[name].shapes).covariances for name in own]
    bundle = solve_bundle(
        tracker,
        pose_measurement(measured, np.linalg.inv(np.sum(shares, axis=0))),
        (sigmas["tracker_rotation_rad"], sigmas["tracker_translation_m"]),
        (agreed.X, agreed.Z),
        is_mount_known=is_mount_known,
    )
    return bundle, sigmas


def _check_budget(result: RobotBaseResult) -> None:
    """Refuse a base whose standard deviation is too large."""
    if (
        result.sigma_rotation_rad > MAX_SIGMA_ROTATION_RAD
        or result.sigma_translation_m > MAX_SIGMA_TRANSLATION_M
    ):
        raise DegenerateMotionError(
            f"{TASK}: the uncertainty of the base is {np.rad2deg(result.sigma_rotation_rad):.2f} "
            f"degrees and {result.sigma_translation_m * 1e3:.1f} mm (one sigma), expected at most "
            f"{np.rad2deg(MAX_SIGMA_ROTATION_RAD):.1f} and {MAX_SIGMA_TRANSLATION_M * 1e3:.0f}; "
            "turn the effector by 30 degrees and more about all its axes, take more pairs over "
            "more of the workspace, and hold the robot still for each",
            missing_axes=["x", "y", "z"],
        )
