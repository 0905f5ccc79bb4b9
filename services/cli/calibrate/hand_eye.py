"""Command `dextouch station calibrate hand-eye`: mount of a camera on its tracker."""

import argparse
import csv
import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NotFoundError, ShapeError, UnknownNameError
from dextouch.geometry import invert, transform_from_pose
from services.alignment.calibration.board_views import BoardViews
from services.alignment.calibration.hand_eye import solve_hand_eye
from services.cli.calibrate.advice import turn_coverage
from services.cli.calibrate.boards import board_pose, is_ambiguous, parse_board
from services.cli.calibrate.camera import find_boards, lens_of, tell_left_out
from services.cli.calibrate.pictures import turns_picture
from services.cli.calibrate.record import (
    named_matrix,
    read_matrices,
    write_entry,
    write_picture,
)

# Tracker of each camera, by the stream names of recordings.
TRACKERS = {"head": "head", "wrist_left": "left", "wrist_right": "right"}
POSE_COLUMNS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
POSES_HELP = (
    "CSV with the columns image,x_m,y_m,z_m,qw,qx,qy,qz (T_world_tracker), or JSON: "
    '[{"image": "a.jpg", "T_world_tracker": 4x4}, …], or without photos '
    "[[T_world_tracker, T_camera_board], …]"
)


@dataclass(frozen=True)
class PosedViews:
    """Paired poses of tracker and board, with names of the views.

    `corners` are the detected corners, if there are photos; `blurred` lists photos excluded for
    blur.
    """

    names: tuple[str, ...]
    Ts_world_tracker: Float64[np.ndarray, "n 4 4"]
    Ts_camera_board: Float64[np.ndarray, "n 4 4"]
    corners: BoardViews | None = None
    blurred: tuple[str, ...] = ()


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate the mount of one camera on its tracker.

    Raises:
        DegenerateMotionError: the tracker was rotated too little; the message names the axis.
        InvalidInputError: poses and photos that do not match or contradict each other.
        NotFoundError: no photos, poses or intrinsics.
    """
    views = read_views(options)
    turns = turn_coverage(views.Ts_world_tracker)
    picture = f"hand_eye_{options.camera}.svg"
    # Drawn before solving, so that it is available after a refusal.
    path = write_picture(options.to, picture, turns_picture(turns, views.names, None))
    print(f"{len(views.names)} views; turns of the tracker: {path}")
    for words in turns.todo:
        print(f"next: {words}")
    report: dict[str, object] = {
        "num_views": len(views.names),
        "spread_deg": np.rad2deg(turns.spread_rad).tolist(),
        "next": list(turns.todo),
    }
    if options.check:
        return report
    result = solve_hand_eye(views.Ts_world_tracker, views.Ts_camera_board, views=views.corners)
    X = result.T_tracker_camera
    off_mm = board_scatter_mm(views, X)
    left_out = [views.names[index] for index in result.left_out_views]
    for view in left_out:
        print(f"  {view} is far off: left out; did the tracker stand still, and is it its pose?")
    kept = np.delete(off_mm, result.left_out_views)
    write_picture(options.to, picture, turns_picture(turns, views.names, off_mm))
    name = f"T_tracker_{TRACKERS[options.camera]}_camera_{options.camera}"
    facts = report | {
        "camera": options.camera,
        "sigma_rotation_deg": float(np.rad2deg(result.sigma_rotation_rad)),
        "sigma_translation_mm": result.sigma_translation_m * 1e3,
        "board_scatter_rms_mm": float(np.sqrt(np.mean(kept**2))),
        "left_out": left_out,
        "blurred": list(views.blurred),
        "translation_mm": (X[:3, 3] * 1e3).tolist(),
    }
    write_entry(
        options.to,
        entry=name,
        matrices={
            name: X,
            f"{name}_sigma_rad": np.array([[result.sigma_rotation_rad]]),
            f"{name}_sigma_m": np.array([[result.sigma_translation_m]]),
        },
        facts=facts,
        now=datetime.now(UTC),
    )
    print(
        f"{name}: known to {facts['sigma_rotation_deg']:.3f}° and "
        f"{facts['sigma_translation_mm']:.2f} mm; the board scatters by "
        f"{facts['board_scatter_rms_mm']:.1f} mm RMS"
    )
    return facts


def read_views(options: argparse.Namespace) -> PosedViews:
    """Read poses from the file, and boards from the photos or from the same file."""
    entries = read_json(options.poses) if options.poses.suffix.lower() == ".json" else None
    if entries is not None and all(isinstance(entry, list) for entry in entries):
        views = _pairs(entries, options.poses)
    else:
        named = (
            _csv_poses(options.poses) if entries is None else _json_poses(entries, options.poses)
        )
        views = _with_photos(named, options)
    tracker, board = views.Ts_world_tracker, views.Ts_camera_board
    if options.invert == "tracker":
        tracker = invert(tracker)
    if options.invert == "board" and views.corners is not None:
        raise InvalidInputError("--invert board: the board's poses come from photos and are right")
    if options.invert == "board":
        board = invert(board)
    if len(views.names) < 2:
        raise InvalidInputError(f"hand-eye: got {len(views.names)} views, expected at least 4")
    return replace(views, Ts_world_tracker=tracker, Ts_camera_board=board)


def board_scatter_mm(views: PosedViews, T_tracker_camera: np.ndarray) -> Float64[np.ndarray, " n"]:
    """Distance of the board in each view from its mean over all views, in mm."""
    places = (views.Ts_world_tracker @ T_tracker_camera @ views.Ts_camera_board)[:, :3, 3]
    return np.linalg.norm(places - places.mean(axis=0), axis=1) * 1e3


def read_json(path: Path) -> list[object]:
    """Read a list from a JSON file.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not a JSON list, or empty.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file of poses; expected {POSES_HELP}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InvalidInputError(f"{path}: no JSON ({error}); expected {POSES_HELP}") from error
    if not isinstance(content, list) or not content:
        raise InvalidInputError(f"{path}: expected a list with at least one pose: {POSES_HELP}")
    return content


def _pairs(entries: list[object], path: Path) -> PosedViews:
    try:
        pairs = np.array(entries, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"{path}: {error}; expected {POSES_HELP}") from error
    if pairs.ndim != 4 or pairs.shape[1:] != (2, 4, 4):
        raise ShapeError(f"{path}: got {pairs.shape}, expected [n, 2, 4, 4]")
    names = tuple(f"view {index}" for index in range(len(pairs)))
    return PosedViews(names, pairs[:, 0], pairs[:, 1])


def _json_poses(entries: list[object], path: Path) -> dict[str, np.ndarray]:
    poses: dict[str, np.ndarray] = {}
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict) or not {"image", "T_world_tracker"} <= set(entry):
            raise InvalidInputError(f"{path}: entry {index}: expected {POSES_HELP}")
        T = np.array(entry["T_world_tracker"], dtype=np.float64)
        if T.shape != (4, 4):
            raise ShapeError(f"{path}: entry {index}: got {T.shape}, expected 4 by 4")
        _add(poses, str(entry["image"]), T, path)
    return poses


def _csv_poses(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file of poses; expected {POSES_HELP}")
    try:
        return _read_csv_poses(path)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            f"{path}: no CSV in UTF-8 ({error}); expected {POSES_HELP}"
        ) from error


def _read_csv_poses(path: Path) -> dict[str, np.ndarray]:
    poses: dict[str, np.ndarray] = {}
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        missing = {"image", *POSE_COLUMNS} - set(reader.fieldnames or ())
        if missing:
            raise InvalidInputError(
                f"{path}: columns {sorted(missing)} missing; expected {POSES_HELP}"
            )
        for row in reader:
            try:
                pose = np.array([float(row[column]) for column in POSE_COLUMNS])
            except (TypeError, ValueError) as error:
                raise InvalidInputError(f"{path}: line {reader.line_num}: {error}") from error
            if abs(float(np.linalg.norm(pose[3:])) - 1) > 0.01:
                raise InvalidInputError(
                    f"{path}: line {reader.line_num}: quaternion of length "
                    f"{np.linalg.norm(pose[3:]):.3f}, expected 1 (order w x y z)"
                )
            _add(poses, row["image"], transform_from_pose(pose), path)
    return poses


def _add(poses: dict[str, np.ndarray], name: str, T: np.ndarray, path: Path) -> None:
    if name in poses:
        raise InvalidInputError(f"{path}: image {name!r} is named twice")
    poses[name] = T


def _with_photos(poses: dict[str, np.ndarray], options: argparse.Namespace) -> PosedViews:
    if options.photos is None or options.board is None:
        raise InvalidInputError(
            f"{options.poses}: names photos, so --photos FOLDER and --board are needed too"
        )
    board = parse_board(options.board)
    if is_ambiguous(board):
        raise InvalidInputError(
            f"board {options.board!r} looks the same after half a turn; use one with an odd and an "
            "even number of inner corners, or a ChArUco board"
        )
    paths = [options.photos / name for name in sorted(poses)]
    absent = [path.name for path in paths if not path.is_file()]
    if absent:
        raise NotFoundError(f"{options.photos}: has no photo {', '.join(absent[:5])}")
    lens_matrices = _lens_matrices(options)
    found = find_boards(paths, board)
    tell_left_out(found)
    lens = lens_of(lens_matrices, found.size_px)
    names = tuple(view.name for view in found.views)
    if not names:
        raise InvalidInputError(
            f"{options.photos}: none of {len(paths)} photos shows the board sharply "
            f"({len(found.blurred)} are blurred)"
        )
    return PosedViews(
        names,
        np.stack([poses[name] for name in names]),
        np.stack([board_pose(view, lens) for view in found.views]),
        BoardViews(
            [view.points_board.astype(np.float64) for view in found.views],
            [view.pixels.astype(np.float64) for view in found.views],
            lens.K,
            lens.distortion,
        ),
        found.blurred,
    )


def _lens_matrices(options: argparse.Namespace) -> dict[str, np.ndarray]:
    folder = options.intrinsics or options.to
    camera = options.camera
    if camera not in TRACKERS:
        raise UnknownNameError("camera", camera, list(TRACKERS))
    try:
        matrices = read_matrices(folder)
        return {
            "K": named_matrix(matrices, f"K_{camera}", (3, 3)),
            "distortion": named_matrix(matrices, f"distortion_{camera}", (1, 5)),
            "image_size": named_matrix(matrices, f"image_size_{camera}_px", (1, 2)),
        }
    except NotFoundError as error:
        raise NotFoundError(
            f"{error.message}. First: dextouch station calibrate camera --camera {camera} "
            f"--to {folder} …"
        ) from error
