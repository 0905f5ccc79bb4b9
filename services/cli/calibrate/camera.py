"""Command `dextouch station calibrate camera`: intrinsics from photos of a board."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dextouch.errors import NotFoundError
from services.alignment.calibration.intrinsics import CameraCalibration, calibrate_found
from services.cli.calibrate.advice import Coverage, camera_coverage
from services.cli.calibrate.boards import (
    SUFFIXES,
    BoardView,
    Lens,
    Photos,
    parse_board,
    photo_paths,
    read_photos,
    reprojection,
)
from services.cli.calibrate.pictures import coverage_picture, residual_picture
from services.cli.calibrate.record import named_matrix, read_matrices, write_entry, write_picture

# OpenCV's pixel origin is the centre of the first pixel, DexTouch's its corner.
PIXEL_SHIFT_PX = 0.5


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case."""
    paths = photo_paths(options.photos)
    if not paths:
        raise NotFoundError(f"{options.photos}: holds no photo; expected {', '.join(SUFFIXES)}")
    photos = read_photos(paths, parse_board(options.board))
    coverage, path = write_coverage(photos.views, photos.size_px, options.to, options.camera)
    print(f"board found in {len(photos.views)} of {len(photos)} photos ({photos.pattern})")
    photos.tell_left_out()
    for words in coverage.todo:
        print(f"next: {words}")
    print(f"coverage: {path}")
    report: dict[str, object] = {
        "num_photos": len(photos),
        "num_with_board": len(photos.views),
        "without_board": list(photos.without_board),
        "blurred": list(photos.blurred),
        "board_kind": photos.pattern,
        "views_by_region": coverage.views_by_region.tolist(),
        "next": list(coverage.todo),
    }
    if options.check:
        return report
    result = calibrate_found(photos.corners())
    lens = Lens(result.K, result.distortion)
    coverage, _ = write_coverage(photos.views, photos.size_px, options.to, options.camera, lens)
    residuals = [reprojection(view, lens) for view in photos.views]
    picture = residual_picture(photos.views, residuals, photos.size_px)
    write_picture(options.to, f"residuals_{options.camera}.svg", picture)
    return report | _keep(result, photos, coverage, options)


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
    result: CameraCalibration, photos: Photos, coverage: Coverage, options: argparse.Namespace
) -> dict[str, object]:
    K, sigma = result.K.copy(), result.sigma_fxfycxcy_px
    K[:2, 2] += PIXEL_SHIFT_PX
    fx, fy, cx, cy = (float(v) for v in K[[0, 1, 0, 1], [0, 1, 2, 2]])
    name = f"K_{options.camera}"
    facts: dict[str, object] = {
        "camera": options.camera,
        "board": asdict(parse_board(options.board)),
        "num_views": len(result.used_images),
        "fx_fy_cx_cy_px": [fx, fy, cx, cy],
        "sigma_fx_fy_cx_cy_px": sigma.tolist(),
        "distortion_k1_k2_p1_p2_k3": result.distortion.tolist(),
        "sigma_distortion": result.sigma_distortion.tolist(),
        "rms_px": result.rms_px,
        "board_kind": photos.pattern,
        "image_size_px": list(photos.size_px),
        "next": list(coverage.todo),
    }
    matrices = {
        name: K,
        f"{name}_sigma_px": sigma,
        f"distortion_{options.camera}": result.distortion,
        f"image_size_{options.camera}_px": np.array(photos.size_px, dtype=np.float64),
    }
    write_entry(options.to, name, matrices, facts)
    print(
        f"{name}: fx {fx:.2f} ± {sigma[0]:.2f}, fy {fy:.2f} ± {sigma[1]:.2f}, "
        f"cx {cx:.2f} ± {sigma[2]:.2f}, cy {cy:.2f} ± {sigma[3]:.2f} px "
        f"({len(result.used_images)} views, residual {result.rms_px:.3f} px RMS)"
    )
    return facts


def read_lens(folder: Path, camera: str) -> tuple[Lens, tuple[int, int]]:
    """OpenCV's lens of a calibrated camera, and width and height of its images (px)."""
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
