"""The HTML report: it stands alone, shows what there is, escapes, and never shows NaN."""

import base64
import json
import platform
import re
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest

from dextouch import __version__
from services.evaluation.rendering import figure
from services.evaluation.reporting import pictures, write_report
from services.evaluation.reporting.pictures import (
    ActionPicture,
    EpisodePicture,
    Line,
    PredictionPicture,
    ReportPictures,
    data_address,
    hands_image,
    line_chart,
    moving_picture,
    scale_colours,
    ticks,
)
from services.evaluation.reporting.sections import clock_rows, error_rows, tiles

rng = np.random.default_rng(11)
TIMES = np.linspace(0, 5, 4)
IMAGES = rng.integers(0, 256, (4, 16, 16, 3), dtype=np.uint8)
TOUCH = rng.uniform(0, 30, (4, 2, 320)).astype(np.float32)
ACTIONS = np.tile(np.eye(1, 67, 3)[0], (20, 1)) + rng.normal(0, 0.1, (20, 67))
REPORT = {
    "about": {"machine": "<script>alert(1)</script>"},
    "stages": [{"name": "record", "seconds": 12.5}, {"name": "imagine", "seconds": 40.0}],
    "errors": {
        "clock_rms_ms": {"tactile_left": 0.31, "camera_head": 1.7},
        "taxel_iou": 0.991, "taxel_mae_kpa": 0.02, "wrist_error_mm": float("nan"),
    },
    "errors_by_calibration": {"human": {
        "measured": {"wrist_error_mm": 0.678, "wrist_error_deg": float("nan")},
        "true": {"wrist_error_mm": 0.512, "wrist_error_deg": 0.00003},
    }},
    "world_model": {
        "psnr": 25.5, "psnr_copy": 24.0, "psnr_codec": 31.0, "psnr_other_take": 22.0,
        "psnr_hands_still": 24.6,
        "tactile_mse": 0.5, "tactile_mse_zero": 2.0, "tactile_mse_copy": 1.0,
    },
    "policies": [
        {"policy": "script-0mm", "task": "stand_bottle", "real": 1.0, "imagined": 0.9,
         "real_interval": [0.7, 1.0], "imagined_interval": [0.6, 0.98]},
        {"policy": "hold", "task": "stand_bottle", "real": 0.0, "imagined": float("nan")},
    ],
    "agreement": {"stand_bottle": {
        "pearson": "undefined", "mmrv": 0.45, "mmrv_interval": [0.21, 0.68], "mmrv_paper": 0.0,
        "pearson_interval": "undefined",
    }},
    "comments": {"stand_bottle": ["The dream flatters."]},
}  # fmt: skip
PICTURES = ReportPictures(
    episodes=(EpisodePicture("an episode", TIMES, IMAGES, TOUCH),),
    clock_residuals_ms={"tactile_left": np.stack([TIMES, TIMES * 0.01])},
    actions=ActionPicture(np.arange(20) / 15, ACTIONS, ACTIONS + 0.01),
    predictions=(PredictionPicture("a window", TIMES, IMAGES, IMAGES, TOUCH, TOUCH),),
    moving=(PredictionPicture("a pair", TIMES, IMAGES, IMAGES, TOUCH, 0 * TOUCH),),
)

EMPTY = ReportPictures()


class Tags(HTMLParser):
    """Collects tags, and checks that they nest."""

    VOID = frozenset({"meta", "img", "link", "br", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        self.addresses += [v for k, v in attributes if k in {"src", "href"}]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page(tmp_path, report, pictures=EMPTY) -> tuple[str, Tags]:
    path = tmp_path / "deep" / "report.html"
    write_report(report, pictures, path)
    text = path.read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    return text, tags


def test_a_full_report_stands_alone(tmp_path):
    text, tags = page(tmp_path, REPORT, PICTURES)
    assert all(address.startswith("data:image/") for address in tags.addresses)
    assert not re.search(r"https?://|@import|url\(", text)
    assert "script" not in tags.seen
    assert "prefers-color-scheme: dark" in text
    assert tags.seen.count("img") == 2 * (4 + 8) + 2
    assert tags.seen.count("svg") == 1 + 4 + 1
    for words in ("an episode", "a window", "script-0mm", "tactile_left", "0.70\u20131.00"):
        assert words in text


def test_an_empty_report_is_a_page_too(tmp_path):
    text, tags = page(tmp_path, {})
    assert "img" not in tags.seen
    assert "Policies" not in text


@pytest.mark.long
@pytest.mark.parametrize("part", [k for k in REPORT if k != "about"])
def test_every_part_may_come_alone_or_be_missing(tmp_path, part):
    page(tmp_path, {part: REPORT[part]})
    page(tmp_path, {k: v for k, v in REPORT.items() if k != part}, PICTURES)


def test_undefined_figures_say_so(tmp_path):
    text, _ = page(tmp_path, REPORT)
    shown = text.split("<h2>All figures")[0]
    assert "undefined" in shown
    assert not re.search(r"\bnan\b", shown, re.IGNORECASE)


def test_agreement_counts_ties_and_says_what_it_means(tmp_path):
    text, _ = page(tmp_path, REPORT)
    shown = re.sub(r"</summary><span>.*?</span>", "", text.split("<h2>All figures")[0])
    words = re.sub(r"<[^>]*>|\s+", " ", shown)
    assert re.search(r"MMRV, ties counted +0\.450 +0\.21.0\.68", words)
    assert re.search(r"MMRV, paper&#39;s rule +0\.0 ", words)
    assert "The dream flatters." in words
    assert "pearson_interval" not in words


def test_rubric_scores_stand_below_the_rates(tmp_path):
    first = REPORT["policies"][0] | {"real_rubric": 0.75, "imagined_rubric": 0.625}
    agreement = {"pearson": 0.93, "mmrv": 0.0, "num_policies": 2}
    told = {"imagined_world": "dream", "rubrics": {"dream": {"stand_bottle": agreement}}}
    text, _ = page(tmp_path, REPORT | told | {"policies": [first, REPORT["policies"][1]]})
    words = re.sub(r"<[^>]*>|\s+", " ", text.split("<h2>All figures")[0])
    assert re.search(r"rubric 0\.750.* rubric 0\.625", words)
    assert re.search(r"Rubric scores: Pearson +0\.930 +· MMRV, ties counted +0\.0", words)


def test_failed_rollouts_are_counted_by_kind(tmp_path):
    failure = {"policy": "mine", "world": "real", "task": "t", "error": "InvalidInputError",
               "message": "act raised <ValueError>", "traceback": None}  # fmt: skip
    failures = [{**failure, "seed": seed} for seed in range(3)]
    text, _ = page(tmp_path, {"failures": failures, "num_rollouts": 12})
    shown = text.split("<h2>All figures")[0]
    assert "3 of 12 rollouts" in shown
    assert "act raised &lt;ValueError&gt;" in shown
    assert shown.count("<td>mine</td>") == 1


def test_all_figures_of_prediction_stand_beside_their_baselines(tmp_path):
    metrics = {
        "psnr": {"title": "PSNR", "unit": "dB", "better": "higher", "about": ""},
        "lpips": {
            "title": "LPIPS",
            "unit": "",
            "better": "lower",
            "about": "",
            "missing": "not here",
        },
    }
    figures = {
        "model": {"psnr": 23.456, "lpips": None},
        "other_take": {"psnr": None, "lpips": None},
    }
    path = tmp_path / "report.html"
    write_report({"prediction": {"figures": figures, "metrics": metrics}}, ReportPictures(), path)
    text = " ".join(re.sub("<[^>]*>", " ", path.read_text(encoding="utf-8")).split())
    assert "model other take PSNR ↑ dB 23.5 none LPIPS ↓ not here" in text
    assert "is missing" not in text
    prediction = {"figures": figures, "metrics": metrics, "missing": {"other_take": "no <other>"}}
    write_report({"prediction": prediction}, ReportPictures(), path)
    assert "other take is missing: no &lt;other&gt;." in path.read_text(encoding="utf-8")


def test_raw_figures_come_along(tmp_path):
    report = {k: v for k, v in REPORT.items() if k in {"stages", "world_model"}}
    text, _ = page(tmp_path, report)
    raw = re.search(r"<pre>(.*?)</pre>", text, re.DOTALL)[1].replace("&#34;", '"')
    assert json.loads(raw) == report


def test_bounds_are_judged():
    rows = {row.name: row.holds for row in error_rows(REPORT["errors"])}
    assert rows["Clock of camera head, RMS, the worst of 2"] is False
    clocks = {row.name: row.holds for row in clock_rows(REPORT["errors"])}
    assert clocks == {"Clock of tactile left, RMS": True, "Clock of camera head, RMS": False}
    assert rows["Contact agreement (IoU)"] is True
    assert rows["Wrist position error"] is None


def test_errors_stand_beside_those_with_the_true_calibration(tmp_path):
    write_report(REPORT, PICTURES, tmp_path / "report.html")
    text = re.sub(r"<[^>]+>|\s+", " ", (tmp_path / "report.html").read_text())
    text = re.sub(" +", " ", text)
    assert "mean error measured true" in text
    assert "Human: wrist position 0.678 mm 0.512 mm" in text
    assert "Human: wrist rotation undefined ° &lt; 0.001 °" in text


def test_headlines():
    shown = {tile.name: tile.value for tile in tiles(REPORT)}
    assert shown == {
        "from bytes to score": "52.5 s",
        "worst clock": "1.7 ms",
        "touch recorded": "0.991",
        "images predicted": "+0.9 dB",
        "touch predicted": "50%",
        "worlds agree": "undefined",
    }


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0, "0.0"), (0.9912, "0.991"), (12.34, "12.3"), (1234.5, "1234"), (-3.14159, "-3.14"),
     (2e-5, "2.00e-05"), (None, "undefined"), ("undefined", "undefined"), (np.inf, "undefined"),
     ("undefined (2 policies)", "undefined (2 policies)"), ("x", "undefined")],
)  # fmt: skip
def test_figures_have_three_digits(value, shown):
    assert figure(value) == shown


@pytest.mark.parametrize("channels", [3, 4])
def test_small_images_are_embedded_without_loss(channels):
    image = rng.integers(0, 256, (5, 7, channels), dtype=np.uint8)
    kind, _, data = data_address(image).partition(";base64,")
    assert kind == "data:image/png"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    order = [2, 1, 0, 3][:channels]
    np.testing.assert_array_equal(decoded[..., order], image)


def test_large_photographs_are_embedded_as_jpeg():
    address = data_address(np.zeros((300, 20, 3), np.uint8))
    kind, _, data = address.partition(";base64,")
    assert kind == "data:image/jpeg"
    assert base64.b64decode(data)[:2] == b"\xff\xd8"


def test_hands_show_every_loaded_taxel_in_its_place_and_colour():
    """As on the dashboard: the left hand's thumb is on the right, opposite the right hand's."""
    touch = np.zeros((2, 320), dtype=np.float32)
    still = hands_image(touch, cell_px=8)
    assert (still[..., 3] == 0).any()
    touch[0, 0] = touch[1, 0] = 40.0
    touch[1, 80] = 0.9
    pressed = hands_image(touch, cell_px=8)
    rows, columns = np.nonzero((pressed != still).any(axis=2))
    width = still.shape[1]
    # One cell of 8 px of each hand, mirrored; not the weak one.
    left, right = columns[columns < width / 2], columns[columns >= width / 2]
    assert {len(np.unique(left)), len(np.unique(right))} <= {7, 8}
    np.testing.assert_array_equal(np.unique(left), width - 1 - np.unique(right)[::-1])
    assert (rows.min() // 8, rows.max() // 8) == (9, 9)
    full = pressed[rows.min() + 4, left.min() + 4]
    assert full.tolist() == [255, 240, 170, 255]
    assert scale_colours()[-1] == "rgb(255 240 170)"


def moving_data(steps, noise=0.0):
    """The file of a pair whose imagined touch is none; images get brighter by time."""
    images = np.full((steps, 16, 16, 3), 20, dtype=np.uint8)
    images += np.arange(steps, dtype=np.uint8)[:, None, None, None]
    if noise:
        images = rng.integers(0, 256, (steps, 256, 256, 3), dtype=np.uint8)
    touch = np.full((steps, 2, 320), 20.0, dtype=np.float32)
    pair = PredictionPicture("p", np.arange(steps) / 15, images, images, touch, 0 * touch)
    made = moving_picture(pair)
    kind, _, data = made.moving.partition(";base64,")
    assert kind == "data:image/webp"
    assert made.still.startswith("data:image/")
    return base64.b64decode(data), made


def test_moving_pictures_are_animated_webp_of_five_seconds():
    """By its container (RIFF): chunks ANMF with their duration in ms, and ANIM with the loop."""
    data, made = moving_data(90)
    assert (data[:4], data[8:12]) == (b"RIFF", b"WEBP")
    at, durations_ms = 12, []
    while at < len(data):
        name, size = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        body = data[at + 8 : at + 8 + size]
        if name == b"ANMF":
            durations_ms.append(int.from_bytes(body[12:15], "little"))
        if name == b"ANIM":
            assert int.from_bytes(body[4:6], "little") == 0
        at += 8 + size + size % 2
    assert sum(durations_ms) == pytest.approx(5000, rel=0.03)
    assert made.seconds == pytest.approx(5.0, abs=0.1)


def test_moving_pictures_are_bounded(monkeypatch):
    monkeypatch.setattr(pictures, "MAX_MOVING_BYTES", 60_000)
    plain, limited = len(moving_data(30)[0]), len(moving_data(30, noise=1.0)[0])
    monkeypatch.setattr(pictures, "MAX_MOVING_BYTES", 10**9)
    assert plain < 60_000
    assert limited < len(moving_data(30, noise=1.0)[0]) / 4


def test_the_page_begins_in_words(tmp_path):
    report = REPORT | {"num_rollouts": 12, "takes": {"human": {}, "robot": {}}}
    report["world_model"] = report["world_model"] | {"num_rollouts": 6.0}
    text, tags = page(tmp_path, report, PICTURES)
    lead = text.split("What was done")[1].split("</section>")[0]
    words = " ".join(re.sub("<[^>]*>", " ", lead).split())
    for said in (
        "2 takes (human, robot) were recorded",
        "predicted 6 held-out scenes",
        "2 policies were rolled out on 1 task (stand bottle) in the real world of this run and in "
        "a world model, from the same starts: 12 rollouts.",
        f"UTC by DexTouch {__version__} on {platform.node()}",
        "misses 1 of 2 bounds: Clock of camera head, RMS, the worst of 2.",
        "within ±0.15 at worst (95 %)",
        "r = undefined",
        "Calibrate the station again",
    ):
        assert said in words
    assert "1 of 2" not in page(tmp_path, {"policies": REPORT["policies"]})[0].split("<h2>")[0]
    # Words are explained in place, without a script, by what every browser opens.
    assert "<summary>worst clock</summary><span>Root mean square" in text
    assert tags.seen.count("summary") > 8
    assert "prefers-reduced-motion: reduce" in text


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 1.0, [0, 0.2, 0.4, 0.6, 0.8, 1.0]), (-3.0, 8.0, [-2, 0, 2, 4, 6, 8]),
     (0.01, 0.03, [0.01, 0.015, 0.02, 0.025, 0.03])],
)  # fmt: skip
def test_ticks_are_round(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_charts_are_well_formed_and_inside():
    flat = line_chart(
        [Line("a < b & c", np.arange(5.0), np.zeros(5)), Line("d", np.arange(5.0), np.zeros(5), 9)],
        x_label="t", y_label="y",
    )  # fmt: skip
    root = ET.fromstring(flat)  # noqa: S314
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    for line in root.iter("polyline"):
        for point in line.attrib["points"].split():
            x, y = map(float, point.split(","))
            assert 0 <= x <= width
            assert 0 <= y <= height
    assert [line.attrib["class"] for line in root.iter("polyline")] == ["curve s0", "curve s1"]


def test_long_curves_are_thinned():
    chart = line_chart([Line("long", np.arange(1e5), np.arange(1e5))], x_label="x", y_label="y")
    assert len(chart) < 20_000
