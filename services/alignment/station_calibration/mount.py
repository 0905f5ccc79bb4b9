"""Where a camera sits on its tracker, from photos of a fixed board and the tracker's poses.

The command `hand-eye` of `dextouch station calibrate` and the guided run of a mount both end here.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import invert
from services.alignment.calibration.hand_eye import BoardViews, solve_hand_eye
from services.alignment.calibration.mount_guide import (
    MountProgress,
    camera_turns,
    mount_progress,
)
from services.alignment.station_calibration.boards import (
    BoardView,
    Lens,
    board_pose,
    check_unambiguous,
    parse_board,
    read_photos,
)
from services.alignment.station_calibration.camera_views import read_lens, turns_picture
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

Say = Callable[[str], None]


@dataclass(frozen=True)
class PosedViews:
    """Paired poses of tracker and board, with names of the views, and the corners of photos.

    `blurred` lists photos excluded for blur.
    """

    names: tuple[str, ...]
    Ts_world_tracker: Float64[np.ndarray, "n 4 4"]
    Ts_camera_board: Float64[np.ndarray, "n 4 4"]
    corners: BoardViews | None = None
    blurred: tuple[str, ...] = ()

    @staticmethod
    def of(views: Sequence[BoardView], Ts_world_tracker: np.ndarray, lens: Lens) -> "PosedViews":
        """Sharp views of a board with the tracker's pose [4, 4] at each."""
        return PosedViews(
            tuple(view.name for view in views),
            np.reshape(Ts_world_tracker, (-1, 4, 4)),
            np.reshape([board_pose(view, lens) for view in views], (-1, 4, 4)),
            BoardViews(
                [view.points_board.astype(np.float64) for view in views],
                [view.pixels.astype(np.float64) for view in views],
                lens.K,
                lens.distortion,
            )
            if views
            else None,
        )

    def progress(self) -> MountProgress:
        """What these views say of the mount, and what is missing."""
        return mount_progress(self.Ts_world_tracker, self.Ts_camera_board, views=self.corners)


def mount_name(camera: str) -> str:
    """Name of the matrix of a camera's mount."""
    return f"T_tracker_{TRACKERS[camera]}_camera_{camera}"


def calibrate_mount(options: argparse.Namespace, *, say: Say = print) -> dict[str, object]:
    """Calibrate the mount of one camera on its tracker.

    Raises DegenerateMotionError: the tracker was rotated too little (names the axis);
    InvalidInputError: poses and photos that do not match or contradict each other.
    """
    views = _read_views(options, say)
    trackers, boards = views.Ts_world_tracker, views.Ts_camera_board
    turns_rad, progress = camera_turns(boards), views.progress()
    picture = f"hand_eye_{options.camera}.svg"
    # Drawn before solving, so that it is available after a refusal.
    svg = turns_picture(turns_rad, progress.todo, views.names, None)
    path = write_picture(options.to, picture, svg)
    say(f"{len(views.names)} views of {progress.num_places} places; turns of the camera: {path}")
    for gauge in progress.gauges:
        say(f"  {gauge.title}: {gauge.value}, wanted {gauge.wanted}")
    for words in progress.todo:
        say(f"next: {words}")
    facts: dict[str, object] = {
        "num_views": len(views.names),
        "num_places": progress.num_places,
        "next": list(progress.todo),
    }
    if options.check:
        return facts
    result = progress.result or solve_hand_eye(trackers, boards, views=views.corners)
    X = result.T_tracker_camera
    # How far each view puts the board from its mean.
    places_m = (trackers @ X @ boards)[:, :3, 3]
    off_mm = np.linalg.norm(places_m - places_m.mean(axis=0), axis=1) * 1e3
    left_out = [views.names[index] for index in result.left_out_views]
    for view in left_out:
        say(f"  {view} is far off: left out; did the tracker stand still, and is it its pose?")
    write_picture(options.to, picture, turns_picture(turns_rad, progress.todo, views.names, off_mm))
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
    sigma = (result.sigma_rotation_rad, result.sigma_translation_m)
    known = write_pose(options.to, mount_name(options.camera), X, sigma, facts)
    say(
        f"{known}; the board scatters by {rms_mm:.1f} mm RMS, and is {result.board_scale:.4f} ± "
        f"{result.sigma_board_scale:.4f} times as large as entered"
    )
    return facts


def _read_views(options: argparse.Namespace, say: Say) -> PosedViews:
    """Read poses from the file, and boards from the photos or from the same file."""
    if options.poses.suffix.lower() == ".json":
        trackers, boards = np.swapaxes(read_pairs(options.poses, POSES_HELP), 0, 1)
        names = tuple(f"view {index}" for index in range(len(trackers)))
        views = PosedViews(names, trackers, invert(boards) if options.invert == "board" else boards)
    else:
        views = _with_photos(poses_of_photos(options.poses, POSES_HELP), options, say)
        if options.invert == "board":
            raise InvalidInputError(
                "--invert board: the board's poses come from photos and are right"
            )
    if len(views.names) < 2:
        raise InvalidInputError(f"hand-eye: got {len(views.names)} views, expected at least 4")
    if options.invert == "tracker":
        views = replace(views, Ts_world_tracker=invert(views.Ts_world_tracker))
    return views


def _with_photos(
    poses: Mapping[str, np.ndarray], options: argparse.Namespace, say: Say
) -> PosedViews:
    if options.photos is None or options.board is None:
        raise InvalidInputError(
            f"{options.poses}: names photos, so --photos FOLDER and --board are needed too"
        )
    board = parse_board(options.board)
    check_unambiguous(board, options.board)
    paths = [options.photos / name for name in sorted(poses)]
    absent = [path.name for path in paths if not path.is_file()]
    if absent:
        raise NotFoundError(f"{options.photos}: has no photo {', '.join(absent[:5])}")
    lens, calibrated_px = read_lens(options.intrinsics or options.to, options.camera)
    photos = read_photos(paths, board)
    photos.tell_left_out(say)
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
    trackers = np.stack([poses[view.name] for view in photos.views])
    return replace(PosedViews.of(photos.views, trackers, lens), blurred=photos.blurred)
