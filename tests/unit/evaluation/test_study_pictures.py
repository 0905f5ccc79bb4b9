"""The policy table as SVG, PNG and LaTeX: what they show is where plain counts put it."""

import io
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from dextouch.errors import UnknownNameError
from services.evaluation.reporting.policy_picture import COLOURS, policy_picture
from services.evaluation.studies.app import StudyFolders
from services.evaluation.studies.results import StudyResults
from services.evaluation.studies.study_figures import picture, write_pictures
from tests.unit.evaluation.study_rows import ROWS, TASKS, counted, interval, write_study

SVG = "{http://www.w3.org/2000/svg}"
# Of the square between 0 and 1, in points: left, top and side.
LEFT, TOP, SIDE = 30, 38, 220


@pytest.fixture
def figures(tmp_path):
    write_study(tmp_path / "touch")
    return StudyFolders(tmp_path).figures("touch")


def expected(task, policy, world):
    """Rate with the ends of its interval, by hand and by scipy."""
    successes, trials = counted(task, policy, world)
    return np.array([successes / trials, *interval(task, policy, world)])


def test_latex_has_every_policy_with_both_intervals(figures):
    text = picture(figures, "model", "stand_bottle", "tex").decode()
    names = re.findall(r"\\addlegendentry\{(.+?)\}", text)
    assert names == list(ROWS["stand_bottle"])
    rows = re.findall(r"\((.+?), (.+?)\) \+= \((.+?), (.+?)\) -= \((.+?), (.+?)\)", text)
    for policy, row in zip(names, np.array(rows, float), strict=True):
        for world, (value, above, below) in zip(
            ("real", "model"), row.reshape(3, 2).T, strict=True
        ):
            shown = [value, value - below, value + above]
            np.testing.assert_allclose(shown, expected("stand_bottle", policy, world), atol=1.1e-4)
    for opened in ("tikzpicture", "axis"):
        assert text.count(rf"\begin{{{opened}}}") == text.count(rf"\end{{{opened}}}") == 1
    assert text.count("{") == text.count("}")


def test_svg_draws_marks_and_intervals_where_they_belong(figures):
    root = ET.fromstring(picture(figures, "blurred", "stand_bottle", "svg"))  # noqa: S314 - ours
    texts = [one.text for one in root.iter(f"{SVG}text")]
    assert {"blurred, stand bottle", "real success", "imagined success", *ROWS[TASKS[0]]} <= set(
        texts
    )
    lines = [(one.get("stroke"), one.get("d")) for one in root.iter(f"{SVG}path")]
    # The diagonal.
    assert f"M{LEFT}.00,{TOP + SIDE}.00 {LEFT + SIDE}.00,{TOP}.00" in [d for _, d in lines]
    for colour, policy in zip(COLOURS, ROWS["stand_bottle"], strict=False):
        across, along = [
            np.array(re.findall(r"[\d.]+", d), float).reshape(2, 2)
            for stroke, d in lines
            if stroke == colour
        ]
        real, imagined = (expected("stand_bottle", policy, name) for name in ("real", "blurred"))
        np.testing.assert_allclose((across[:, 0] - LEFT) / SIDE, real[1:], atol=1e-4)
        np.testing.assert_allclose((TOP + SIDE - along[:, 1]) / SIDE, imagined[1:], atol=1e-4)
        np.testing.assert_allclose(along[:, 0], LEFT + SIDE * real[0], atol=6e-3)


def test_names_are_text_in_every_format():
    pairs = {"a < b_c": [((1.0, 0.5, 1.0), (0.0, 0.0, 0.5))]}
    root = ET.fromstring(policy_picture(pairs, "t & u", "svg"))  # noqa: S314 - ours
    assert {"a < b_c", "t & u"} <= {one.text for one in root.iter(f"{SVG}text")}
    assert r"b\_c" in policy_picture(pairs, "t & u", "tex").decode()


def test_long_names_are_whole_in_every_format():
    name = "behaviour_cloning_finetuned_on_imagined_episodes_of_2026_11_30_v2"
    pairs = {name: [((0.2, 0.1, 0.5), (0.3, 0.2, 0.5))], "hold": [((0.0, 0.0, 0.5),) * 2]}
    root = ET.fromstring(policy_picture(pairs, name, "svg"))  # noqa: S314 - ours
    sizes = {one.text: float(one.get("font-size")) for one in root.iter(f"{SVG}text")}
    assert sizes["hold"] == 9.0
    # Letters are about 0.6 of their size wide; the picture is 260 points wide.
    assert LEFT + 16 + 0.6 * sizes[name] * len(name) < 260
    shown = np.asarray(Image.open(io.BytesIO(policy_picture(pairs, name, "png"))).convert("L"))
    assert (shown[:, -8:] > 250).all()


def test_png_has_300_dots_an_inch_and_the_marks(figures):
    image = Image.open(io.BytesIO(picture(figures, "blurred", "stand_bottle", "png")))
    np.testing.assert_allclose(image.info["dpi"], 300, rtol=1e-3)
    pixels = np.asarray(image)
    for colour, policy in zip(COLOURS, ROWS["stand_bottle"], strict=False):
        x, y = (expected("stand_bottle", policy, name)[0] for name in ("real", "blurred"))
        place = np.array([TOP + SIDE * (1 - y), LEFT + SIDE * x]) * 300 / 72
        assert tuple(pixels[tuple(place.astype(int))]) == tuple(bytes.fromhex(colour[1:]))


def test_all_tasks_and_all_formats_are_written_and_unknown_names_listed(figures, tmp_path):
    write_pictures(StudyResults.read(tmp_path / "touch"))
    names = {path.name for path in (tmp_path / "touch").glob("policies *")}
    tasks = (*TASKS, "all tasks")
    forms = ("svg", "png", "tex")
    assert names == {
        f"policies {w} {t}.{f}" for w in ("model", "blurred") for t in tasks for f in forms
    }
    assert picture(figures, "model", "", "tex").count(b"+=") == 6
    with pytest.raises(UnknownNameError, match="blurred, model"):
        picture(figures, "dream", "", "svg")
    with pytest.raises(UnknownNameError, match="stand_bottle"):
        picture(figures, "model", "sing", "svg")
