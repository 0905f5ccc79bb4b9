"""The file of objects: what is accepted, and what refusals say."""

import json

import cv2
import pytest

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import SceneObjects
from dextouch.schemas.scene_objects import DICTIONARY_SIZES

FLAT = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def described(**changes):
    cup = {
        "name": "cup",
        "box_m": [0, 0, 0, 0.04, 0.04, 0.05],
        "markers": [{"id": 4, "size_m": 0.05, "pose": FLAT}],
    }
    return {"tasks": {"pour": [cup | changes]}}


def load(tmp_path, content):
    path = tmp_path / "objects.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return SceneObjects.load(path)


def test_a_file_gives_the_objects_of_each_task(tmp_path):
    objects = load(tmp_path, described())
    assert objects.tasks["pour"][0].stream == "object_cup"
    assert objects.of_task("pour") == objects
    assert objects.of_task("stir") is None


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "JSON"),
        (described(name="Cup!"), r"tasks\.pour\.0\.name"),
        (described(box_m=[0, 0, 0, 0.04, 0.0, 0.05]), "positive"),
        (described(markers=[{"id": 4, "size_m": 50, "pose": FLAT}]), "size_m"),
        (described(markers=[{"id": 4, "size_m": 0.05, "pose": [0] * 7}]), "length 0"),
        (described(tracker_pose=FLAT), "one of them"),
        (described(markers=[{"id": 4, "size_m": 0.05, "pose": FLAT}] * 2), "different"),
        (described(colour="red"), "colour"),
        (described(name="poses"), "choose another"),
    ],
)
def test_a_wrong_file_is_refused_with_the_place(tmp_path, content, says):
    with pytest.raises(InvalidInputError, match=says):
        load(tmp_path, content)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(NotFoundError, match=r"nothing\.json"):
        SceneObjects.load(tmp_path / "nothing.json")


@pytest.mark.parametrize(
    ("dictionary", "first_unknown"), [("DICT_4X4_50", 50), ("DICT_APRILTAG_16h5", 30)]
)
def test_ids_are_those_of_the_dictionary(tmp_path, dictionary, first_unknown):
    def numbered(number):
        marker = {"id": number, "size_m": 0.05, "pose": FLAT}
        return {"dictionary": dictionary, **described(markers=[marker])}

    assert load(tmp_path, numbered(first_unknown - 1))
    with pytest.raises(InvalidInputError, match=f"0 … {first_unknown - 1}"):
        load(tmp_path, numbered(first_unknown))


def test_sizes_of_dictionaries_are_those_of_opencv():
    for name, size in DICTIONARY_SIZES.items():
        kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        assert len(kind.bytesList) == size


@pytest.mark.parametrize("q_w", [1e200, 1.1, 0.0])
def test_a_quaternion_of_another_length_is_refused(tmp_path, q_w):
    with pytest.raises(InvalidInputError, match=r"got a quaternion .* expected 1"):
        load(tmp_path, described(tracker_pose=[0, 0, 0, q_w, 0, 0, 0]))
