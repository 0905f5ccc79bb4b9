"""Where a camera sits on its tracker, and a robot's base in the tracked world, with sigmas.

A robot says T_world_tracker = T_world_base · T_base_effector · T_effector_tracker.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import Distortion, invert
from dextouch.geometry.rotations import vector_from_rotation
from services.alignment.calibration.bundle import (
    Bundle,
    Component,
    Linearised,
    Measurement,
    PoseEstimate,
    TrackerNoise,
    sensor_components,
    weighted_bundle,
)
from services.alignment.calibration.motion import (
    AXIS_NAMES,
    MAX_CHANCE,
    MIN_VIEWS,
    WANTED_ROTATION_RAD,
    WANTED_TRANSLATION_M,
    DegenerateMotionError,
    Series,
    adjoint,
    agreeing_views,
    check_mount,
    checked_poses,
    mean_series,
    missing_axes,
    move,
    place_labels,
    view_errors,
    view_pairs,
    wrong_scale,
)

TASK = "hand-eye"
BASE_TASK = "robot base"
MIN_CORNERS = 4
# Expected of a robot that reports its pose: rotation (rad) and translation (m), an axis.
ROBOT_SIGMA = (3e-4, 2e-4)
# Corners contradict the lens by so much (px RMS, and share
# of all): distortion or 2 % of a focal length left out. Less moves mounts within sigma.
MIN_LENS_MISFIT_PX, MIN_LENS_SHARE = 0.15, 0.45
# Fewer corners than that fit any lens: four views of four were refused with the right one.
MIN_LENS_FREEDOM = 10
# Of lengths of robot and tracker: of a base station's set-up, and a robot's nominal links.
ROBOT_SCALE_SIGMA = 3e-3
# Where the tracker's place is given, the effector must at least move so far in two directions.
MIN_SECOND_SPREAD_M = 0.05
# A board whose size differs by more sigmas from the entered one is refused.
NUM_SCALE_SIGMAS = 3.0
# Views that add a smaller share to what is known of the board's size say nothing of it: four or
# five may add less than rounding.
MIN_SCALE_INFORMATION = 1e-3
# Poses of a board come from a solver; few steps bring them to the minimum of the pixels.
POLISH_ROUNDS = 5
# A slip is recognised with three places on either side of it; the rest is chosen.
WANTED_PLACES: Final = 12
# Turns spread uniformly over 20 degrees to either side give 16; the solver refuses less than 10.
WANTED_SPREAD_RAD: Final = float(np.deg2rad(12.0))
# Chosen: with less the size of the board is hardly known from the views.
WANTED_DISTANCE_RATIO: Final = 1.4
# Keeps the spread of turns about one axis only finite; less than any turn that is meant.
SMALLEST_SPREAD_RAD: Final = float(np.deg2rad(0.5))
# Title and advice of turns about the camera's x (right), y (down) and z (viewing direction).
TURNS: Final = (
    ("Tilt up and down", "tilt the camera up and down"),
    ("Turn left and right", "turn the camera left and right, about its vertical axis"),
    ("Roll", "roll the camera about its viewing direction, as an ear goes to the shoulder"),
)


@dataclass(frozen=True)
class HandEyeNoise(TrackerNoise):
    """Expected noise of a Vive tracker and a sharp board, one sigma an axis, before refinement.

    `board_*` are of a board's pose by a solver, in the camera's axes, where no corners are given;
    `board_scale` is how well the size of the print is known: by a ruler a millimetre of 20 cm.
    """

    pixel_px: float = 0.3
    board_tilt_rad: float = 1.5e-3
    board_roll_rad: float = 5e-4
    board_sideways_m: float = 1.5e-4
    board_depth_m: float = 4e-4
    board_scale: float = 5e-3


@dataclass(frozen=True)
class HandEyeResult(PoseEstimate):
    """The mount of a camera, and how well it is known; `board_scale` is true over entered size."""

    T_tracker_camera: Float64[np.ndarray, "4 4"]
    board_scale: float
    sigma_board_scale: float


@dataclass(frozen=True)
class BoardViews:
    """Detected corners of a board in several views, and the camera's K and distortion.

    `points_board` are [k ≥ 4, 3] corners of each view (m), `pixels_px` [k, 2] where they were seen.
    """

    points_board: Sequence[np.ndarray]
    pixels_px: Sequence[np.ndarray]
    K: Float64[np.ndarray, "3 3"]
    distortion: Distortion

    def __post_init__(self) -> None:
        if len(self.points_board) != len(self.pixels_px) or not self.points_board:
            raise ShapeError(
                f"board views: got {len(self.points_board)} and {len(self.pixels_px)} views, "
                "expected the same number of both, at least one"
            )
        for index, (points, pixels) in enumerate(
            zip(self.points_board, self.pixels_px, strict=True)
        ):
            if points.shape != (len(points), 3) or pixels.shape != (len(points), 2):
                raise ShapeError(
                    f"board view {index}: got {points.shape} and {pixels.shape}, expected [k, 3] "
                    "corners in metres and their [k, 2] pixels"
                )
            if len(points) < MIN_CORNERS:
                raise InvalidInputError(
                    f"board view {index}: got {len(points)} corners, expected at least "
                    f"{MIN_CORNERS}; leave the view out"
                )
            if not (np.isfinite(points).all() and np.isfinite(pixels).all()):
                raise NonFiniteError(f"board view {index}: NaN or infinity among the corners")

    def only(self, views: np.ndarray) -> "BoardViews":
        """A subset of the views."""
        return BoardViews(
            [self.points_board[index] for index in views],
            [self.pixels_px[index] for index in views],
            self.K,
            self.distortion,
        )

    def measurement(self, sigma_px: float) -> Measurement:
        """Reprojection errors with their analytic Jacobian, for pixels of this noise an axis."""
        most = max(len(points) for points in self.points_board)
        points = np.ones((len(self.points_board), most, 3))
        pixels = np.zeros((len(points), most, 2))
        weights = np.zeros((len(points), most, 1))
        for index, corners in enumerate(self.points_board):
            points[index] = corners[0]
            points[index, : len(corners)] = corners
            pixels[index, : len(corners)] = self.pixels_px[index]
            weights[index, : len(corners)] = 1 / sigma_px

        def linearise(Ts_camera_board: np.ndarray) -> Linearised:
            projected, J = project(points, Ts_camera_board, self.K, self.distortion)
            left = ((projected - pixels) * weights).reshape(len(points), -1, 1)
            J = (J * weights[..., None]).reshape(len(points), -1, 6)
            J_T = np.swapaxes(J, 1, 2)
            return Linearised(J_T @ J, (J_T @ left)[..., 0])

        return linearise


def solve_hand_eye(
    Ts_world_tracker: np.ndarray,
    Ts_camera_board: np.ndarray,
    *,
    views: BoardViews | None = None,
    noise: HandEyeNoise | None = None,
) -> HandEyeResult:
    """Estimate the mount of a camera on a tracker from views of a fixed board.

    Both series are poses [n ≥ 4, 4, 4] of the same moments. With the corners (`views`) from which
    the board's poses were computed, each view is weighted by the information in its pixels.

    Raises:
        DegenerateMotionError: the tracker was rotated too little, or about one axis only, or the
            uncertainty of the mount exceeds half a degree or 10 mm.
        InvalidInputError: too few views, a board of another size than was entered, or views that
            contradict each other (an inverted series is named).
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    tracker, board = checked_poses(
        TASK, Ts_world_tracker=Ts_world_tracker, Ts_camera_board=Ts_camera_board
    )
    if views is not None and len(views.points_board) != len(tracker):
        raise ShapeError(
            f"{TASK}: got {len(views.points_board)} views of corners and {len(tracker)} poses, "
            "expected corners of every pose"
        )
    noise = noise or HandEyeNoise()
    names = ("Ts_world_tracker", "Ts_camera_board")
    series = Series(TASK, "tracker", tracker, board, names)
    agreed = agreeing_views(series)
    if views is None:
        placed = agreed._replace(series=mean_series(agreed.series, place_labels(agreed.series)))
        own_noise = board_components(placed.predicted, noise)
    else:
        one_pixel = views.only(agreed.views).measurement(1.0)
        polished = polish(one_pixel, agreed.series.Ts_mounted_target)
        _check_lens(views.only(agreed.views), polished)
        agreed = agreed._replace(series=agreed.series._replace(Ts_mounted_target=polished))
        labels = place_labels(agreed.series)
        placed = agreed._replace(series=mean_series(agreed.series, labels))
        information = np.zeros((labels.max() + 1, 6, 6))
        np.add.at(information, labels, one_pixel(polished).information)
        own_noise = {"pixel_px": Component(noise.pixel_px, np.linalg.inv(information))}
    bundle, sigmas = weighted_bundle(placed, noise, own_noise, scale_sigma=noise.board_scale)
    _check_scale(TASK, bundle, noise.board_scale, names)
    check_mount(TASK, names, bundle.X)
    result = HandEyeResult(
        covariance=bundle.covariance[:6, :6],
        noise=sigmas,
        left_out_views=agreed.left_out,
        T_tracker_camera=bundle.X,
        board_scale=bundle.scale,
        sigma_board_scale=float(np.sqrt(bundle.covariance[12, 12])),
    )
    if not result.excessive_sigma:
        return result
    # In the tracker's axes, as the operator turns the tracker.
    turned = adjoint(result.T_tracker_camera)
    covariance = turned @ result.covariance @ turned.T
    worst = np.linalg.eigh(covariance[:3, :3])[1][:, -1]
    axis = AXIS_NAMES[int(np.argmax(np.abs(worst)))]
    others = [name for name in AXIS_NAMES if name != axis]
    raise DegenerateMotionError(
        f"{TASK}: the uncertainty of the mount is {result.excessive_sigma}; the "
        f"rotation about the tracker's {axis} axis is least certain: rotate it more about "
        f"{' and '.join(others)}, take more views, and move the board closer",
        missing_axes=others,
    )


def _check_lens(views: BoardViews, Ts_camera_board: np.ndarray) -> None:
    """Refuse corners that a lens of another K or distortion shows; boards at their best poses."""
    from services.alignment.calibration.lens_fit import known_lens_misfit

    corners = (views.points_board, views.pixels_px)
    lens, board = known_lens_misfit(corners, views.K, views.distortion, Ts_camera_board)
    num, squares = sum(map(len, views.points_board)), lens.explained + lens.rest * lens.freedom
    off_px, rms_px = np.sqrt(np.array([lens.explained, squares]) / num)
    is_decided = lens.freedom >= MIN_LENS_FREEDOM and lens.p_value <= MAX_CHANCE
    if not is_decided or off_px < max(MIN_LENS_MISFIT_PX, MIN_LENS_SHARE * rms_px):
        return
    longer = float(np.mean(lens.coefficients[:2] / np.diag(views.K)[:2]))
    cause = (
        "a board that is bent, or longer along one axis; use a flat print to scale"
        if board.explained > lens.explained
        else f"focal lengths that are {longer:+.1%} longer, or another centre or distortion; "
        "calibrate the camera anew, with the same lens, zoom and image size"
    )
    raise InvalidInputError(
        f"{TASK}: corners of the board fit to {rms_px:.2f} px RMS; {off_px:.2f} px show {cause}"
    )


def _check_scale(task: str, bundle: Bundle, expected_sigma: float, names: tuple[str, str]) -> None:
    """Refuse series that say, without what was expected, that they differ in scale."""
    variance = bundle.covariance[12, 12] / bundle.excess
    # Information of the views alone; what was expected is a Gaussian about one.
    information = 1 / variance - 1 / expected_sigma**2
    if information < MIN_SCALE_INFORMATION / expected_sigma**2:
        return
    log_scale = np.log(bundle.scale) / information / variance
    own_variance = bundle.excess / information
    if abs(log_scale) > NUM_SCALE_SIGMAS * np.hypot(np.sqrt(own_variance), expected_sigma):
        raise wrong_scale(task, names, float(np.exp(log_scale)), float(np.sqrt(own_variance)))


def board_components(Ts_camera_board: np.ndarray, noise: HandEyeNoise) -> dict[str, Component]:
    """Noise of a board's pose: a camera sees tilt and depth worse than the rest."""
    R = Ts_camera_board[:, :3, :3]
    along = np.swapaxes(R, 1, 2)[:, :, 2:] @ R[:, 2:]
    across = np.eye(3) - along
    rows = (
        ("board_tilt_rad", noise.board_tilt_rad, across, slice(0, 3)),
        ("board_roll_rad", noise.board_roll_rad, along, slice(0, 3)),
        ("board_sideways_m", noise.board_sideways_m, across, slice(3, 6)),
        ("board_depth_m", noise.board_depth_m, along, slice(3, 6)),
    )
    components = {}
    for name, sigma, block, place in rows:
        shapes = np.zeros((len(R), 6, 6))
        shapes[:, place, place] = block
        components[name] = Component(sigma, shapes)
    return components


def project(
    points_board: np.ndarray, Ts_camera_board: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> tuple[Float64[np.ndarray, "n k 2"], Float64[np.ndarray, "n k 2 6"]]:
    """Project corners [n, k, 3] before the camera, with Jacobians by twists of the board."""
    import cv2

    points = points_board @ np.swapaxes(Ts_camera_board[:, :3, :3], 1, 2)
    points = points + Ts_camera_board[:, None, :3, 3]
    if (points[..., 2] <= 0).any():
        raise InvalidInputError(
            "board views: a corner lies behind the camera; the board's pose or its corners are "
            "wrong, check which side is inverted"
        )
    still = np.zeros(3)
    pixels, J = cv2.projectPoints(points.reshape(-1, 3), still, still, K, distortion)
    shape = (*points.shape[:2], 2)
    # By twists of the camera's frame, where the corners already are.
    J_camera = np.asarray(J)[:, :6].reshape(*shape, 6)
    return np.asarray(pixels).reshape(shape), J_camera @ adjoint(Ts_camera_board)[:, None]


def polish(measurement: Measurement, Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "n 4 4"]:
    """Refine each view's pose to the least reprojection error."""
    Ts = Ts_camera_board
    for _ in range(POLISH_ROUNDS):
        seen = measurement(Ts)
        Ts = Ts @ move(-np.linalg.solve(seen.information, seen.gradient[..., None])[..., 0])
    return Ts


@dataclass(frozen=True)
class RobotBaseResult(PoseEstimate):
    """Pose of the robot's base, how well it is known, and how far pairs are off (RMS)."""

    T_world_base: Float64[np.ndarray, "4 4"]
    T_effector_tracker: Float64[np.ndarray, "4 4"]
    rotation_rms_rad: float
    translation_rms_m: float


def solve_robot_base(
    Ts_world_tracker: np.ndarray,
    Ts_base_effector: np.ndarray,
    *,
    T_effector_tracker: np.ndarray | None = None,
) -> RobotBaseResult:
    """Estimate the robot's base in the tracked world, and the noise, from simultaneous poses.

    Both series are [n ≥ 4, 4, 4], of a tracker that the effector carries, and of the effector by
    the robot's own joints. `T_effector_tracker` is the identity where both are of the same frame,
    None to find it.

    Raises:
        DegenerateMotionError: the effector was turned too little or about one axis only (or, of a
            known tracker, hardly moved), or the base stays less known than half a degree and 10 mm.
        InvalidInputError: too few pairs, or pairs that contradict each other (an inverted series is
            named).
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    tracker, effector = checked_poses(
        BASE_TASK, Ts_world_tracker=Ts_world_tracker, Ts_base_effector=Ts_base_effector
    )
    names = ("Ts_world_tracker", "Ts_base_effector")
    series = Series(BASE_TASK, "effector", tracker, invert(effector), names)
    mount = None
    if T_effector_tracker is not None:
        _check_places(effector)
        repeated = np.broadcast_to(T_effector_tracker, (MIN_VIEWS, *np.shape(T_effector_tracker)))
        (given,) = checked_poses(f"{BASE_TASK}, T_effector_tracker", T_effector_tracker=repeated)
        mount = invert(given[0])
    agreed = agreeing_views(series, mount)
    agreed = agreed._replace(series=mean_series(agreed.series, place_labels(agreed.series)))
    # The robot errs in the effector's axes.
    own = sensor_components("robot", adjoint(invert(agreed.predicted)), ROBOT_SIGMA)
    bundle, sigmas = weighted_bundle(agreed, TrackerNoise(), own, scale_sigma=ROBOT_SCALE_SIGMA)
    _check_scale(BASE_TASK, bundle, ROBOT_SCALE_SIGMA, names)
    check_mount(BASE_TASK, names, bundle.X)
    _, errors = view_errors(agreed.series, bundle.X)
    rotation_rms_rad, translation_rms_m = np.sqrt(np.square(errors).mean(axis=0)).tolist()
    result = RobotBaseResult(
        covariance=bundle.covariance[6:12, 6:12],
        rotation_rms_rad=rotation_rms_rad,
        translation_rms_m=translation_rms_m,
        noise=sigmas,
        left_out_views=agreed.left_out,
        T_world_base=bundle.Z,
        T_effector_tracker=invert(bundle.X),
    )
    if result.excessive_sigma:
        raise DegenerateMotionError(
            f"{BASE_TASK}: the uncertainty of the base is {result.excessive_sigma}; turn the "
            "effector by 30 degrees and more about all its axes, take more pairs over more of the "
            "workspace, and hold the robot still for each",
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
    spread_mm = "/".join(f"{value * 1e3:.0f}" for value in spread_m)
    raise DegenerateMotionError(
        f"{BASE_TASK}: places of the effector spread {spread_mm} mm along three directions, "
        f"expected the second at least {MIN_SECOND_SPREAD_M * 1e3:.0f}; also move the effector by "
        f"20 cm and more along the base's {' and '.join(names)} axis",
        spread_m=[float(value) for value in spread_m],
        missing_axes=names,
    )


class GaugeView(FrozenModel):
    """A figure of a mount's run, what it has to reach, and the share of the way (0 to 1)."""

    title: str
    value: str
    wanted: str
    share: float


@dataclass(frozen=True)
class MountProgress:
    """What the places so far say of a mount.

    Views of one place (within 2 degrees and 10 mm) count once. `todo` is advice, most important
    first, empty if there is enough; `result` the mount, None while it is not determined; `problem`
    why the solver refuses the places.
    """

    num_places: int
    gauges: tuple[GaugeView, ...]
    todo: tuple[str, ...]
    result: HandEyeResult | None = None
    problem: str = ""

    @property
    def is_enough(self) -> bool:
        """Whether the mount is as well known as it has to be."""
        return not self.todo

    @property
    def share(self) -> float:
        """Share of the way, that of the gauge that is least far."""
        return min(gauge.share for gauge in self.gauges)


def mount_progress(
    Ts_world_tracker: np.ndarray,
    Ts_camera_board: np.ndarray,
    *,
    views: BoardViews | None = None,
) -> MountProgress:
    """Solve as `solve_hand_eye`, once there are enough views, and say what is missing."""
    num_places = len(Ts_world_tracker)
    if num_places >= MIN_VIEWS:
        names = ("Ts_world_tracker", "Ts_camera_board")
        series = Series(TASK, "tracker", Ts_world_tracker, Ts_camera_board, names)
        num_places = int(place_labels(series, min_places=1).max()) + 1
    spreads_rad, wanted = turn_spreads(Ts_camera_board), f"{np.rad2deg(WANTED_SPREAD_RAD):.0f}°"
    motion = [
        _gauge(title, f"{np.rad2deg(spread):.0f}°", wanted, spread / WANTED_SPREAD_RAD)
        for (title, _), spread in zip(TURNS, spreads_rad, strict=True)
    ]
    distances_m = np.linalg.norm(np.reshape(Ts_camera_board, (-1, 4, 4))[:, :3, 3], axis=1)
    motion.append(_distance_gauge(distances_m))
    places = _gauge("Places", str(num_places), str(WANTED_PLACES), num_places / WANTED_PLACES)
    result, problem = None, ""
    if num_places >= MIN_VIEWS:
        try:
            result = solve_hand_eye(Ts_world_tracker, Ts_camera_board, views=views)
        except DegenerateMotionError:
            # The gauges say which motion is missing.
            pass
        except InvalidInputError as error:
            problem = error.message
    accuracy = _accuracy_gauges(result)
    todo = _todo(num_places, spreads_rad, motion[-1], result, problem)
    return MountProgress(num_places, (places, *motion, *accuracy), tuple(todo), result, problem)


def camera_turns(Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "pairs 3"]:
    """Turns of the camera about its own axes between all pairs of views, rotation vectors (rad)."""
    pairs = view_pairs(len(Ts_camera_board))
    R = Ts_camera_board[:, :3, :3]
    return vector_from_rotation(R[pairs[:, 1]] @ np.swapaxes(R[pairs[:, 0]], 1, 2))


def turn_spreads(Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "3"]:
    """RMS of the camera's turns about each axis alone (rad): 1 / sqrt((C⁻¹)_ii) of covariance C."""
    if len(Ts_camera_board) < 2:
        return np.zeros(3)
    turns_rad = camera_turns(Ts_camera_board)
    covariance = turns_rad.T @ turns_rad / len(turns_rad)
    inverse = np.linalg.inv(covariance + SMALLEST_SPREAD_RAD**2 * np.eye(3))
    return 1 / np.sqrt(np.diag(inverse))


def _gauge(title: str, value: str, wanted: str, share: float) -> GaugeView:
    return GaugeView(title=title, value=value, wanted=wanted, share=min(1.0, float(share)))


def _distance_gauge(distances_m: np.ndarray) -> GaugeView:
    value, share = "unknown", 0.0
    if len(distances_m):
        ratio = float(distances_m.max()) / float(distances_m.min())
        value, share = f"{ratio:.1f} to 1", np.log(ratio) / np.log(WANTED_DISTANCE_RATIO)
    return _gauge("Farthest to nearest", value, f"{WANTED_DISTANCE_RATIO:g} to 1", share)


def _accuracy_gauges(result: HandEyeResult | None) -> tuple[GaugeView, GaugeView]:
    turn, shift, turn_share, shift_share = "unknown", "unknown", 0.0, 0.0
    if result is not None:
        rad, m = result.sigma_rotation_rad, result.sigma_translation_m
        turn, turn_share = f"± {np.rad2deg(rad):.2f}°", WANTED_ROTATION_RAD / rad
        shift, shift_share = f"± {m * 1e3:.1f} mm", WANTED_TRANSLATION_M / m
    return (
        _gauge("Direction", turn, f"± {np.rad2deg(WANTED_ROTATION_RAD):.2f}°", turn_share),
        _gauge("Position", shift, f"± {WANTED_TRANSLATION_M * 1e3:.1f} mm", shift_share),
    )


def _todo(
    num_places: int,
    spreads_rad: np.ndarray,
    distance: GaugeView,
    result: HandEyeResult | None,
    problem: str,
) -> list[str]:
    if problem:
        return [problem]
    if num_places < 2:
        return ["show the whole board to the camera and hold still"]
    todo = [
        f"{TURNS[axis][1]}, by 20 degrees to either side"
        for axis in np.argsort(spreads_rad)
        if spreads_rad[axis] < WANTED_SPREAD_RAD
    ]
    if distance.share < 1:
        todo.append(
            f"hold the camera nearer to the board and farther off (so far {distance.value})"
        )
    if num_places < WANTED_PLACES:
        todo.append(f"{_more(WANTED_PLACES - num_places)}, each turned another way")
    if result is None:
        return todo or ["turn the camera farther to all sides"]
    excess = max(
        result.sigma_rotation_rad / WANTED_ROTATION_RAD,
        result.sigma_translation_m / WANTED_TRANSLATION_M,
    )
    if excess > 1:
        # A sigma falls with the square root of the number of places.
        missing = max(1, int(np.ceil(num_places * (excess**2 - 1))))
        todo.append(f"about {_more(missing)}, turned farther and nearer to the board than so far")
    return todo


def _more(number: int) -> str:
    return f"{number} more place{'s' if number > 1 else ''}"
