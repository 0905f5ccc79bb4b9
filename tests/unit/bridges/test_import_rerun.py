"""Rerun files that rerun-sdk wrote become recordings with the same numbers."""

import io
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install '.[rerun]'")

from dextouch.bridges.import_recording import ImportAttributes  # noqa: E402
from dextouch.bridges.import_rerun import import_rrd  # noqa: E402
from dextouch.bridges.rerun import export_rrd  # noqa: E402
from dextouch.episodes import EpisodeStore  # noqa: E402
from dextouch.errors import InvalidInputError  # noqa: E402
from tests.unit.bridges.takes import write_recording  # noqa: E402

T0 = 1_700_000_000_000_000_000
VIEW = rr.ViewCoordinates.RUB
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def png(pixels):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return file.getvalue()


def rrd(path, timelines=("camera",)):
    stream = rr.RecordingStream("lab")
    stream.save(path)
    K = np.array([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]])
    stream.log("world/cam", rr.Pinhole(image_from_camera=K, width=6, height=4), static=True)
    for k in range(6):
        stream.set_time("frame", sequence=k)
        for name in timelines:
            stream.set_time(name, timestamp=np.datetime64(T0 + k * 10**8, "ns"))
        turned = rr.Quaternion(xyzw=[0, 0, 0.6, 0.8])
        stream.log("world/hand", rr.Transform3D(translation=[k, 2, 3], quaternion=turned))
        stream.log("world/turn", rr.Transform3D(translation=[k, 2, 3], mat3x3=TURN))
        stream.log("world/mirror", rr.Transform3D(mat3x3=np.diag([1.0, 1, -1])))
        stream.log("world/points", rr.Points3D(np.full((2 + k % 2, 3), k)))
        stream.log("plots/force", rr.Scalars([k, 2.5]))
        stream.log("plots/cells", rr.AnyValues(kpa=np.arange(4.0) + k))
        stream.log("world/cam/image", rr.Image(np.full((4, 6, 3), k, np.uint8)))
        stream.log("bgr", rr.Image(np.full((4, 6, 3), (1, 2, k), np.uint8), color_model="BGR"))
        stream.log("depth", rr.DepthImage(np.full((4, 6), 1000 + k, np.uint16)))
        blob = png(np.full((4, 6, 3), 9 * k, np.uint8))
        stream.log("png", rr.EncodedImage(contents=blob, media_type="image/png"))
        stream.log("text", rr.TextLog("hello"))
    stream.flush()
    stream.disconnect()
    return path


def test_what_rerun_wrote_arrives(store, tmp_path):
    path = rrd(tmp_path / "a.rrd")
    about = ImportAttributes(
        mapping={"camera_head": "/world/cam/image", "wrist_left": "/world/hand"}
    )
    report = import_rrd(path, store, about)
    recording = store.recording("a")
    for name in recording.streams:
        t_ns = recording.stamps(name).t_host_ns
        assert t_ns.tolist() == [T0 + k * 10**8 for k in range(6)]
    k = np.arange(6)
    # Rerun has xyzw, the store w first.
    hand = recording.values("wrist_left", 0, 6)
    np.testing.assert_allclose(hand[4], [4, 2, 3, 0.8, 0, 0, 0.6], atol=1e-7)
    turn = recording.values("world_turn", 0, 1)[0]
    np.testing.assert_allclose(turn, [0, 2, 3, 0.5**0.5, 0, 0, 0.5**0.5], atol=1e-7)
    points = recording.values("world_points", 0, 2)
    assert np.isnan(points[0, 2]).all()
    assert points[1].tolist() == [[1, 1, 1]] * 3
    np.testing.assert_array_equal(recording.values("plots_force", 0, 6)[:, 0], k)
    assert recording.values("plots_cells", 5, 6)[0].tolist() == [5, 6, 7, 8]
    np.testing.assert_array_equal(recording.values("camera_head", 0, 6)[:, 1, 2, 0], k)
    assert recording.values("bgr", 3, 4)[0, 0, 0].tolist() == [3, 2, 1]
    np.testing.assert_array_equal(recording.values("depth", 0, 6)[:, 0, 0], 1000 + k)
    np.testing.assert_array_equal(recording.values("png", 0, 6)[:, 0, 0, 2], 9 * k)
    # Rerun's pinhole counts pixels from the corner, as the store.
    K = recording.attributes.calibration["K_head"]
    assert K == ((5, 0, 3), (0, 5, 2), (0, 0, 1))
    assert recording.streams["wrist_left"].frame == "world"
    assert [one.source for one in report.refused] == ["/world/mirror", "/text"]
    assert report.kept_as_numbers.keys() == {"world_points", "plots_cells"}


def test_the_timeline_is_chosen(store, tmp_path):
    path = rrd(tmp_path / "two.rrd", ("camera", "robot"))
    for name in (None, "frame", "nothing"):
        with pytest.raises(InvalidInputError, match=r"\['camera', 'log_time', 'robot'\] are times"):
            import_rrd(path, store, ImportAttributes(), timeline=name)
    assert import_rrd(path, store, ImportAttributes(), timeline="robot").imported
    path = rrd(tmp_path / "none.rrd", ())
    report = import_rrd(path, store, ImportAttributes())
    assert abs(report.imported[0].duration_s) < 60
    assert ("frame", "timeline") in [(one.source, one.schema) for one in report.refused]
    rr.RecordingStream("lab").save(tmp_path / "empty.rrd")
    with pytest.raises(InvalidInputError, match="nothing that was logged at a time"):
        import_rrd(tmp_path / "empty.rrd", store, ImportAttributes())


def test_an_export_of_ours_comes_back_as_numbers(store, tmp_path):
    reader = write_recording(store, "take")
    export_rrd(reader, tmp_path / "take.rrd")
    report = import_rrd(tmp_path / "take.rrd", store, ImportAttributes(id_prefix="again-"))
    again = store.recording("again-take")
    (wrist,) = (one.stream for one in report.imported if one.source == "/world/wrist_left")
    count = again.num_samples(wrist)
    np.testing.assert_array_equal(
        again.stamps(wrist).t_host_ns, reader.stamps("wrist_left").t_host_ns
    )
    ours = reader.values("wrist_left", 0, count)
    np.testing.assert_allclose(again.values(wrist, 0, count)[:, :3], ours[:, :3], rtol=1e-6)


def saved(path, name="lab"):
    stream = rr.RecordingStream("lab", recording_id=name)
    stream.save(path)
    return stream


def at(stream, time_s):
    stream.set_time("camera", timestamp=np.datetime64(T0 + int(time_s * 1e9), "ns"))


def test_components_that_rows_leave_out_are_the_newest_in_time(store, tmp_path):
    """Each part has a chunk of its own, later ones first in the file."""
    stream = saved(tmp_path / "a.rrd")
    for k in reversed(range(5)):
        at(stream, k)
        stream.log("hand", rr.Transform3D.from_fields(translation=[k, 0, 0]))
        at(stream, k + 0.5)
        turned = rr.Quaternion(xyzw=[0, 0, np.sin(k / 10), np.cos(k / 10)])
        stream.log("hand", rr.Transform3D.from_fields(quaternion=turned))
        at(stream, k + 0.7)
        stream.log("hand", rr.Scalars([k]))
        form = {"width": 2, "height": 3 + k // 3, "channel_datatype": "u8", "color_model": "l"}
        stream.log("image", rr.Image.from_fields(format=rr.components.ImageFormat(**form)))
        at(stream, k + 0.8)
        pixels = np.full(2 * (3 + k // 3), k, np.uint8)
        stream.log("image", rr.Image.from_fields(buffer=pixels))
    stream.disconnect()
    about = ImportAttributes(mapping={"wrist_left": "/hand:Transform3D", "x": "/hand:Scalars"})
    report = import_rrd(tmp_path / "a.rrd", store, about)
    recording = store.recording("a")
    # Only rows with a part of the transform are poses.
    assert recording.num_samples("wrist_left") == 10
    poses = recording.values("wrist_left", 0, 10)
    expected = [
        [k, 0, 0, np.cos(j / 10), 0, 0, np.sin(j / 10)] for k in range(5) for j in (k - 1, k)
    ]
    expected[0][3:] = [1, 0, 0, 0]
    np.testing.assert_allclose(poses, expected, atol=1e-6)
    assert recording.values("x", 0, 5)[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert recording.values("image", 0, 3)[:, 2, 1].tolist() == [0, 1, 2]
    assert [(one.source, one.num_samples) for one in report.refused] == [("/image", 2)]


def test_parts_that_a_row_clears_have_their_defaults_and_whole_numbers_are_exact(store, tmp_path):
    """Every call of Transform3D up to Rerun 0.23 clears the parts that it leaves out."""
    stream = saved(tmp_path / "a.rrd")
    at(stream, 0)
    turned = rr.Quaternion(xyzw=[0, 0, 0.6, 0.8])
    stream.log("hand", rr.Transform3D.from_fields(clear_unset=True, quaternion=turned))
    at(stream, 1)
    stream.log("hand", rr.Transform3D.from_fields(clear_unset=True, translation=[1, 2, 3]))
    stream.log("stamp", rr.AnyValues(ns=T0 + 1))
    for number in (2**63, 2**60, 5):
        stream.log("big", rr.AnyValues(big=np.array([number], dtype=np.uint64)))
    stream.disconnect()
    report = import_rrd(tmp_path / "a.rrd", store, ImportAttributes())
    assert store.recording("a").values("stamp", 0, 1).tolist() == [[T0 + 1]]
    poses = store.recording("a").values("hand", 0, 2)
    np.testing.assert_allclose(poses, [[0, 0, 0, 0.8, 0, 0, 0.6], [1, 2, 3, 1, 0, 0, 0]], atol=1e-6)
    assert store.recording("a").values("big", 0, 3)[:, 0].tolist() == [2.0**63, 2.0**60, 5.0]
    notes = {one.source: one.notes for one in report.imported}
    assert not report.refused
    assert notes["/big"][0] == "above 2^53, rounded"


def test_what_is_left_out_is_said(store, tmp_path):
    for name in ("first", "second"):
        stream = saved(tmp_path / f"{name}.rrd", name)
        for k in range(3):
            at(stream, k)
            stream.log("cam", rr.Pinhole(focal_length=50, width=6, height=4, camera_xyz=VIEW))
            stream.log("cam", rr.Image(np.full((4, 6, 3), k, np.uint8)))
            stream.log("other", rr.Pinhole(focal_length=99, width=6, height=4))
            stream.log("deep", rr.DepthImage(np.full((4, 6), k, np.uint16), meter=1000.0))
            stream.log("points", rr.Points3D([[0, 0, 1]], labels=["a"]))
        stream.disconnect()
    both = tmp_path / "both.rrd"
    whole = [(tmp_path / f"{name}.rrd") for name in ("first", "second")]
    subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "merge", *whole, "-o", both],
        check=True,
        capture_output=True,
    )
    report = import_rrd(both, store, ImportAttributes(mapping={"camera_head": "/cam"}))
    K = store.recording("both").attributes.calibration["K_head"]
    assert K == ((50, 0, 3), (0, 50, 2), (0, 0, 1))
    # A pinhole is of its entity and of those below, not of others beside it.
    assert "K_deep" not in store.recording("both").attributes.calibration
    notes = {one.source: one.notes for one in report.imported}
    assert "1000 are one metre" in notes["/deep"][0]
    assert notes["/points"] == ("left out: labels",)
    reasons = {one.source: one.reason for one in report.refused}
    assert reasons["/cam"] == "left out: camera_xyz"
    assert reasons["/other"] == "no images of (4, 6) pixels at or below it"
    assert "only the first, 'first', is imported" in reasons["second"]


# Imports damaged copies of a file from the number argv[3] on, and says each number first.
CHILD = """
import contextlib, pathlib, random, sys
from dextouch.bridges.import_recording import ImportAttributes
from dextouch.bridges.import_rerun import import_rrd
from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError
source, folder = pathlib.Path(sys.argv[1]).read_bytes(), pathlib.Path(sys.argv[2])
chance, store = random.Random(3), EpisodeStore(folder / "store")
for number in range(40):
    data = bytearray(source)
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    if number < int(sys.argv[3]):
        continue
    print(number, flush=True)
    path = folder / "flipped.rrd"
    path.write_bytes(data if number else data[: len(data) // 2])
    with contextlib.suppress(DexTouchError):
        import_rrd(path, store, ImportAttributes(id_prefix=f"{number}-"))
"""


def test_damaged_files_give_our_errors(tmp_path):
    # In a process of its own: rerun's reader itself may abort at damaged bytes.
    rrd(tmp_path / "a.rrd")
    first, num_aborted = 0, 0
    while first < 40:
        done = subprocess.run(
            [sys.executable, "-c", CHILD, str(tmp_path / "a.rrd"), str(tmp_path), str(first)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode in {0, -signal.SIGABRT}, done.stderr[-2000:]
        num_aborted += done.returncode != 0
        first = int(done.stdout.split()[-1]) + 1
    assert num_aborted <= 4
    store = EpisodeStore(tmp_path / "store")
    for name in store.list(kind="recording"):
        store.recording(name)
