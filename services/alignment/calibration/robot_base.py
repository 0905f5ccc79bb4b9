"""Calibration of the pose of a robot's base in the tracked world.

A tracker on the robot's end effector says T_world_tracker = T_world_base · T_base_effector ·
T_effector_tracker in every pose. Where the tracker sits on the effector is found too, unless it
is given; both as in hand-eye calibration, with the base in the place of the board.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import invert
from services.alignment.calibration.bundle import (
    PoseEstimate,
    TrackerNoise,
    sensor_components,
    weighted_bundle,
)
from services.alignment.calibration.motion import (
    AXIS_NAMES,
    MIN_VIEWS,
    DegenerateMotionError,
    Series,
    adjoint,
    agreeing_views,
    checked_poses,
    missing_axes,
    view_errors,
)

TASK = "robot base"
# Where the tracker's place is given, the effector must at least move so far in two directions.
MIN_SECOND_SPREAD_M = 0.05


@dataclass(frozen=True)
class RobotBaseNoise(TrackerNoise):
    """Expected noise, one sigma for each axis; refined from the pairs."""

    task = TASK
    robot_rotation_rad: float = 3e-4
    robot_translation_m: float = 2e-4


@dataclass(frozen=True)
class RobotBaseResult(PoseEstimate):
    """Pose of the robot's base in the tracked world, and how well it is known.

    `T_effector_tracker`, where the tracker sits, is as given, or found. The two RMS are how far the
    pairs turn and put the base from there.
    """

    T_world_base: Float64[np.ndarray, "4 4"]
    T_effector_tracker: Float64[np.ndarray, "4 4"]
    rotation_rms_rad: float
    translation_rms_m: float


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
    noise, mount = noise or RobotBaseNoise(), None
    if T_effector_tracker is not None:
        _check_places(effector)
        repeated = np.broadcast_to(T_effector_tracker, (MIN_VIEWS, *np.shape(T_effector_tracker)))
        (given,) = checked_poses(f"{TASK}, T_effector_tracker", T_effector_tracker=repeated)
        mount = invert(given[0])
    agreed = agreeing_views(series, mount)
    # The robot errs in the effector's axes.
    own = sensor_components(
        "robot",
        adjoint(invert(agreed.predicted)),
        (noise.robot_rotation_rad, noise.robot_translation_m),
    )
    bundle, sigmas = weighted_bundle(agreed, noise, own)
    _, errors = view_errors(agreed.series, bundle.X)
    rotation_rms_rad, translation_rms_m = np.sqrt(np.square(errors).mean(axis=0)).tolist()
    result = RobotBaseResult(
        covariance=bundle.covariance[6:, 6:],
        rotation_rms_rad=rotation_rms_rad,
        translation_rms_m=translation_rms_m,
        noise=sigmas,
        left_out_views=agreed.left_out,
        T_world_base=bundle.Z,
        T_effector_tracker=invert(bundle.X),
    )
    if result.doubt:
        raise DegenerateMotionError(
            f"{TASK}: the uncertainty of the base is {result.doubt}; turn the effector by 30 "
            "degrees and more about all its axes, take more pairs over more of the workspace, and "
            "hold the robot still for each",
            missing_axes=list(AXIS_NAMES),
        )
    return result


def _check_places(Ts_base_effector: np.ndarray) -> None:
    """Refuse places along one line, or all the same: they do not determine the base's rotation."""
    places = Ts_base_effector[:, :3, 3]
    places = places - places.mean(axis=0)
    _, spread_m, axes = np.linalg.svd(places / np.sqrt(len(places)), full_matrices=False)
    if spread_m[1] >= MIN_SECOND_SPREAD_M:
        return
    is_seen = spread_m[0] >= MIN_SECOND_SPREAD_M
    names = missing_axes(axes[1:] if is_seen else axes)
    told = "/".join(f"{value * 1e3:.0f}" for value in spread_m)
    raise DegenerateMotionError(
        f"{TASK}: places of the effector spread {told} mm along three directions, expected the "
        f"second at least {MIN_SECOND_SPREAD_M * 1e3:.0f}; also move the effector by 20 cm and "
        f"more along the base's {' and '.join(names)} axis",
        spread_m=[float(value) for value in spread_m],
        missing_axes=names,
    )
