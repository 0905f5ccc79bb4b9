"""Poses from clicks, for which OpenCV's camera says where true poses are seen."""

import json

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, ObjectTrack, clicked_poses, maintenance
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import EpisodeClicks, ObjectClicks
from services.cli.main import main
from tests.unit.episode_store.episodes import IDENTITY_ROWS, POSES, write_episode
from tests.unit.test_lens import looking_down, seen_by_opencv

K = np.array([[26.0, 0.0, 16.0], [0.0, 26.0, 16.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.2, 0.05, 0.002, -0.001, 0.0])
CAMERA = looking_down(0.6, yaw_rad=0.1)
TABLE_Z_M = 0.02
# A bottle lies on its side along z, with its frame off the middle; a cup stands on a base of 1 cm.
BOTTLE = {
    "name": "bottle",
    "box_m": [0.0, 0.0, 0.02, 0.03, 0.04, 0.12],
    "click": {"up": "-x", "heading": "z", "point_m": [-0.03, 0.0, 0.05]},
}
CUP = {
    "name": "cup",
    "box_m": [0.0, 0.0, 0.05, 0.04, 0.04, 0.05],
    "click": {"symmetric": True, "base_m": 0.01},
}
MAT = {"name": "mat", "box_m": [0, 0, 0, 0.05, 0.03, 0.001], "fixed": True}
FILE = {"table_z_m": TABLE_Z_M, "tasks": {"stand_bottle": [BOTTLE, CUP, MAT]}}
YAW_RAD = 0.7


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def written(store, name="take", **changes):
    anchor = dict.fromkeys(POSES, IDENTITY_ROWS) | {"T_world_camera_head": CAMERA.tolist()}
    about = {"K_head": K.tolist(), "calibration": {"distortion_head": [DISTORTION.tolist()]}}
    about |= {"origin": "recorded", "anchor": anchor}
    return write_episode(store, name, **about | changes).attributes


def seen(points_world, distortion=DISTORTION):
    return seen_by_opencv(np.array(points_world), distortion, CAMERA, K).tolist()


def bottle():
    """The lying bottle: its z axis points 0.7 rad from x, its −x axis upwards."""
    z = np.array([np.cos(YAW_RAD), np.sin(YAW_RAD), 0.0])
    x = np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = [0.03, -0.05, TABLE_Z_M + 0.03]
    return T


def clicks(**objects):
    point, farther = (bottle() @ [-0.03, 0.0, along, 1.0] for along in (0.05, 0.14))
    point_px, heading_px = seen([point[:3], farther[:3]])
    usual = {"bottle": {"point_px": point_px, "heading_px": heading_px}}
    given = {name: click for name, click in (usual | objects).items() if click is not None}
    return EpisodeClicks.model_validate({"objects": given})


def objects(**changes):
    return ObjectClicks.model_validate(FILE | changes)


def test_two_clicks_give_the_pose_of_a_lying_object(store):
    found = clicked_poses(written(store), objects(), clicks())
    np.testing.assert_allclose(transform_from_pose(found.poses[0]), bottle(), atol=1e-7)
    assert found.known.tolist() == [True, False, False]


def test_one_click_gives_the_place_of_a_symmetric_object(store):
    # Its top is 10 cm over the base.
    place_m = [0.07, -0.1, TABLE_Z_M + 0.01]
    (pixel,) = seen([[*place_m[:2], place_m[2] + 0.1]])
    found = clicked_poses(written(store), objects(), clicks(cup={"point_px": pixel}))
    np.testing.assert_allclose(found.poses[1], [*place_m, 1, 0, 0, 0], atol=1e-7)
    assert found.known.tolist() == [True, True, False]


def test_without_a_distortion_the_lens_is_straight(store):
    about = written(store, calibration={})
    (pixel,) = seen([[0.0, -0.1, TABLE_Z_M + 0.002]], np.zeros(5))
    ahead = seen([[0.1, -0.1, TABLE_Z_M + 0.002]], np.zeros(5))[0]
    found = clicked_poses(
        about, objects(), clicks(bottle=None, mat={"point_px": pixel, "heading_px": ahead})
    )
    np.testing.assert_allclose(found.poses[2], [0, -0.1, TABLE_Z_M + 0.001, 1, 0, 0, 0], atol=1e-7)


@pytest.mark.long
def test_the_error_is_that_of_three_pixels(store):
    about = written(store)
    found = clicked_poses(about, objects(), clicks())
    usual = clicks().objects["bottle"]
    places = []
    for shift_px in np.random.default_rng(0).normal(scale=0.1, size=(400, 2)):
        both = {"point_px": usual.point_px, "heading_px": usual.heading_px}
        moved = {name: (np.array(pixel) + shift_px).tolist() for name, pixel in both.items()}
        places.append(clicked_poses(about, objects(), clicks(bottle=moved)).poses[0, :2])
    sd_m = np.sqrt(np.var(places, axis=0).mean())
    assert found.sd_m[0] == pytest.approx(30 * sd_m, rel=0.1)


def test_what_is_away_is_known_and_what_is_hidden_is_not(store):
    given = clicks(bottle={"state": "absent"}, cup={"state": "hidden"})
    found = clicked_poses(written(store), objects(), given)
    assert found.known.tolist() == [True, False, False]
    # The world model takes what is farther than a metre for absent.
    assert np.linalg.norm(found.poses[0, :3]) > 1.0


@pytest.mark.parametrize(
    ("click", "says"),
    [
        ({"point_px": [33.0, 4.0], "heading_px": [1.0, 1.0]}, r"point_px is \[33.0, 4.0\]"),
        ({"point_px": [4.0, 4.0], "heading_px": [-0.1, 1.0]}, "heading_px is"),
        ({"point_px": [16.0, 16.0], "heading_px": [16.1, 16.0]}, "mm from point_px"),
        ({"point_px": [16.0, 16.0]}, "has no heading_px"),
    ],
)
def test_wrong_clicks_are_refused_by_name(store, click, says):
    with pytest.raises(InvalidInputError, match=f"episode 'take', object 'bottle': .*{says}"):
        clicked_poses(written(store), objects(), clicks(bottle=click))


def test_a_ray_over_the_table_is_refused(store):
    up = np.diag([1.0, -1.0, -1.0, 1.0])
    up[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=float)
    up[2, 3] = 0.5
    anchor = dict.fromkeys(POSES, IDENTITY_ROWS) | {"T_world_camera_head": up.tolist()}
    about = written(store, anchor=anchor)
    # The camera looks along y, level: the upper half of the image is over the horizon.
    for row, is_refused in ((4.0, True), (16.1, True), (28.0, False)):
        click = clicks(bottle={"point_px": [16.0, row], "heading_px": [20.0, row]})
        if is_refused:
            with pytest.raises(InvalidInputError, match=r"does not meet the height 0\.080 m"):
                clicked_poses(about, objects(), click)
        else:
            assert clicked_poses(about, objects(), click).known[0]


def test_an_unfinished_click_may_count_as_unknown(store):
    given = clicks(bottle={"point_px": [16.0, 16.0]})
    found = clicked_poses(written(store), objects(), given, may_lack_headings=True)
    assert not found.known.any()


def test_unknown_names_are_refused(store):
    about = written(store)
    with pytest.raises(UnknownNameError, match="lid"):
        clicked_poses(about, objects(), clicks(lid={"state": "hidden"}))
    with pytest.raises(UnknownNameError, match="stand_bottle"):
        clicked_poses(about, objects(tasks={"pour": [CUP]}), clicks())
    other = written(store, "other", object_names=("cup", "bottle"))
    with pytest.raises(InvalidInputError, match=r"\['cup', 'bottle'\]"):
        clicked_poses(other, objects(), clicks())


def test_clicks_fill_what_streams_do_not_say(store):
    found = clicked_poses(
        written(store),
        objects(),
        clicks(
            cup={"point_px": [16.0, 16.0]},
            mat={"point_px": [8.0, 16.0], "heading_px": [12.0, 16.0]},
        ),
    )
    track = ObjectTrack.unknown(5, 3)
    track.known[2:, 1] = True
    track.poses[:, 1, 0] = 0.5
    markers = ObjectTrack(track.poses, track.known, ("none", "markers", "none"), track.sd_m)
    filled = markers.filled(found.track(5))
    assert filled.sources == ("clicks", "markers", "clicks")
    # A fixed object stands where it was clicked; of others, the first step alone is known.
    assert filled.known.T.tolist() == [
        [True, False, False, False, False],
        [False, False, True, True, True],
        [True] * 5,
    ]
    np.testing.assert_allclose(filled.poses[0, 0], found.poses[0], atol=1e-6)
    np.testing.assert_allclose(filled.poses[:, 1, 0], 0.5)
    np.testing.assert_allclose(filled.sd_m, found.sd_m * [1, 0, 1], rtol=1e-6)


def test_clicks_are_kept_beside_the_content(store):
    written(store)
    before = store.open("take").content_sha256
    assert store.clicks("take") is None
    store.set_clicks("take", clicks())
    assert store.clicks("take") == clicks()
    assert store.open("take").verify().content_sha256 == before
    assert not maintenance.inspect_group(store.files("take"), "episode").findings
    store.delete("take")
    store.restore("take")
    assert store.clicks("take") == clicks()
    store.set_clicks("take", None)
    assert store.clicks("take") is None
    with pytest.raises(NotFoundError):
        store.set_clicks("another", clicks())


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"version": 2}, "version"),
        ({"episodes": {"../take": {"objects": {"cup": {"state": "hidden"}}}}}, "episodes"),
        ({"episodes": {"take": {"objects": {"cup": {}}}}}, "point_px"),
        ({"episodes": {"take": {"objects": {"cup": {"point_px": [1, 2, 3]}}}}}, "point_px"),
        ({"episodes": {"a": {"objects": {"cup": {"state": "absent", "point_px": [1, 2]}}}}}, "cup"),
        ({"tasks": {"pour": [CUP | {"click": {"up": "x", "heading": "-x"}}]}}, "different axes"),
        ({"tasks": {"pour": [CUP | {"box_m": [0.01, 0, 0.05, 0.04, 0.04, 0.05]}]}}, "symmetry"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_with_the_place(tmp_path, content, says):
    path = tmp_path / "clicks.json"
    path.write_text(json.dumps(FILE | content))
    with pytest.raises(InvalidInputError, match=says):
        ObjectClicks.load(path)


def test_what_clicks_need_does_not_change_what_alignment_makes():
    plain = {"tasks": {"pour": [{"name": "cup", "box_m": CUP["box_m"]}]}}
    with_click = ObjectClicks.model_validate({"tasks": {"pour": [CUP]}, "table_z_m": 0.4})
    text = ObjectClicks.model_validate(plain).of_task("pour").model_dump_json()
    assert with_click.of_task("pour").model_dump_json() == text
    assert "click" not in text
    assert "table" not in text


def test_the_command_lists_places_and_collects_clicks(store, tmp_path, capsys):
    for name in ("filed", "kept", "nobody"):
        written(store, name)
    store.set_clicks("kept", clicks(cup={"state": "absent"}))
    path = tmp_path / "objects.json"
    path.write_text(json.dumps(FILE | {"episodes": {"filed": clicks().model_dump(mode="json")}}))
    collected = tmp_path / "clicks.json"
    words = ["store", "clicks", "--store", str(store.root), "--clicks", str(path)]
    assert main([*words, "--json", str(collected)]) == 0
    printed = capsys.readouterr().out
    x_mm, y_mm, _ = 1e3 * bottle()[:3, 3]
    assert f"filed    bottle  clicks  {x_mm:.0f}" in printed
    assert f"{y_mm:.0f}" in printed
    assert "40°" in printed
    assert "absent" in printed
    assert "nobody" not in printed
    assert ObjectClicks.load(collected).episodes == {
        "filed": clicks(), "kept": clicks(cup={"state": "absent"}),
    }  # fmt: skip
    path.write_text(json.dumps(FILE | {"episodes": {"gone": clicks().model_dump(mode="json")}}))
    assert main(words) == 3
    assert "gone" in capsys.readouterr().err
