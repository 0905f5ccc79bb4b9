"""What `dextouch station calibrate` makes of each view: advice, poses, live images, boards."""

import json
import re
from argparse import Namespace
from itertools import count
from types import SimpleNamespace
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest

from benchmarks.simulated.board_scenes import mount_difference
from dextouch.clients import HttpLink
from dextouch.errors import (
    InvalidInputError,
    NotFoundError,
    StaleDataError,
    UnknownNameError,
)
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.streams import pack
from services.alignment.station_calibration import boards, mount
from services.alignment.station_calibration import camera_views as camera
from services.pipelines.calibrate import main
from tests.unit.cli.rendered_boards import (
    BOARD,
    SIZE,
    K,
    board_at,
    good_views,
    render,
    smeared,
    write_photos,
)


@pytest.mark.parametrize(
    ("views", "words"),
    [
        ([], "in front of the camera"),
        ([board_at([-0.15, -0.1, 0.5], [0, 0, 0])] * 2, "lower right"),
        ([board_at([0, 0, 0.5], [0, 0.5, 0])] * 2, "left edge nearer|right edge nearer"),
    ],
)
def test_advice_names_what_is_missing(views, words):
    board = boards.parse_board(BOARD)
    found = [boards.find_board(str(i), render(view), board) for i, view in enumerate(views)]
    todo = "; ".join(boards.camera_coverage(found, SIZE).todo)
    assert re.search(words, todo)


@pytest.mark.long
def test_advice_asks_for_the_edges_and_for_more_only_when_all_else_is_there():
    board = boards.parse_board(BOARD)
    views = [boards.find_board(str(i), render(T), board) for i, T in enumerate(good_views())]
    assert boards.camera_coverage(views, SIZE).todo == ()
    assert boards.camera_coverage(views[:24], SIZE).todo == (
        "take 1 more photos, each from another direction",
    )
    inner = [v for v in views if v.pixels[:, 0].max() < 0.84 * SIZE[0]]
    todo = boards.camera_coverage(inner, SIZE).todo
    assert any("right" in words and "left," not in words for words in todo)


@pytest.mark.parametrize(
    ("turn", "nearer"),
    [
        ([0, 0.5, 0], "right"),
        ([0, -0.5, 0], "left"),
        ([0.5, 0, 0], "upper"),
        ([-0.5, 0, 0], "lower"),
    ],
)
def test_tilts_are_told_apart(turn, nearer):
    """Which edge is nearer follows from the depth of the board's own edges."""
    T = board_at([0, 0, 0.5], turn)
    edges = {
        "left": [0, 0.06, 0],
        "right": [0.2, 0.06, 0],
        "upper": [0.1, 0, 0],
        "lower": [0.1, 0.125, 0],
    }
    depth = {name: (T[:3, :3] @ np.array(p) + T[:3, 3])[2] for name, p in edges.items()}
    really = min(depth, key=depth.get)
    view = boards.find_board("", render(T), boards.parse_board(BOARD))
    tilt = boards.camera_coverage([view], SIZE).tilts_rad[0]
    said = max(boards.TILTS, key=lambda words: float(tilt @ np.array(boards.TILTS[words])))
    assert really in said
    assert really == nearer
    assert abs(np.linalg.norm(tilt) - 0.5) < 0.05


@pytest.mark.parametrize("roll_rad", [0.0, 1.5, np.pi, -2.5])
def test_a_chessboard_is_never_taken_for_its_half_turn(roll_rad):
    T = board_at([0, 0, 0.5], [0, 0, 0])
    about = transform(np.eye(3), np.array([0, 0, 0.5]))
    turn = transform(rotation_from_vector(np.array([0.3, 0.0, 0.0])), np.zeros(3)) @ transform(
        rotation_from_vector(np.array([0.0, 0.0, roll_rad])), np.zeros(3)
    )
    T = about @ turn @ invert(about) @ T
    view = boards.find_board("", render(T), boards.parse_board(BOARD))
    middle = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    angle, distance = mount_difference(boards.board_pose(view, boards.Lens(middle, np.zeros(5))), T)
    assert np.rad2deg(angle) < 0.3
    assert distance < 1e-3


def new_session(tmp_path, live=None):
    return camera.Session(Namespace(board=BOARD, to=tmp_path / "to", camera="head"), live)


def jpeg(T):
    return cv2.imencode(".jpg", render(T), [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def test_live_views_are_kept_only_when_still_and_new(tmp_path):
    here, there = board_at([-0.1, 0, 0.5], [0, 0.4, 0]), board_at([0.1, 0, 0.5], [0, -0.4, 0])
    moving = board_at([0, 0, 0.5], [0, 0, 0])
    images = [jpeg(T) for T in (here, here, here, moving, there, there)]
    session = new_session(tmp_path, tmp_path / "photos")
    session.collect((f"live {index}", data) for index, data in enumerate(images))
    assert len(session.views) == 2
    kept = sorted((tmp_path / "photos").glob("*.jpg"))
    assert [path.read_bytes() for path in kept] == [images[1], images[5]]
    assert not session.is_enough
    assert (tmp_path / "to/pictures/coverage_head.svg").is_file()


@pytest.mark.long
@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((270, 480), 128, np.uint8), "no board in the last image"),
        (render(board_at([0.0, 0, 0.5], [0, 0.4, 0])), "hold it elsewhere"),
    ],
)
def test_live_images_that_add_nothing_are_told_now_and_then(image, words, tmp_path, capsys):
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
    session = new_session(tmp_path, tmp_path / "photos")
    num_images = 2 * camera.TELL_AFTER_IMAGES + 3
    session.collect((f"{i}", data) for i in range(num_images))
    assert capsys.readouterr().out.count(words) == 2


@pytest.mark.long
def test_a_watched_folder_is_read_once_and_left_when_the_views_suffice(tmp_path):
    views = good_views()
    photos = write_photos(tmp_path / "photos", views[:10])
    session = new_session(tmp_path)
    waits, later = count(), iter(range(10, 25))

    def wait(_):
        next(waits)
        index = next(later)
        cv2.imwrite(str(photos / f"photo_{index:02d}.png"), render(views[index]))

    session.collect(camera.folder_arrivals(photos, wait=wait))
    assert session.is_enough
    assert [view.name for view in session.views] == [f"photo_{i:02d}.png" for i in range(25)]
    assert next(waits) == 15


def test_blurred_photos_are_named_and_do_not_count(tmp_path, capsys):
    photo = render(board_at([0, 0, 0.4], [0, 0, 0]))
    pair = [cv2.imencode(".png", image)[1].tobytes() for image in (photo, smeared(photo, (6, 0)))]
    named = list(zip(("sharp", "moved"), pair, strict=True))
    session = new_session(tmp_path)
    session.collect(iter(named))
    assert [view.name for view in session.views] == ["sharp"]
    assert "moved: blurred, left out" in capsys.readouterr().out
    # The board stands still, but the image is blurred all the same: out of focus, say.
    still = iter([("a", pair[1]), ("b", pair[1])])
    live = new_session(tmp_path, tmp_path / "live")
    live.collect(still)
    assert live.views == []
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, data in named:
        (photos / f"{name}.png").write_bytes(data)
    arguments = ["camera", "--camera", "head", "--photos", str(photos), "--board", BOARD]
    report = tmp_path / "report.json"
    assert main([*arguments, "--check", "--to", str(tmp_path), "--json", str(report)]) == 0
    told = json.loads(report.read_text())
    assert (told["blurred"], told["num_with_board"], told["num_photos"]) == (["moved.png"], 1, 2)


def health_of(*names):
    known = {"device": "d", "level": "OK", "reasons": [], "rate_hz": None, "nominal_rate_hz": 30.0}
    known |= {"age_s": None, "received": 0, "lost": 0}
    streams = [known | {"stream": name} for name in names]
    return json.dumps(
        {"station": "desk", "level": "OK", "streams": streams, "devices": []}
    ).encode()


def test_station_images_come_once_each_and_pauses_are_no_images():
    bodies = [b"a", b"a", StaleDataError("the newest image is 1 s old"), b"b"]
    replies = [one if isinstance(one, Exception) else SimpleNamespace(body=one) for one in bodies]
    replies.insert(0, SimpleNamespace(body=health_of("camera_head")))
    link = create_autospec(HttpLink, instance=True)
    link.request.side_effect = replies
    arrivals = camera.station_arrivals(link, "head", wait=lambda _: None)
    assert [next(arrivals)[1], next(arrivals)[1]] == [b"a", b"b"]


@pytest.mark.parametrize("of_mount", [False, True])
def test_a_run_waits_half_a_minute_for_the_first_image_of_a_camera(of_mount):
    no_pose = SimpleNamespace(body=pack({"late_s": {"head": 0.2}}, {}))
    size = {"height_px": 4, "width_px": 4, "image_index": 1, "age_s": 0.0}
    cameras = {"cameras": [size | {"name": "camera_head", "late_s": 0.7}]}
    waited_s, num_late = [], 20

    def request(method, path, **options):
        if path == "/v1/health":
            return SimpleNamespace(body=health_of("camera_head"))
        if path.startswith("/v1/live/poses"):
            return no_pose
        if path == "/v1/live/cameras":
            return SimpleNamespace(body=json.dumps(cameras).encode())
        if len(waited_s) < num_late:
            raise NotFoundError("camera 'camera_head': not there, or no image yet")
        return SimpleNamespace(body=b"a")

    link = create_autospec(HttpLink, instance=True)
    link.request.side_effect = request
    newest = mount.station_sightings if of_mount else camera.station_arrivals
    first = next(newest(link, "head", wait=waited_s.append))
    assert (first.image if of_mount else first[1]) == b"a"
    assert not of_mount or first.late_s == 0.7
    assert len(waited_s) == num_late
    num_late = 10_000
    waited_s.clear()
    with pytest.raises(NotFoundError, match="no image yet"):
        next(newest(link, "head", wait=waited_s.append))
    assert sum(waited_s) == pytest.approx(30.0)


@pytest.mark.parametrize("of_mount", [False, True])
def test_a_camera_that_a_station_does_not_have_is_said_at_once(of_mount):
    waited_s, link = [], create_autospec(HttpLink, instance=True)
    link.request.return_value = SimpleNamespace(body=health_of("camera_head", "wrist_left"))
    newest = mount.station_sightings if of_mount else camera.station_arrivals
    with pytest.raises(NotFoundError, match="no such camera; it has: head"):
        next(newest(link, "haed", wait=waited_s.append))
    assert (waited_s, link.request.call_count) == ([], 1)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("chessboard:9x6", InvalidInputError),
        ("chessboard:9:25mm", InvalidInputError),
        ("chessboard:9x6:25", InvalidInputError),
        ("charuco:5x7:30mm", InvalidInputError),
        ("dots:5x7:30mm", UnknownNameError),
        ("charuco:5x7:30mm:22mm:DICT_1", UnknownNameError),
    ],
)
def test_board_descriptions_are_checked(text, error):
    with pytest.raises(error):
        boards.parse_board(text)
    assert boards.parse_board("charuco:5x7:3cm:22mm").square_m == pytest.approx(0.03)
