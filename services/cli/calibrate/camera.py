"""Command `dextouch station calibrate camera`: intrinsics from photos of a board."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dextouch.command_line import progress
from dextouch.errors import NotFoundError
from services.alignment.calibration.board_detection import FoundBoards
from services.alignment.calibration.intrinsics import CameraCalibration, calibrate_found
from services.cli.calibrate.advice import Coverage, camera_coverage
from services.cli.calibrate.boards import (
    Board,
    BoardView,
    Lens,
    board_pose,
    find_board,
    parse_board,
    reprojection,
    usual_pattern,
)
from services.cli.calibrate.photos import photo_paths, read_photos
from services.cli.calibrate.pictures import coverage_picture, residual_picture
from services.cli.calibrate.record import named_matrix, read_matrices, write_entry, write_picture

# OpenCV's pixel origin is the centre of the first pixel, DexTouch's its corner.
PIXEL_SHIFT_PX = 0.5


@dataclass(frozen=True)
class Found:
    """Photos of a folder with a detected board; blurred ones are excluded and listed."""

    views: tuple[BoardView, ...]
    without_board: tuple[str, ...]
    blurred: tuple[str, ...]
    size_px: tuple[int, int]
    board_kind: str

    @property
    def num_photos(self) -> int:
        """Number of all photos."""
        return len(self.views) + len(self.without_board) + len(self.blurred)


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case.

    Raises:
        InvalidInputError: too few photos with the board, or insufficient coverage.
        NotFoundError, CorruptDataError: missing or damaged photos.
    """
    board = parse_board(options.board)
    found = find_boards(photo_paths(options.photos), board)
    report = report_coverage(found, options.to, options.camera)
    if options.check:
        return report
    views = found.views
    result = calibrate_found(corners_of(found))
    lens = Lens(result.K, result.distortion)
    residuals = [reprojection(view, lens, board_pose(view, lens)) for view in views]
    coverage, _ = write_coverage(views, found.size_px, options.to, options.camera, lens)
    write_picture(
        options.to,
        f"residuals_{options.camera}.svg",
        residual_picture(views, residuals, found.size_px),
    )
    return report | _keep(result, coverage, options, found)


def find_boards(paths: Sequence[Path], board: Board) -> Found:
    """Read photos and find the board in each, with a progress bar.

    Raises:
        InvalidInputError: photos of different sizes.
    """
    photos = read_photos(paths)
    seen = [
        find_board(path.name, photo, board)
        for path, photo in progress(
            zip(paths, photos, strict=True), "looking for the board", len(paths)
        )
    ]
    pattern = usual_pattern([view for view in seen if view is not None])
    found = [view for view in seen if view is not None and view.pattern == pattern]
    names = {view.name for view in found}
    height_px, width_px = photos[0].shape
    return Found(
        tuple(view for view in found if not view.is_blurred),
        tuple(path.name for path in paths if path.name not in names),
        tuple(view.name for view in found if view.is_blurred),
        (width_px, height_px),
        pattern,
    )


def corners_of(found: Found) -> FoundBoards:
    """Convert the corners to the solver's input."""
    return FoundBoards(
        tuple(view.points_board for view in found.views),
        tuple(view.pixels for view in found.views),
        found.size_px,
        tuple(range(len(found.views))),
        found.num_photos,
        found.board_kind,
    )


def report_coverage(found: Found, folder: Path, camera: str) -> dict[str, object]:
    """Print and draw the coverage of the photos, and return it as data."""
    coverage, path = write_coverage(found.views, found.size_px, folder, camera)
    print(f"board found in {len(found.views)} of {found.num_photos} photos ({found.board_kind})")
    tell_left_out(found)
    for words in coverage.todo:
        print(f"next: {words}")
    print(f"coverage: {path}")
    return {
        "num_photos": found.num_photos,
        "num_with_board": len(found.views),
        "without_board": list(found.without_board),
        "blurred": list(found.blurred),
        "board_kind": found.board_kind,
        "views_by_region": coverage.views_by_region.tolist(),
        "next": list(coverage.todo),
    }


def tell_left_out(found: Found) -> None:
    """List the excluded photos with the reasons."""
    for name in found.without_board:
        print(f"  no board in {name}: left out")
    for name in found.blurred:
        print(f"  {name} is blurred: left out; hold camera and board still, or give it more light")


def write_coverage(
    views: Sequence[BoardView],
    size_px: tuple[int, int],
    folder: Path,
    camera: str,
    lens: Lens | None = None,
) -> tuple[Coverage, Path]:
    """Coverage by these views, and the path of its picture; arguments as `camera_coverage`."""
    coverage = camera_coverage(views, size_px, lens)
    picture = coverage_picture(views, coverage, size_px)
    return coverage, write_picture(folder, f"coverage_{camera}.svg", picture)


def _keep(
    result: CameraCalibration,
    coverage: Coverage,
    options: argparse.Namespace,
    found: Found,
) -> dict[str, object]:
    K = result.K.copy()
    K[:2, 2] += PIXEL_SHIFT_PX
    name = f"K_{options.camera}"
    facts: dict[str, object] = {
        "camera": options.camera,
        "board": asdict(parse_board(options.board)),
        "num_views": len(result.used_images),
        "fx_fy_cx_cy_px": [float(v) for v in K[[0, 1, 0, 1], [0, 1, 2, 2]]],
        "sigma_fx_fy_cx_cy_px": result.sigma_fxfycxcy_px.tolist(),
        "distortion_k1_k2_p1_p2_k3": result.distortion.tolist(),
        "sigma_distortion": result.sigma_distortion.tolist(),
        "rms_px": result.rms_px,
        "board_kind": found.board_kind,
        "image_size_px": list(found.size_px),
        "next": list(coverage.todo),
    }
    matrices = {
        name: K,
        f"{name}_sigma_px": result.sigma_fxfycxcy_px,
        f"distortion_{options.camera}": result.distortion,
        f"image_size_{options.camera}_px": np.array(found.size_px, dtype=np.float64),
    }
    write_entry(options.to, name, matrices, facts)
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    sigma = result.sigma_fxfycxcy_px
    print(
        f"{name}: fx {fx:.2f} ± {sigma[0]:.2f}, fy {fy:.2f} ± {sigma[1]:.2f}, "
        f"cx {cx:.2f} ± {sigma[2]:.2f}, cy {cy:.2f} ± {sigma[3]:.2f} px "
        f"({len(result.used_images)} views, residual {result.rms_px:.3f} px RMS)"
    )
    return facts


def read_lens(folder: Path, camera: str) -> tuple[Lens, tuple[int, int]]:
    """OpenCV's lens of a calibrated camera, and width and height of its images (px).

    Raises:
        NotFoundError: the camera is not calibrated in this folder.
        InvalidInputError: a matrix of another shape.
    """
    try:
        matrices = read_matrices(folder)
        K = named_matrix(matrices, f"K_{camera}", (3, 3))
        distortion = named_matrix(matrices, f"distortion_{camera}", (1, 5))
        width_px, height_px = named_matrix(matrices, f"image_size_{camera}_px", (1, 2))[0]
    except NotFoundError as error:
        raise NotFoundError(
            f"{error.message}. First: dextouch station calibrate camera --camera {camera} "
            f"--to {folder} …"
        ) from error
    K[:2, 2] -= PIXEL_SHIFT_PX
    return Lens(K, distortion[0]), (int(width_px), int(height_px))
