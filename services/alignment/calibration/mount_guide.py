"""How far the places so far determine a camera's mount on its tracker, and which motion is missing.

For an operator who still moves the camera in front of a fixed board. Motion is named in the
camera's axes, which the views show without knowing the mount.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import vector_from_rotation
from services.alignment.calibration.hand_eye import (
    TASK,
    BoardViews,
    HandEyeResult,
    solve_hand_eye,
)
from services.alignment.calibration.motion import (
    MIN_VIEWS,
    WANTED_ROTATION_RAD,
    WANTED_TRANSLATION_M,
    DegenerateMotionError,
    Series,
    view_pairs,
)
from services.alignment.calibration.places import place_labels

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
class Gauge:
    """One figure in words, the value that it has to reach, and the share of the way (0 to 1)."""

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
    gauges: tuple[Gauge, ...]
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
    """Solve for the mount and say what is missing.

    Arguments are those of `solve_hand_eye`, in the order of time, and may be empty. Raises
    ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    num_places = _num_places(Ts_world_tracker, Ts_camera_board)
    spreads_rad = turn_spreads(Ts_camera_board)
    motion = [
        _turn_gauge(title, float(spread))
        for (title, _), spread in zip(TURNS, spreads_rad, strict=True)
    ]
    distances_m = np.linalg.norm(np.reshape(Ts_camera_board, (-1, 4, 4))[:, :3, 3], axis=1)
    motion.append(_distance_gauge(distances_m))
    places = Gauge(
        "Places", str(num_places), str(WANTED_PLACES), min(1.0, num_places / WANTED_PLACES)
    )
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


def _num_places(Ts_world_tracker: np.ndarray, Ts_camera_board: np.ndarray) -> int:
    if len(Ts_world_tracker) < MIN_VIEWS:
        return len(Ts_world_tracker)
    names = ("Ts_world_tracker", "Ts_camera_board")
    series = Series(TASK, "tracker", Ts_world_tracker, Ts_camera_board, names)
    return int(place_labels(series, min_places=1).max()) + 1


def camera_turns(Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "pairs 3"]:
    """Turns of the camera about its own axes between all pairs of views, rotation vectors (rad)."""
    pairs = view_pairs(len(Ts_camera_board))
    R = Ts_camera_board[:, :3, :3]
    return vector_from_rotation(R[pairs[:, 1]] @ np.swapaxes(R[pairs[:, 0]], 1, 2))


def turn_spreads(Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "3"]:
    """How far the camera turned about each of its axes alone: RMS over pairs of views (rad).

    Of the covariance C of the turns this is 1 / sqrt((C⁻¹)_ii): oblique axes do not count.
    """
    if len(Ts_camera_board) < 2:
        return np.zeros(3)
    turns_rad = camera_turns(Ts_camera_board)
    covariance = turns_rad.T @ turns_rad / len(turns_rad)
    inverse = np.linalg.inv(covariance + SMALLEST_SPREAD_RAD**2 * np.eye(3))
    return 1 / np.sqrt(np.diag(inverse))


def _turn_gauge(title: str, spread_rad: float) -> Gauge:
    return Gauge(
        title,
        f"{np.rad2deg(spread_rad):.0f}°",
        f"{np.rad2deg(WANTED_SPREAD_RAD):.0f}°",
        min(1.0, float(spread_rad / WANTED_SPREAD_RAD)),
    )


def _distance_gauge(distances_m: np.ndarray) -> Gauge:
    wanted = f"{WANTED_DISTANCE_RATIO:g} to 1"
    if len(distances_m) == 0:
        return Gauge("Farthest to nearest", "unknown", wanted, 0.0)
    near_m, far_m = float(distances_m.min()), float(distances_m.max())
    share = np.log(far_m / near_m) / np.log(WANTED_DISTANCE_RATIO)
    return Gauge(
        "Farthest to nearest", f"{far_m / near_m:.1f} to 1", wanted, min(1.0, float(share))
    )


def _accuracy_gauges(result: HandEyeResult | None) -> tuple[Gauge, Gauge]:
    turn = f"± {np.rad2deg(WANTED_ROTATION_RAD):.2f}°"
    shift = f"± {WANTED_TRANSLATION_M * 1e3:.1f} mm"
    if result is None:
        return Gauge("Direction", "unknown", turn, 0.0), Gauge("Position", "unknown", shift, 0.0)
    rad, m = result.sigma_rotation_rad, result.sigma_translation_m
    return (
        Gauge("Direction", f"± {np.rad2deg(rad):.2f}°", turn, min(1.0, WANTED_ROTATION_RAD / rad)),
        Gauge("Position", f"± {m * 1e3:.1f} mm", shift, min(1.0, WANTED_TRANSLATION_M / m)),
    )


def _todo(
    num_places: int,
    spreads_rad: np.ndarray,
    distance: Gauge,
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
