"""Command `dextouch station calibrate hand-eye`: mount of a camera on its tracker."""

import argparse
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import invert
from services.alignment.calibration.board_views import BoardViews
from services.alignment.calibration.hand_eye import solve_hand_eye
from services.cli.calibrate.advice import turn_coverage
from services.cli.calibrate.boards import board_pose, is_ambiguous, parse_board
from services.cli.calibrate.camera import find_boards, read_lens, tell_left_out
from services.cli.calibrate.pictures import turns_picture
from services.cli.calibrate.poses import pairs_of, poses_of_photos, read_json
from services.cli.calibrate.record import write_entry, write_picture

# Tracker of each camera, by the stream names of recordings.
TRACKERS = {"head": "head", "wrist_left": "left", "wrist_right": "right"}
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
    matrices: dict[str, np.ndarray | float] = {
        name: X,
        f"{name}_sigma_rad": result.sigma_rotation_rad,
        f"{name}_sigma_m": result.sigma_translation_m,
    }
    write_entry(options.to, name, matrices, facts)
    print(
        f"{name}: known to {facts['sigma_rotation_deg']:.3f}° and "
        f"{facts['sigma_translation_mm']:.2f} mm; the board scatters by "
        f"{facts['board_scatter_rms_mm']:.1f} mm RMS"
    )
    return facts


def read_views(options: argparse.Namespace) -> PosedViews:
    """Read poses from the file, and boards from the photos or from the same file."""
    path, entries = options.poses, None
    if path.suffix.lower() == ".json":
        entries = read_json(path, POSES_HELP)
    if entries is not None and all(isinstance(entry, list) for entry in entries):
        pairs = pairs_of(entries, path, POSES_HELP)
        names = tuple(f"view {index}" for index in range(len(pairs)))
        views = PosedViews(names, pairs[:, 0], pairs[:, 1])
    else:
        views = _with_photos(poses_of_photos(path, entries, POSES_HELP), options)
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
    lens, calibrated_px = read_lens(options.intrinsics or options.to, options.camera)
    found = find_boards(paths, board)
    tell_left_out(found)
    if calibrated_px != found.size_px:
        raise InvalidInputError(
            f"photos: got {found.size_px[0]} by {found.size_px[1]} px, but K was measured at "
            f"{calibrated_px[0]} by {calibrated_px[1]}; take the photos in the same mode of the "
            "camera"
        )
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
