"""Places of a mount's run: which live images are kept, dropped, and found again later."""

from argparse import Namespace

import cv2
import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NotFoundError
from services.acquisition.mocks import pattern
from services.alignment.station_calibration import mount
from services.alignment.station_calibration.mount import (
    MountSession,
    Sighting,
    num_kept_places,
)
from services.alignment.station_calibration.record import poses_of_photos, write_entry

POSES = [
    np.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.5]),
    np.array([-0.3, 0.1, 0.0, 0.02, 0.0, 0.55]),
    np.array([0.0, 0.35, -0.1, 0.0, 0.02, 0.6]),
]


@pytest.fixture(scope="module")
def images():
    """JPEGs of the board at POSES, rendered by the mock camera."""
    rays = pattern._rays()
    grey = (pattern.render(pose, rays).round().astype(np.uint8) for pose in POSES)
    return [cv2.imencode(".jpg", one)[1].tobytes() for one in grey]


def tracker(index):
    """T_world_tracker at which the practice camera sees the board at POSES[index]."""
    seen = pattern.board_pose(POSES[index])
    return pattern.T_WORLD_BOARD @ np.linalg.inv(pattern.T_TRACKER_CAMERA @ seen)


@pytest.fixture
def options(tmp_path):
    lens = {
        "K_head": pattern.K,
        "distortion_head": np.array([*pattern.DISTORTION, 0.0]),
        "image_size_head_px": np.array([480.0, 360.0]),
    }
    write_entry(tmp_path / "to", "K_head", lens, {})
    photos = tmp_path / "to" / "photos" / "mount-head"
    given = {"camera": "head", "board": "chessboard:9x6:25mm", "to": tmp_path / "to"}
    return Namespace(**given, photos=photos)


def show(session, image, index, times=2):
    T = tracker(index)
    for _ in range(times):
        session.add(Sighting(image, T, T))


def test_a_place_is_kept_once_when_board_and_tracker_are_still(options, images):
    session = MountSession(options)
    show(session, images[0], 0, times=1)
    assert (session.num_kept, session.is_still) == (0, False)
    assert "hold still" in session.hint
    show(session, images[0], 0, times=1)
    assert (session.num_kept, session.hint) == (1, "")
    show(session, images[0], 0)
    assert session.num_kept == 1
    assert "this place is kept" in session.hint
    # The image changes, then the tracker alone: both are motion.
    show(session, images[1], 1, times=1)
    assert session.num_kept == 1
    swayed = tracker(1)
    swayed[0, 3] += 0.003
    session.add(Sighting(images[1], tracker(1), swayed))
    assert (session.num_kept, session.is_still) == (1, False)
    show(session, images[1], 1)
    assert session.num_kept == 2
    assert session.progress.num_places == 2


def test_an_image_of_another_moment_than_the_pose_is_not_kept(options, images):
    session = MountSession(options)
    for _ in range(3):
        session.add(Sighting(images[0], tracker(1), tracker(1), late_s=0.6))
        assert "arrive 0.6 s late" in session.hint
    show(session, images[0], 0)
    assert session.num_kept == 1


def test_what_is_not_seen_is_named(options, images):
    session = MountSession(options)
    blank = cv2.imencode(".png", np.full((360, 480), 128, np.uint8))[1].tobytes()
    for sighting, words in (
        (Sighting(b"", None, None), "no image"),
        (Sighting(blank, tracker(0), tracker(0)), "board is not seen"),
        (Sighting(images[0], None, None), "tracker is not seen"),
    ):
        session.add(sighting)
        assert words in session.hint
    assert session.num_kept == 0
    small = cv2.imencode(".png", np.full((240, 320), 128, np.uint8))[1].tobytes()
    with pytest.raises(InvalidInputError, match="calibrate the lens in this mode"):
        session.add(Sighting(small, None, None))


def test_a_place_is_taken_by_order_and_the_last_one_is_dropped(options, images):
    session = MountSession(options)
    show(session, images[0], 0)
    session.take()
    show(session, images[0], 0)
    assert session.num_kept == 2
    session.drop()
    session.drop()
    session.drop()
    assert session.num_kept == num_kept_places(options.photos) == 0
    assert list(options.photos.glob("*.jpg")) == []


def test_no_more_places_are_taken_than_the_session_keeps(options, images, monkeypatch):
    monkeypatch.setattr(mount, "MAX_PLACES", 1)
    session = MountSession(options)
    show(session, images[0], 0)
    session.take()
    show(session, images[1], 1)
    assert (session.num_kept, session.hint[:16]) == (1, "1 places are kep")
    # The order is not kept for later.
    session.drop()
    show(session, images[1], 1)
    show(session, images[1], 1)
    assert session.num_kept == 1


def test_an_ended_session_goes_on_with_its_places_or_puts_them_aside(options, images):
    session = MountSession(options)
    for index in (0, 1):
        show(session, images[index], index)
    assert num_kept_places(options.photos) == 2
    again = MountSession(options, is_resumed=True)
    show(again, images[2], 2)
    written = poses_of_photos(options.photos / "poses.csv", "")
    assert list(written) == [f"place_{index:04d}.jpg" for index in range(3)]
    for index, T in enumerate(written.values()):
        np.testing.assert_allclose(T, tracker(index), atol=1e-9)
    assert again.progress.num_places == 3
    other = Namespace(**vars(options) | {"board": "chessboard:9x6:30mm"})
    with pytest.raises(InvalidInputError, match=r"kept places are of the board 'chess.*25mm'"):
        MountSession(other, is_resumed=True)
    anew = MountSession(other)
    assert anew.num_kept == 0
    (aside,) = options.photos.parent.glob("mount-head-*")
    assert num_kept_places(aside) == 3


def test_a_session_needs_a_lens_and_an_unambiguous_board(options, tmp_path):
    with pytest.raises(NotFoundError, match="calibrate camera"):
        MountSession(Namespace(**vars(options) | {"to": tmp_path / "new"}))
    with pytest.raises(InvalidInputError, match="half a turn"):
        MountSession(Namespace(**vars(options) | {"board": "chessboard:8x6:25mm"}))
