"""Stress of camera calibration: mounts on trackers and lenses, on simulated views of a board."""

from functools import cache

import numpy as np

from benchmarks.simulated.board_scenes import (
    TURN_AXES,
    Motion,
    Scene,
    make_scene,
    mount_difference,
    selected_boards,
    simulated_boards,
)
from benchmarks.stress.cells import Check, StageCells, bfloat16
from dextouch.errors import NonFiniteError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.hand_eye import HandEyeNoise, solve_hand_eye
from services.alignment.calibration.intrinsics import calibrate_found
from services.alignment.calibration.motion import DegenerateMotionError

STAGE = StageCells("hand-eye")
# Bounds of the accuracy tests for 20 views with 0.3 px of noise.
_MAX_RAD, _MAX_M = 0.005, 0.003


@STAGE.cell("rotations", "a world that is turned by π, and by π - 1e-9, against the board's")
def _rotations(check: Check) -> None:
    scene = _scene()
    plain = _mount(scene.Ts_world_tracker, scene.Ts_camera_board)
    off = mount_difference(plain, scene.T_tracker_camera)
    check.at_most("mount off", off[0], _MAX_RAD, "rad")
    check.at_most("mount off by", off[1], _MAX_M, "m")
    for axis in np.eye(3):
        for angle in (np.pi, np.pi - 1e-9):
            turn = transform(rotation_from_vector(angle * axis), np.array([3.0, -2.0, 1.0]))
            turned = _mount(turn @ scene.Ts_world_tracker, scene.Ts_camera_board)
            _changes(check, "mount changes", plain, turned, 1e-6)


@STAGE.cell("one_axis", "turns about x, y or z only, of 4 degrees, none; a lens seen from one side")
def _one_axis(check: Check) -> None:
    motions = {
        f"about {name} only": Motion(tilt_deg=40.0, axes=axes) for name, axes in TURN_AXES.items()
    }
    motions |= {"4 degrees": Motion(tilt_deg=4.0), "no turn": Motion(tilt_deg=0.0)}
    for what, motion in motions.items():
        scene = make_scene(1, motion)
        tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
        check.refused(what, _mount, tracker, board, kind=DegenerateMotionError)
    repeated = make_scene(2, Motion(num_views=4)).repeated([0] * 20)
    tracker, board = repeated.Ts_world_tracker, repeated.Ts_camera_board
    check.refused("one view 20 times", _mount, tracker, board)
    boards = simulated_boards(3, 8)
    same = selected_boards(boards, [0] * 8)
    check.refused("lens, one view 8 times", calibrate_found, same, kind=DegenerateMotionError)


@STAGE.cell("non_finite", "NaN, infinity and a mirrored matrix in one pose; noise of 0 and NaN")
def _non_finite(check: Check) -> None:
    scene = _scene()
    for bad in (np.nan, np.inf):
        poses = scene.Ts_world_tracker.copy()
        poses[7, 1, 3] = bad
        check.refused(f"{bad}", _mount, poses, scene.Ts_camera_board, kind=NonFiniteError)
    mirrored = scene.Ts_world_tracker.copy()
    mirrored[3, :3, 0] *= -1
    check.refused("mirrored", _mount, mirrored, scene.Ts_camera_board)
    for bad in (0.0, -1.0, np.nan, np.inf):
        check.refused(f"noise {bad:g}", HandEyeNoise, pixel_px=bad)


@STAGE.cell("ends", "4 views, the fewest, and 3")
def _ends(check: Check) -> None:
    scene = _scene()
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    check.refused("3 views", _mount, tracker[:3], board[:3])
    check.refused("no view", _mount, tracker[:0], board[:0])
    boards = simulated_boards(3, 5)
    check.refused("lens of 4 views", lambda: calibrate_found(selected_boards(boards, [0, 1, 2, 3])))
    check.true("lens of 5 views", np.isfinite(calibrate_found(boards).K).all())


@STAGE.cell("precision", "poses rounded to float32, float16 and bfloat16")
def _precision(check: Check) -> None:
    scene = _scene()
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    exact = _mount(tracker, board)
    single = _mount(tracker.astype(np.float32), board.astype(np.float32))
    _changes(check, "float32: mount changes", exact, single, 1e-5)
    half = _mount(tracker.astype(np.float16), board.astype(np.float16))
    _changes(check, "float16: mount changes", exact, half, _MAX_RAD)
    coarse = bfloat16(tracker)
    check.refused("bfloat16, no rotations any more", _mount, coarse, board)


@STAGE.cell("batch", "the views in another order, and each of them twice")
def _batch(check: Check) -> None:
    scene = _scene()
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    exact = _mount(tracker, board)
    order = np.random.default_rng(0).permutation(len(tracker))
    _changes(check, "shuffled: mount changes", exact, _mount(tracker[order], board[order]), 1e-6)
    twice = np.tile(np.arange(len(tracker)), 2)
    _changes(check, "doubled: mount changes", exact, _mount(tracker[twice], board[twice]), 1e-4)


STAGE.does_not_apply(
    clock="poses come in pairs, without times; see clocks",
    touch="no touch; see tactile-calibration",
    device="numpy arrays live in the host's memory",
    long_run="one take, solved at once: nothing is carried from view to view",
)


@cache
def _scene() -> Scene:
    return make_scene(0, Motion(num_views=20))


def _mount(Ts_world_tracker: np.ndarray, Ts_camera_board: np.ndarray) -> np.ndarray:
    return solve_hand_eye(Ts_world_tracker, Ts_camera_board).T_tracker_camera


def _changes(check: Check, what: str, a: np.ndarray, b: np.ndarray, bound_rad: float) -> None:
    check.at_most(what, mount_difference(a, b)[0], bound_rad, "rad")
