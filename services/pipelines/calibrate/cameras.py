"""Commands `camera`, `hand-eye` and `robot-base` of `dextouch station calibrate`.

Intrinsics come from photos of a board, which lie in a folder or are collected first, from a watched
folder or a running station; transforms come from pairs of poses.
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from dextouch.clients import HttpLink
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import invert
from services.alignment.calibration.hand_eye import BoardViews, solve_hand_eye, solve_robot_base
from services.alignment.station_calibration.boards import (
    board_pose,
    is_ambiguous,
    parse_board,
    read_photos,
    turn_coverage,
)
from services.alignment.station_calibration.camera_views import (
    Session,
    calibrate_photos,
    folder_arrivals,
    read_lens,
    station_arrivals,
    turns_picture,
)
from services.alignment.station_calibration.record import (
    TRACKERS,
    poses_of_photos,
    read_pairs,
    write_picture,
    write_pose,
)

POSES_HELP = (
    "CSV with the columns image,x_m,y_m,z_m,qw,qx,qy,qz (T_world_tracker), or without photos "
    "JSON: [[T_world_tracker, T_camera_board], …], each 4x4"
)
PAIRS_HELP = "JSON: [[T_world_tracker, T_base_effector], …], each 4x4, both of the same moment"
BASE_NAME = "T_world_base"


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case.

    With `--url` or `--watch` photos are collected first.
    """
    if options.watch and options.url is not None:
        raise InvalidInputError("got --watch and --url, expected one of the two")
    if options.watch or options.url is not None:
        _collect(options)
    return calibrate_photos(options)


def _collect(options: argparse.Namespace) -> None:
    """Collect until coverage is sufficient, or Ctrl-C."""
    session = Session(options, None if options.url is None else options.photos)
    print("Ctrl-C ends the collection and calibrates with the photos so far")
    try:
        if options.url is None:
            session.collect(folder_arrivals(options.photos))
            return
        link = HttpLink(options.url, api_key=options.key)
        session.collect(station_arrivals(link, options.camera))
    except KeyboardInterrupt:
        print(f"stopped with {len(session.views)} views")


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


def calibrate_mount(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate the mount of one camera on its tracker.

    Raises:
        DegenerateMotionError: the tracker was rotated too little; the message names the axis.
        InvalidInputError: poses and photos that do not match or contradict each other.
    """
    views = _read_views(options)
    trackers, boards = views.Ts_world_tracker, views.Ts_camera_board
    turns = turn_coverage(trackers)
    picture = f"hand_eye_{options.camera}.svg"
    # Drawn before solving, so that it is available after a refusal.
    path = write_picture(options.to, picture, turns_picture(turns, views.names, None))
    print(f"{len(views.names)} views; turns of the tracker: {path}")
    for words in turns.todo:
        print(f"next: {words}")
    facts: dict[str, object] = {
        "num_views": len(views.names),
        "spread_deg": np.rad2deg(turns.spread_rad).tolist(),
        "next": list(turns.todo),
    }
    if options.check:
        return facts
    result = solve_hand_eye(trackers, boards, views=views.corners)
    X = result.T_tracker_camera
    # How far each view puts the board from its mean.
    places_m = (trackers @ X @ boards)[:, :3, 3]
    off_mm = np.linalg.norm(places_m - places_m.mean(axis=0), axis=1) * 1e3
    left_out = [views.names[index] for index in result.left_out_views]
    for view in left_out:
        print(f"  {view} is far off: left out; did the tracker stand still, and is it its pose?")
    write_picture(options.to, picture, turns_picture(turns, views.names, off_mm))
    rms_mm = float(np.sqrt(np.mean(np.delete(off_mm, result.left_out_views) ** 2)))
    facts |= {
        "camera": options.camera,
        "board_scatter_rms_mm": rms_mm,
        "left_out": left_out,
        "blurred": list(views.blurred),
        "translation_mm": (X[:3, 3] * 1e3).tolist(),
        "board_scale": result.board_scale,
        "sigma_board_scale": result.sigma_board_scale,
    }
    name = f"T_tracker_{TRACKERS[options.camera]}_camera_{options.camera}"
    sigma = (result.sigma_rotation_rad, result.sigma_translation_m)
    known = write_pose(options.to, name, X, sigma, facts)
    print(
        f"{known}; the board scatters by {rms_mm:.1f} mm RMS, and is {result.board_scale:.4f} ± "
        f"{result.sigma_board_scale:.4f} times as large as entered"
    )
    return facts


def calibrate_base(options: argparse.Namespace) -> dict[str, object]:
    """Estimate a robot's base from pairs of poses of a tracker on the effector and the effector.

    Raises:
        DegenerateMotionError: the effector was rotated or moved too little; the message names the
            axes.
        InvalidInputError: too few pairs, or pairs that contradict each other.
    """
    pairs = read_pairs(options.poses, PAIRS_HELP)
    mount = np.eye(4) if options.same_frame else None
    result = solve_robot_base(pairs[:, 0], pairs[:, 1], T_effector_tracker=mount)
    left_out = list(result.left_out_views)
    for index in left_out:
        print(f"  pair {index} is far off: left out; did the robot stand still?")
    rms_deg, rms_mm = np.rad2deg(result.rotation_rms_rad), result.translation_rms_m * 1e3
    facts: dict[str, object] = {
        "num_pairs": len(pairs) - len(left_out),
        "residual_rms_deg": float(rms_deg),
        "residual_rms_mm": rms_mm,
        "left_out": left_out,
        "T_effector_tracker": result.T_effector_tracker.tolist(),
    }
    sigma = (result.sigma_rotation_rad, result.sigma_translation_m)
    known = write_pose(options.to, BASE_NAME, result.T_world_base, sigma, facts)
    print(
        f"{known} from {facts['num_pairs']} pairs; they scatter by {rms_deg:.3f}° and "
        f"{rms_mm:.2f} mm RMS"
    )
    return facts


def _read_views(options: argparse.Namespace) -> PosedViews:
    """Read poses from the file, and boards from the photos or from the same file."""
    if options.poses.suffix.lower() == ".json":
        trackers, boards = np.swapaxes(read_pairs(options.poses, POSES_HELP), 0, 1)
        names = tuple(f"view {index}" for index in range(len(trackers)))
        views = PosedViews(names, trackers, invert(boards) if options.invert == "board" else boards)
    else:
        views = _with_photos(poses_of_photos(options.poses, POSES_HELP), options)
        if options.invert == "board":
            raise InvalidInputError(
                "--invert board: the board's poses come from photos and are right"
            )
    if len(views.names) < 2:
        raise InvalidInputError(f"hand-eye: got {len(views.names)} views, expected at least 4")
    if options.invert == "tracker":
        views = replace(views, Ts_world_tracker=invert(views.Ts_world_tracker))
    return views


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
    photos = read_photos(paths, board)
    photos.tell_left_out()
    if calibrated_px != photos.size_px:
        raise InvalidInputError(
            f"photos: got {photos.size_px[0]} by {photos.size_px[1]} px, but K was measured at "
            f"{calibrated_px[0]} by {calibrated_px[1]}; take the photos in the same mode of the "
            "camera"
        )
    if not photos.views:
        raise InvalidInputError(
            f"{options.photos}: none of {len(paths)} photos shows the board sharply "
            f"({len(photos.blurred)} are blurred)"
        )
    return PosedViews(
        tuple(view.name for view in photos.views),
        np.stack([poses[view.name] for view in photos.views]),
        np.stack([board_pose(view, lens) for view in photos.views]),
        BoardViews(
            [view.points_board.astype(np.float64) for view in photos.views],
            [view.pixels.astype(np.float64) for view in photos.views],
            lens.K,
            lens.distortion,
        ),
        photos.blurred,
    )
