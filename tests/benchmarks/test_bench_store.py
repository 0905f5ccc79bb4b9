"""`python -m benchmarks store`: one short run as users start it, and its parts that can be wrong.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import simplejpeg

from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from benchmarks.store import benchmark
from benchmarks.store.benchmark import panels, requirements, rms_levels
from benchmarks.store.compare import DesignResult, LiveResult, expected_window, image_psnr
from benchmarks.store.designs import OpenStore
from benchmarks.store.workload import (
    CAMERAS,
    IMAGE_SHAPE,
    NOISE_SIGMA_LEVELS,
    NUMERIC_RATES_HZ,
    TimedStream,
    Workload,
    make_scene,
    make_take,
)
from dextouch.errors import CorruptDataError, InvalidInputError, UnknownNameError

DESIGNS = ["ours-h264", "zarr-jpeg"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "store", "--quick"]
    options = ["--seconds", "1", "--designs", ",".join(DESIGNS)]
    outputs = ["--json", str(folder / "figures.json"), "--out", str(folder / "out")]
    done = subprocess.run(
        [*command, *options, *outputs], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout, json.loads((folder / "figures.json").read_text())


@pytest.mark.slow
def test_every_design_is_measured(run):
    _, text, figures = run
    assert list(figures["designs"]) == DESIGNS
    assert all(name in text for name in DESIGNS)
    for name, result in figures["designs"].items():
        for key in ("write_s", "cpu_s", "window_ms", "three_cameras_ms", "touch_ms"):
            assert len(result[key]) == 1
            assert min(result[key]) > 0, (name, key)


@pytest.mark.slow
def test_every_requirement_has_a_figure(run):
    _, text, figures = run
    verdicts = [requirement["verdict"] for requirement in figures["requirements"]]
    assert len(verdicts) == 9
    assert set(verdicts) <= {"pass", "FAIL"}
    assert all(verdict in text for verdict in verdicts)


@pytest.mark.slow
def test_bytes_and_images_are_what_the_codecs_promise(run):
    """None of these depends on how busy the machine is."""
    designs = run[2]["designs"]
    assert 0.08 < designs["ours-h264"]["num_bytes"] / designs["zarr-jpeg"]["num_bytes"] < 0.2
    psnr_db = {name: list(d["psnr_db"].values()) for name, d in designs.items()}
    assert all(len(values) == len(CAMERAS) for values in psnr_db.values())
    assert 32 < np.mean(psnr_db["zarr-jpeg"]) < 36
    assert np.mean(psnr_db["zarr-jpeg"]) - np.mean(psnr_db["ours-h264"]) < 3


@pytest.mark.slow
def test_the_live_run_counts_every_row(run):
    (live,) = run[2]["live"]
    per_second = 3 * 30 + sum(NUMERIC_RATES_HZ.values())
    assert live["num_rows"] == per_second
    assert 0 <= live["num_late"] <= per_second


@pytest.mark.slow
def test_the_chart_has_a_point_for_every_design(run):
    folder, _, _ = run
    chart = ET.parse(folder / "out" / "bench_store.svg").getroot()  # noqa: S314 (our own file)
    names = [g.get("id", "") for g in chart.iter("{http://www.w3.org/2000/svg}g")]
    for name in DESIGNS:
        assert sum(f": {name}," in one for one in names) == 2
    assert (folder / "out" / "written" / "zarr-jpeg" / "zarr.json").is_file()


# --- parts -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def take():
    return make_take(0.6, seed=3)


@pytest.mark.slow
def test_a_seed_makes_one_take():
    take, again, other = (make_take(0.1, seed=seed) for seed in (3, 3, 4))
    for name, stream in {**take.images, **take.numbers}.items():
        same = {**again.images, **again.numbers}[name]
        np.testing.assert_array_equal(stream.values, same.values)
        np.testing.assert_array_equal(stream.t_ref_ns, same.t_ref_ns)
    assert not np.array_equal(take.images["camera_head"].values, other.images["camera_head"].values)


def test_a_take_is_a_whole_station(take):
    assert take.num_images == 18
    for name, rate_hz in NUMERIC_RATES_HZ.items():
        assert len(take.numbers[name].values) == round(0.6 * rate_hz)
    for stream in (*take.images.values(), *take.numbers.values()):
        assert stream.t_ref_ns[0] > 0
        assert (np.diff(stream.t_ref_ns) > 0).all()


def test_the_scene_is_as_hard_on_jpeg_as_that_of_the_anchors(take):
    """The scene the first figures came from had 52 kB an image at this quality."""
    for camera in CAMERAS:
        image = np.ascontiguousarray(take.images[camera].values[12])
        assert 40e3 < len(simplejpeg.encode_jpeg(image, 90, "RGB", "420")) < 65e3


def test_the_sensor_has_the_noise_it_should():
    scene = make_scene("camera_head", np.random.default_rng(0))
    assert abs(float(scene.noise.std()) - NOISE_SIGMA_LEVELS) < 0.01


def test_what_arrives_between_images_is_everything_once(take):
    for name, stream in take.numbers.items():
        rows = [take.arrived_with(name, index) for index in range(take.num_images)]
        found = np.concatenate([np.arange(len(stream.t_ref_ns))[r] for r in rows])
        np.testing.assert_array_equal(found, np.arange(len(stream.t_ref_ns)))


@pytest.fixture(scope="module")
def block_take():
    """Twenty images of coloured blocks: quick for every codec, and no two windows are alike."""
    rng = np.random.default_rng(0)
    shapes = {"tactile_left": (40, 360), "tactile_right": (40, 360), "action": (20, 67)}
    types = {"tactile_left": np.uint16, "tactile_right": np.uint16, "action": np.float32}

    def stream(values):
        return TimedStream(values, np.arange(len(values), dtype=np.int64), 1)

    colours = rng.integers(50, 200, (20, 15, 20, 3), dtype=np.uint8)
    images = colours.repeat(32, axis=1).repeat(32, axis=2)
    assert images.shape == (20, *IMAGE_SHAPE)
    numbers = {n: stream((1000 * rng.random(s)).astype(types[n])) for n, s in shapes.items()}
    return Workload(20 / 30, {camera: stream(images) for camera in CAMERAS}, numbers)


@pytest.mark.parametrize("design", benchmark.DESIGNS, ids=lambda design: design.name)
@pytest.mark.slow
def test_every_design_gives_back_what_it_was_given(design, block_take, tmp_path):
    """Numbers exactly, images as well as the codec can."""
    assert design.missing() is None
    design.write(block_take, tmp_path / "take")
    store = design.open(tmp_path / "take")
    for window in store.windows(CAMERAS, 2, threaded=True):
        true = expected_window(block_take, CAMERAS[0], 2)
        for part in ("tactile_left", "tactile_right", "actions"):
            np.testing.assert_array_equal(getattr(window, part), getattr(true, part))
        error = np.abs(window.images.astype(float) - true.images).mean()
        assert error == 0 if design.name == "zarr-raw" else 0 < error < 4
    left, right = store.touch(2)
    np.testing.assert_array_equal(left, block_take.numbers["tactile_left"].values[4:38])
    np.testing.assert_array_equal(right, block_take.numbers["tactile_right"].values[4:38])


class FakeStore(OpenStore):
    """Gives what went in, but for what a test spoils."""

    def __init__(self, take, spoil=lambda window: window):
        self._take, self._spoil = take, spoil

    def window(self, camera, start):
        return self._spoil(expected_window(self._take, camera, start))


def test_equal_images_are_told_from_others(block_take):
    exact = image_psnr("fake", FakeStore(block_take), block_take, 1)
    off_by_ten = FakeStore(block_take, lambda w: replace(w, images=w.images + np.uint8(10)))
    assert list(exact.values()) == [100.0] * 3
    for decibels in image_psnr("fake", off_by_ten, block_take, 1).values():
        assert decibels == pytest.approx(20 * np.log10(25.5))


@pytest.mark.parametrize("part", ["tactile_left", "tactile_right", "actions"])
def test_a_design_with_wrong_numbers_is_refused(block_take, part):
    def spoil(window):
        wrong = getattr(window, part).copy()
        wrong[3, 5] += 1
        return replace(window, **{part: wrong})

    with pytest.raises(CorruptDataError, match=f"'fake': {part}"):
        image_psnr("fake", FakeStore(block_take, spoil), block_take, 1)


def test_three_cameras_are_the_same_in_threads(block_take):
    store = FakeStore(block_take)
    alone, together = (store.windows(CAMERAS, 1, threaded=flag) for flag in (False, True))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a.images, b.images)


def result(name, *, write_s, window_ms, num_bytes, psnr_db):
    return DesignResult(
        name=name,
        seconds=10.0,
        write_s=Figure.of(write_s),
        cpu_s=Figure.of(write_s),
        num_bytes=num_bytes,
        num_files=1,
        psnr_db=dict.fromkeys(CAMERAS, psnr_db),
        window_ms=Figure.of(window_ms),
        three_cameras_ms=Figure.of(window_ms),
        three_cameras_threaded_ms=Figure.of(window_ms),
        touch_ms=None,
    )


def test_requirements_compare_the_rounds_with_each_other():
    ours = result(
        "ours-h264", write_s=[1.0, 4.0], window_ms=[10.0, 20.0], num_bytes=15, psnr_db=32.0
    )
    rival = result(
        "zarr-jpeg", write_s=[3.0, 12.0], window_ms=[20.0, 40.0], num_bytes=100, psnr_db=34.5
    )
    live = [LiveResult(4.0, 100, 0, 0, 1.0, 0.1), LiveResult(4.0, 100, 2, 1, 1.0, 0.1)]
    found = requirements({"ours-h264": ours, "zarr-jpeg": rival}, [], live)
    assert [(r.figure, r.verdict()) for r in found] == [
        (3.0, "pass"),
        (0.15, "pass"),
        (2.5, "FAIL"),
        (2.0, "pass"),
        (0.25, "pass"),
        (3.0, "FAIL"),
        (None, "not measured"),
        (None, "not measured"),
        (None, "not measured"),
    ]


def test_points_of_the_chart_are_times_and_errors():
    ours = result(
        "ours-h264", write_s=[2.0, 3.0, 4.0], window_ms=[9.0], num_bytes=15_000_000, psnr_db=28.13
    )
    write, read = panels({"ours-h264": ours})
    (point,) = write.points
    assert (point.time_low, point.time, point.time_high) == pytest.approx((0.2, 0.3, 0.4))
    assert point.error == pytest.approx(10.0, rel=1e-3)
    assert point.is_ours
    assert read.points[0].time == 9
    assert rms_levels(100.0) == pytest.approx(0.00255)


@contextmanager
def no_bar(what, num_steps):
    yield lambda name: None


def options(*words):
    parser = stage_parser("store")
    benchmark.add_options(parser)
    return parser.parse_args(list(words))


@pytest.mark.parametrize("words", [("--seconds", "0.4"), ("--rounds", "0"), ("--windows", "-1")])
def test_runs_that_measure_nothing_are_refused(words, tmp_path):
    with pytest.raises(InvalidInputError, match=words[0]):
        benchmark.measure(options(*words), tmp_path, no_bar)


def test_unknown_designs_name_the_known_ones(tmp_path):
    with pytest.raises(UnknownNameError, match=r"'parquet'.*ours-h264"):
        benchmark.measure(options("--designs", "zarr-jpeg,parquet"), tmp_path, no_bar)
