"""`dextouch station calibrate` on folders: rendered boards, poses, gloves; advice, refusals."""

import csv
import json
from argparse import Namespace
from datetime import UTC, datetime, timedelta

import cv2
import numpy as np
import pytest

from benchmarks.simulated.board_scenes import mount_difference
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    ShapeError,
    UnknownNameError,
)
from dextouch.geometry import invert, pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor
from services.acquisition.devices import load_calibration
from services.acquisition.mocks.gloves import GloveCalibration
from services.alignment.station_calibration import record
from services.cli import main as command_line
from services.pipelines.calibrate import main
from services.pipelines.calibrate.show import show
from tests.unit.cli.rendered_boards import (
    BOARD,
    SIZE,
    K,
    good_views,
    write_photos,
)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder calibrated from 25 rendered photos, and the report."""
    root = tmp_path_factory.mktemp("camera")
    photos = write_photos(root / "photos", good_views())
    cv2.imwrite(str(photos / "empty.png"), np.full(SIZE[::-1], 128, dtype=np.uint8))
    arguments = ["--camera", "head", "--photos", str(photos), "--board", BOARD]
    report = root / "report.json"
    status = main(["camera", *arguments, "--to", str(root / "to"), "--json", str(report)])
    assert status == 0
    return root / "to", json.loads(report.read_text())


def test_camera_matrix_is_written_in_the_pixels_of_recordings(calibrated):
    folder, report = calibrated
    matrices = load_calibration(folder / "calibration.json")
    error = np.abs(np.array(matrices["K_head"]) - K)
    # A shift of half a pixel between the two conventions would be seen.
    assert error[:2, 2].max() < 0.2
    assert error[[0, 1], [0, 1]].max() < 0.5
    assert np.shape(matrices["K_head_sigma_px"]) == (1, 4)
    assert np.shape(matrices["distortion_head"]) == (1, 5)
    assert matrices["image_size_head_px"] == ((640.0, 480.0),)
    assert report["without_board"] == ["empty.png"]
    assert report["next"] == []
    details = json.loads((folder / "calibration_details.json").read_text())["K_head"]
    assert details["software"].startswith("dextouch ")
    for name in ("coverage_head.svg", "residuals_head.svg"):
        assert (folder / "pictures" / name).read_text().startswith("<svg")


def test_mount_is_found_from_photos_and_poses(calibrated, tmp_path):
    folder, _ = calibrated
    rng = np.random.default_rng(3)
    mount = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    views = good_views()[:16]
    views = [
        T @ transform(rotation_from_vector(np.array([0, 0, 0.4 * (i % 3 - 1)])), np.zeros(3))
        for i, T in enumerate(views)
    ]
    views = [T for T in views if np.abs(T[:2, 3]).max() < 0.2]
    T_world_board = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    trackers = [T_world_board @ invert(T) @ invert(mount) for T in views]
    photos = write_photos(tmp_path / "photos", views)
    with (tmp_path / "poses.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"])
        for index, T in enumerate(trackers):
            writer.writerow([f"photo_{index:02d}.png", *pose_from_transform(T)])
    arguments = [
        "--camera",
        "head",
        "--photos",
        str(photos),
        "--poses",
        str(tmp_path / "poses.csv"),
    ]
    status = main(["hand-eye", *arguments, "--board", BOARD, "--to", str(folder)])
    assert status == 0
    matrices = load_calibration(folder / "calibration.json")
    angle, distance = mount_difference(np.array(matrices["T_tracker_head_camera_head"]), mount)
    assert np.rad2deg(angle) < 0.1
    assert distance < 1e-3
    assert matrices["T_tracker_head_camera_head_sigma_m"][0][0] < 1e-3
    # The camera's own matrices stay beside the mount.
    assert "K_head" in matrices
    with pytest.raises(InvalidInputError, match="after half a turn"):
        main(["hand-eye", *arguments, "--board", "chessboard:8x6:25mm", "--to", str(folder)])
    with pytest.raises(NotFoundError, match="calibrate camera"):
        main(["hand-eye", *arguments, "--board", BOARD, "--to", str(tmp_path / "new")])


def pairs(seed, *, axes, num=20):
    rng = np.random.default_rng(seed)
    mount = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    turns = rng.normal(scale=0.6, size=(num, 3)) * np.array(axes)
    tracker = transform(rotation_from_vector(turns), rng.normal(scale=0.1, size=(num, 3)))
    board = invert(mount) @ invert(tracker) @ transform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    return np.stack([tracker, board], axis=1), mount


def test_poses_alone_give_the_mount_and_one_axis_is_refused_by_name(tmp_path, capsys):
    views, mount = pairs(0, axes=(1, 1, 1))
    (tmp_path / "poses.json").write_text(json.dumps(views.tolist()))
    arguments = ["hand-eye", "--camera", "wrist_left", "--to", str(tmp_path / "to"), "--poses"]
    assert main([*arguments, str(tmp_path / "poses.json")]) == 0
    found = load_calibration(tmp_path / "to/calibration.json")
    angle, distance = mount_difference(np.array(found["T_tracker_left_camera_wrist_left"]), mount)
    assert max(angle, distance) < 1e-6
    flat, _ = pairs(1, axes=(0, 0, 1))
    (tmp_path / "flat.json").write_text(json.dumps(flat.tolist()))
    capsys.readouterr()
    with pytest.raises(InvalidInputError, match="x and y"):
        main([*arguments, str(tmp_path / "flat.json")])
    said = capsys.readouterr().out
    assert "next: turn the camera left and right" in said
    assert "<svg" in (tmp_path / "to/pictures/hand_eye_wrist_left.svg").read_text()
    turned = views.copy()
    turned[:, 1] = invert(turned[:, 1])
    (tmp_path / "turned.json").write_text(json.dumps(turned.tolist()))
    with pytest.raises(InvalidInputError, match="inverted"):
        main([*arguments, str(tmp_path / "turned.json")])
    assert main([*arguments, str(tmp_path / "turned.json"), "--invert", "board"]) == 0


def test_broken_pose_files_are_refused_with_their_line(tmp_path):
    arguments = ["hand-eye", "--camera", "head", "--to", str(tmp_path / "to"), "--poses"]
    path = tmp_path / "poses.csv"
    header = "image,x_m,y_m,z_m,qw,qx,qy,qz\n"
    for text, words in (
        ("image,x\n", "columns"),
        (header + "a.jpg,0,0,0,1,0,0,zero\n", "line 2"),
        (header + "a.jpg,0,0,0,2,0,0,0\n", "length 2.000"),
        (header + 2 * "a.jpg,0,0,0,1,0,0,0\n", "twice"),
        (header + "a.jpg,0,0,0,1,0,0,0\n", "--photos"),
    ):
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=words):
            main([*arguments, str(path)])
    broken = tmp_path / "poses.json"
    for text, error, words in (
        ("{", InvalidInputError, "no JSON"),
        ("[]", ShapeError, "at least one"),
        ("[[[1, 0], [0, 1]]]", ShapeError, "expected"),
        ('[{"image": "a"}]', InvalidInputError, r"\[\[T_world_tracker"),
    ):
        broken.write_text(text)
        with pytest.raises(error, match=words):
            main([*arguments, str(broken)])
    with pytest.raises(NotFoundError):
        main([*arguments, str(tmp_path / "nothing.csv")])
    for data in (b"\xff\xfe\x00\x01", "image,größe\n".encode("latin-1")):
        path.write_bytes(data)
        with pytest.raises(InvalidInputError, match="no CSV in UTF-8"):
            main([*arguments, str(path)])


TRUTH = GloveCalibration.seeded("left", 4)


def write_take(path, kpa, *, seed=0, num=300, dead=()):
    rng = np.random.default_rng(seed)
    counts = TRUTH.counts(np.full((num, 320), kpa, dtype=float), side="left").astype(float)
    counts = np.rint(counts + rng.normal(scale=2.0, size=counts.shape)).clip(0, 65535)
    counts[:, list(dead)] = 0
    descriptor = StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(360,),
        dtype="uint16",
        unit="counts",
        nominal_rate_hz=60.0,
        side="left",
    )
    attributes = RecordingAttributes(
        recording_id=path.name,
        task="calibration",
        instruction="",
        domain="human",
        station="test",
        streams=(descriptor,),
    )
    spool = SpoolWriter(path, attributes, sync=False)
    t_ns = np.arange(num, dtype=np.int64) * 16_666_667
    batch = SampleBatch(t_ns, t_ns, np.arange(num, dtype=np.int64), counts.astype("<u2"))
    spool.append("tactile_left", batch)
    spool.close()
    return str(path)


def test_glove_from_spooled_takes(tmp_path, capsys):
    cell = 5
    rest = write_take(tmp_path / "rest", 0.0, dead=[cell])
    for index, kpa in enumerate((10.0, 20.0, 30.0)):
        write_take(tmp_path / f"press{index}", kpa, seed=index + 1, dead=[cell])
    # 0.204 kg on 1 cm² are 20 kPa.
    (tmp_path / "presses.csv").write_text(
        "take,pressure_kpa,mass_kg,area_cm2,pads,start_s,stop_s\n"
        "press0,10,,,all,,\n"
        f"press1,,{20.0 / 9.80665 * 0.1},1,thumb+index+middle+ring+little+palm,1,4\n"
        "press2,30,,,,,\n"
    )
    arguments = ["glove", "--side", "left", "--rest", rest, "--to", str(tmp_path / "to")]
    report = tmp_path / "report.json"
    presses = ["--presses", str(tmp_path / "presses.csv"), "--json", str(report)]
    assert main([*arguments, *presses]) == 0
    matrices = load_calibration(tmp_path / "to/calibration.json")
    gain, tare = (
        np.array(matrices[f"tactile_left_{name}"])[0]
        for name in ("gain_counts_per_kpa", "tare_counts")
    )
    known = np.array(matrices["tactile_left_taxel_state"])[0] == 0
    taxels = np.array(matrices["tactile_left_gain_sigma_counts_per_kpa"])[0] > 0
    gain_error = gain / TRUTH.gain_counts_per_kpa - 1
    assert np.abs(gain_error[known & taxels]).max() < 0.01
    others = np.delete(np.arange(360), cell)
    assert np.abs(tare - TRUTH.tare_counts)[others].max() < 0.7
    assert np.flatnonzero(~known).tolist() == [cell]
    assert json.loads(report.read_text())["num_by_state"] == {"ok": 319, "dead": 1}
    assert "dead: 1 taxels" in capsys.readouterr().out
    # A tare alone, later, leaves the gain as it was.
    assert main(arguments) == 0
    again = load_calibration(tmp_path / "to/calibration.json")
    assert again["tactile_left_gain_counts_per_kpa"] == matrices["tactile_left_gain_counts_per_kpa"]
    assert "the gain, if there is one, stays" in capsys.readouterr().out


def test_broken_lists_of_presses_are_refused(tmp_path):
    rest = write_take(tmp_path / "rest", 0.0)
    arguments = ["glove", "--side", "left", "--rest", rest, "--to", str(tmp_path / "to")]
    path = tmp_path / "presses.csv"
    for text, error, words in (
        ("take,kilos\nrest,1\n", InvalidInputError, "kilos"),
        ("take,pressure_kpa\n", InvalidInputError, "no press"),
        ("take,pressure_kpa\nrest,\n", InvalidInputError, "line 2"),
        ("take,pressure_kpa\nrest,much\n", InvalidInputError, "line 2"),
        ("take,pressure_kpa,mass_kg\nrest,1,1\n", InvalidInputError, "one of the two"),
        ("take,pressure_kpa\nnowhere,10\n", NotFoundError, "nowhere"),
        ("take,pressure_kpa,pads\nrest,10,toe\n", UnknownNameError, "palm"),
        ("take,pressure_kpa\nrest,10\n", InvalidInputError, "no pressed taxel moved"),
    ):
        path.write_text(text)
        with pytest.raises(error, match=words):
            main([*arguments, "--presses", str(path)])
    path.write_bytes(b"take,pressure_kpa\nr\xe9st,1\n")
    with pytest.raises(InvalidInputError, match="no CSV in UTF-8"):
        main([*arguments, "--presses", str(path)])
    with pytest.raises(NotFoundError, match="tactile_right"):
        main(["glove", "--side", "right", "--rest", rest, "--to", str(tmp_path / "to")])
    # Nothing was written by any of them.
    assert not (tmp_path / "to/calibration.json").exists()


def test_show_warns_after_seven_days_and_names_what_is_missing(calibrated, tmp_path, capsys):
    folder, _ = calibrated
    options = Namespace(folder=folder)
    fresh = {f["name"]: f for f in show(options)["findings"]}
    assert fresh["K_head"]["level"] == "OK"
    later = show(options, now=datetime.now(UTC) + timedelta(days=7, minutes=1))
    old = {f["name"]: f for f in later["findings"]}
    assert old["K_head"]["level"] == "WARN"
    assert "7 days old" in old["K_head"]["reasons"][0]
    record.write_entry(
        tmp_path,
        "tactile_left_tare",
        {"tactile_left_tare_counts": np.ones((1, 360))},
        {},
    )
    capsys.readouterr()
    assert main(["show", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "missing: K_head" in said
    assert "missing: tactile_left_gain_counts_per_kpa" in said
    with pytest.raises(NotFoundError, match="no calibration there"):
        main(["show", str(tmp_path / "nowhere")])
    assert command_line.main(["station", "calibrate", "show", str(tmp_path)]) == 1


def test_show_reads_what_a_take_carries(tmp_path):
    descriptor = StreamDescriptor(
        name="head", kind="pose", shape=(7,), dtype="float64", unit="m", nominal_rate_hz=100.0
    )
    attributes = RecordingAttributes(
        recording_id="take",
        task="t",
        instruction="",
        domain="human",
        station="s",
        calibration={
            "K_head": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            "tactile_left_cells": (tuple(map(float, range(320))),),
        },
        streams=(descriptor,),
    )
    SpoolWriter(tmp_path / "take", attributes, sync=False).close()
    report = show(Namespace(folder=tmp_path / "take"))
    assert report["level"] == "WARN"
    (reasons,) = (finding["reasons"] for finding in report["findings"])
    assert list(reasons) == ["age unknown; calibrate again with this command", "sigma unknown"]


def test_show_prints_json_last_and_says_whence_what_it_does_not_measure(tmp_path, capsys):
    matrices = {
        "head_latency_ns": ((2e6,),),
        "T_tracker_left_wrist_left": np.eye(4).tolist(),
        "K_head": np.eye(3).tolist(),
    }
    (tmp_path / "calibration.json").write_text(json.dumps(matrices))
    main(["show", str(tmp_path), "--json", "-"])
    said = capsys.readouterr().out
    report = json.loads(said[said.index("\n{") :])
    told = {f["name"]: f["reasons"][0] for f in report["findings"]}
    assert "latency_ms" in told["head_latency_ns"]
    assert "sits on its tracker" in told["T_tracker_left_wrist_left"]
    assert told["K_head"] == "age unknown; calibrate again with this command"
    (tmp_path / "calibration.json").write_text('{"K_head": "no matrix"}')
    with pytest.raises(CorruptDataError, match="no JSON of named matrices") as refused:
        main(["show", str(tmp_path)])
    assert "http" not in refused.value.message


def test_photos_of_two_sizes_and_no_photos_are_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    arguments = ["camera", "--camera", "head", "--photos", str(tmp_path / "photos")]
    arguments += ["--board", BOARD, "--to", str(tmp_path / "to")]
    with pytest.raises(NotFoundError, match="no photo"):
        main(arguments)
    cv2.imwrite(str(tmp_path / "photos/a.png"), np.zeros((480, 640), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "photos/b.png"), np.zeros((240, 320), dtype=np.uint8))
    with pytest.raises(InvalidInputError, match=r"b\.png"):
        main(arguments)
