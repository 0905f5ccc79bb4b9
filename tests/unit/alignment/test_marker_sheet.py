"""The printed sheet has the markers in true size."""

import re

import cv2
import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.schemas import ObjectMarker, SceneObject, SceneObjects
from services.alignment.command_line import main
from services.alignment.markers import marker_sheet

FLAT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
PX_PER_MM = 4


def objects(*sizes_m, dictionary="DICT_5X5_250"):
    markers = tuple(ObjectMarker(id=k, size_m=size, pose=FLAT) for k, size in enumerate(sizes_m))
    one = SceneObject(name="cup", box_m=(0, 0, 0, 0.1, 0.1, 0.1), markers=markers)
    return SceneObjects(dictionary=dictionary, tasks={"pour": (one,)})


def drawn(svg):
    """The filled rectangles of the SVG as pixels."""
    width, height = (
        float(re.search(rf'{name}="([\d.]+)mm"', svg)[1]) for name in ("width", "height")
    )
    page = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, dtype=np.uint8)
    for tag in re.findall(r"<rect [^>]*>", svg):
        place = {k: float(v) for k, v in re.findall(r'\b(x|y|width|height)="([\d.]+)"', tag)}
        x, y, w, h = (
            round(PX_PER_MM * v)
            for v in (
                place.get("x", 0), place.get("y", 0),
                place.get("x", 0) + place["width"], place.get("y", 0) + place["height"],
            )
        )  # fmt: skip
        page[y:h, x:w] = 255 if 'fill="white"' in tag else 0
    return page


@pytest.mark.parametrize("dictionary", ["DICT_5X5_250", "DICT_APRILTAG_36h11"])
def test_a_detector_finds_every_marker_in_its_size(dictionary):
    sizes_m = [0.03, 0.05, 0.08, 0.08, 0.08, 0.1, 0.1]
    page = drawn(marker_sheet(objects(*sizes_m, dictionary=dictionary)))
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, ids, _ = cv2.aruco.ArucoDetector(kind).detectMarkers(page)
    assert sorted(np.ravel(ids).tolist()) == list(range(len(sizes_m)))
    for number, found in zip(np.ravel(ids).tolist(), corners, strict=True):
        side_px = np.linalg.norm(found[0, 1] - found[0, 0])
        assert side_px / PX_PER_MM == pytest.approx(1e3 * sizes_m[number], abs=0.8)


def test_markers_of_one_name_and_id_in_two_tasks_are_printed_in_both_sizes():
    both = objects(0.05).tasks | {"stir": objects(0.03).tasks["pour"]}
    svg = marker_sheet(SceneObjects(tasks=both))
    assert "50 mm" in svg
    assert "30 mm" in svg


def test_what_does_not_fit_a_page_is_refused():
    with pytest.raises(InvalidInputError, match="400 mm"):
        marker_sheet(objects(0.4))
    with pytest.raises(InvalidInputError, match="none to print"):
        marker_sheet(objects())


def test_the_command_writes_the_sheet_of_a_file(tmp_path, capsys):
    described, page = tmp_path / "objects.json", tmp_path / "markers.svg"
    described.write_text(objects(0.05).model_dump_json())
    assert main(["markers", "--objects", str(described), "--to", str(page)]) == 0
    assert page.read_text().startswith("<svg")
    assert "100 %" in capsys.readouterr().out
