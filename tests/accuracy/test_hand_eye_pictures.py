"""The mount found from pictures of a board and noisy poses, against the true one."""

import csv
import json
import sys

import cv2
import numpy as np
import pytest

from benchmarks.simulated.board_scenes import mount_difference
from dextouch.geometry import invert, pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.acquisition.devices import load_calibration
from services.alignment.calibration.hand_eye import project
from services.alignment.calibration.intrinsics import edge_width_px
from services.alignment.calibration.motion import move
from services.alignment.station_calibration.boards import find_board, parse_board
from services.alignment.station_calibration.record import write_entry
from services.pipelines.calibrate import main
from tests.unit.cli.rendered_boards import (
    CHARUCO,
    CHARUCO_K,
    CHARUCO_SIZE,
    DISTORTION,
    CharucoCamera,
    board_filling_the_image,
    charuco_views,
    smeared,
)

NUM_VIEWS = 20
TRACKER_DEG, TRACKER_M = 0.05, 5e-4
# Of a single run: twice the bounds of the median over seeds.
MAX_DEG, MAX_MM = 2 * 0.06, 2 * 0.8


@pytest.fixture(scope="module")
def camera():
    return CharucoCamera()


def given_lens(folder):
    write_entry(
        folder,
        "K_head",
        {
            "K_head": CHARUCO_K,
            "distortion_head": DISTORTION,
            "image_size_head_px": np.array(CHARUCO_SIZE, dtype=float),
        },
        {},
    )


@pytest.mark.long
def test_mount_from_pictures_with_blurred_and_moving_views(camera, tmp_path, capsys):
    rng = np.random.default_rng(5)
    mount = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    T_world_board = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    views = [
        *charuco_views(rng, NUM_VIEWS + 2),
        *[board_filling_the_image(turn) for turn in (0.1, -0.1)],
    ]
    noise = rng.normal(size=(len(views), 6)) * ([np.deg2rad(TRACKER_DEG)] * 3 + [TRACKER_M] * 3)
    trackers = T_world_board @ invert(np.array(views)) @ invert(mount) @ move(noise)
    # Two pictures are of another moment than their poses, in two the camera moved.
    moving, blurred = ("view_20.png", "view_21.png"), ("view_22.png", "view_23.png")
    trackers[20:22] = trackers[20:22] @ transform(
        rotation_from_vector(np.array([0.0, np.deg2rad(3.0), 0.0])), np.array([0.02, 0.0, 0.01])
    )
    (tmp_path / "photos").mkdir()
    with (tmp_path / "poses.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"])
        for index, (view, tracker) in enumerate(zip(views, trackers, strict=True)):
            name = f"view_{index:02d}.png"
            photo = camera.render(view)
            photo = smeared(photo, (6.0, 0.0)) if name in blurred else photo
            cv2.imwrite(str(tmp_path / "photos" / name), photo)
            writer.writerow([name, *pose_from_transform(tracker)])
    given_lens(tmp_path / "to")
    arguments = ["--photos", str(tmp_path / "photos"), "--poses", str(tmp_path / "poses.csv")]
    arguments += ["--board", CHARUCO, "--to", str(tmp_path / "to")]
    report_path = tmp_path / "report.json"
    assert main(["hand-eye", "--camera", "head", *arguments, "--json", str(report_path)]) == 0
    said = capsys.readouterr().out
    report = json.loads(report_path.read_text())
    found = load_calibration(tmp_path / "to/calibration.json")
    name = "T_tracker_head_camera_head"
    angle_rad, distance_m = mount_difference(np.array(found[name]), mount)
    sigma_rad, sigma_m = found[f"{name}_sigma_rad"][0][0], found[f"{name}_sigma_m"][0][0]
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye from pictures: {np.rad2deg(angle_rad):.3f} deg, bound {MAX_DEG} | "
            f"{distance_m * 1e3:.2f} mm, bound {MAX_MM} | error in sigmas "
            f"{angle_rad / sigma_rad:.1f} and {distance_m / sigma_m:.1f}, bound 3"
        )
    assert tuple(report["blurred"]) == blurred
    assert tuple(report["left_out"]) == moving
    assert all(f"{view} is blurred" in said for view in blurred)
    assert all(f"{view} is far off" in said for view in moving)
    assert report["num_views"] == NUM_VIEWS + 2
    assert np.rad2deg(angle_rad) <= min(MAX_DEG, 3 * np.rad2deg(sigma_rad))
    assert distance_m * 1e3 <= min(MAX_MM, 3e3 * sigma_m)


def test_corners_of_sharp_pictures_are_where_they_are(camera, capsys):
    board, errors = parse_board(CHARUCO), []
    for T in charuco_views(np.random.default_rng(1), 6):
        view = find_board("", camera.render(T), board)
        points = view.points_board[None].astype(float)
        true, _ = project(points, T[None], CHARUCO_K, DISTORTION)
        # OpenCV counts pixels from the middle of the first.
        errors.append(view.pixels + 0.5 - true[0])
        assert not view.is_blurred
    off_px = np.concatenate(errors)
    rms_px = np.sqrt(np.mean(off_px**2))
    with capsys.disabled():
        sys.stdout.write(f"\ncorners of sharp pictures: {rms_px:.3f} px RMS, bound 0.1")
    assert rms_px <= 0.1
    assert np.abs(off_px.mean(axis=0)).max() <= 0.02


@pytest.mark.long
@pytest.mark.parametrize("shift_px", [(6.0, 0.0), (0.0, 6.0), (4.5, 4.5)])
def test_pictures_of_a_moving_board_are_blurred(camera, shift_px):
    board = parse_board(CHARUCO)
    photo = camera.render(board_filling_the_image(0.1))
    sharp = find_board("", photo, board)
    moved = find_board("", smeared(photo, shift_px), board)
    assert (sharp.is_blurred, moved.is_blurred) == (False, True)
    widths_px = [
        edge_width_px(image, view.points_board, view.pixels)
        for image, view in ((photo, sharp), (smeared(photo, shift_px), moved))
    ]
    assert widths_px[1] > widths_px[0] + 1.5
    # Four times the width and height: the same angles, so the same verdict.
    larger = cv2.resize(photo, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    assert not find_board("", larger, board).is_blurred
    # Corners of a row alone tell of the edges along it.
    row = sharp.points_board[:, 1] == sharp.points_board[0, 1]
    assert edge_width_px(photo, sharp.points_board[row], sharp.pixels[row]) < 3
