"""MCAP files of others that cannot be read: limits, mistakes, cuts and damage are our errors."""

import contextlib
import random
import tracemalloc

import pytest
from mcap.writer import CompressionType

from dextouch.bridges import import_streams
from dextouch.bridges.import_mcap import import_any_mcap
from dextouch.bridges.import_recording import ImportAttributes
from dextouch.bridges.mcap import export_mcap
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
)
from tests.unit.bridges.foreign_files import (
    GOLDEN,
    PIXELS,
    T0,
    Recorder,
    encoded,
    foxglove_file,
)
from tests.unit.bridges.takes import write_recording


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def test_what_cannot_be_read_is_named(store, tmp_path):
    recorder = Recorder(tmp_path / "odd.mcap", CompressionType.ZSTD)
    recorder.channel("/ros1", "std_msgs/String", "ros1msg", b"string data", "ros1")
    recorder.channel("/bad", "foxglove.Log", "protobuf", b"\xff\xff")
    recorder.channel("/idl", "x/msg/Y", "ros2idl", b"struct", "cdr")
    for topic in ("/ros1", "/bad", "/idl"):
        recorder.raw(topic, b"\x00\x01\x00\x00", T0)
    jpeg, big = encoded(PIXELS[0], "jpeg"), {"width": 60000, "height": 60000, "step": 180000}
    recorder.add("/cut", "CompressedImage", T0, data=jpeg[: len(jpeg) // 2])
    recorder.add("/webp", "CompressedImage", T0, data=encoded(PIXELS[0], "webp"))
    recorder.add("/huge", "RawImage", T0, data=b"abc", encoding="rgb8", **big)
    recorder.add("/bayer", "RawImage", T0, data=b"abc", encoding="bayer_rggb8")
    png = encoded(PIXELS[0], "png")
    recorder.add("/damaged", "CompressedImage", T0, data=png[:500] + b"\0" * 90 + png[590:])
    recorder.add("/vp8", "CompressedVideo", T0, data=b"abc", format="vp8")
    recorder.add("/pose", "PoseInFrame", T0, frame_id="a")
    recorder.add("/pose", "PoseInFrame", T0 + 1, frame_id="a")
    recorder.add("/pose", "PoseInFrame", T0 + 2, frame_id="b")
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    reasons = {one.source: one.reason for one in report.refused}
    expected = {
        "/ros1": "rosbags-convert",
        "/bad": "schema 'foxglove.Log' is not valid",
        "/idl": "ros2idl",
        "/cut": "was cut",
        "/webp": "expected JPEG or PNG",
        "/huge": "60000 x 60000 pixels",
        "/bayer": "pixel format 'bayer_rggb8'",
        "/damaged": "damaged",
        "/vp8": "video format 'vp8'",
        "/pose": "in 'b'",
    }
    assert reasons.keys() == expected.keys()
    for source, part in expected.items():
        assert part in reasons[source], source
    counts = {one.stream: one.num_samples for one in report.imported}
    assert counts == {"pose": 2, "damaged": 0}


def test_limits_and_mistakes_are_errors(store, tmp_path, monkeypatch):
    path = foxglove_file(tmp_path / "fox.mcap")
    for mapping, part in (
        ({"wrist_left": "/nowhere"}, "valid: /cam/deep"),
        ({"wrist_left": "/cam/jpeg"}, "expected poses of one body"),
        ({"camera_head": "/pose"}, "expected images"),
        ({"keypoints_left": "/log"}, "expected points"),
        ({"tactile_left": "/joints"}, "expected the 320 taxels in kPa of 'dextouch_v1'"),
    ):
        with pytest.raises(InvalidInputError, match=part):
            import_any_mcap(path, store, ImportAttributes(mapping=mapping))
    monkeypatch.setattr(import_streams, "MAX_SAMPLES", 20)
    with pytest.raises(LimitExceededError, match="more than 20 samples"):
        import_any_mcap(path, store, ImportAttributes())
    monkeypatch.undo()
    monkeypatch.setattr(import_streams, "MAX_STREAMS", 2)
    mapping = {"camera_head": "/cam/png"}
    report = import_any_mcap(path, store, ImportAttributes(mapping=mapping))
    assert report.imported[0].stream == "camera_head"
    assert len(report.imported) == 2
    assert "--map those" in {one.source: one.reason for one in report.refused}["/points"]
    with pytest.raises(ConflictError, match="--id-prefix"):
        import_any_mcap(path, store, ImportAttributes())
    write_recording(store, "own", count=5)
    export_mcap(store.recording("own"), tmp_path / "own.mcap")
    with pytest.raises(InvalidInputError, match="leave --map out"):
        import_any_mcap(tmp_path / "own.mcap", store, ImportAttributes(mapping=mapping))
    other = EpisodeStore(tmp_path / "other")
    assert import_any_mcap(tmp_path / "own.mcap", other, ImportAttributes()).recording_id == "own"


def test_a_cut_file_says_where_and_what_was_readable(store, tmp_path):
    path = foxglove_file(tmp_path / "fox.mcap")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    said = r"at byte \d+: .* bytes requested.*[1-9]\d* samples of \d+ streams were readable before"
    with pytest.raises(CorruptDataError, match=said):
        import_any_mcap(path, store, ImportAttributes())
    assert store.list(kind="recording") == []


def test_a_forged_count_allocates_nothing(store, tmp_path):
    """A ROS 2 array that announces 4 billion numbers, of which the message has none."""
    pytest.importorskip("mcap_ros2")
    recorder = Recorder(tmp_path / "forged.mcap")
    text = b"float64[] data\nuint8[] raw\nstring[] names"
    recorder.channel("/forged", "x/msg/Y", "ros2msg", text, "cdr")
    for start in (b"\xff\xff\xff\xff", b"\0\0\0\0\xff\xff\xff\xff", b"\0\0\0\0" * 2 + b"\xff" * 4):
        recorder.raw("/forged", b"\0\1\0\0" + start + b"\0" * 40, T0)
    recorder.done()
    tracemalloc.start()
    with pytest.raises(InvalidInputError, match="not a x/msg/Y"):
        import_any_mcap(recorder.path, store, ImportAttributes())
    assert tracemalloc.get_traced_memory()[1] < 1 << 24
    tracemalloc.stop()


def test_damaged_files_give_our_errors(store, tmp_path):
    """Bits flipped anywhere, in chunks without checksums too: errors of ours, or an import."""
    pytest.importorskip("mcap_ros2")
    chance = random.Random(3)
    plain = tmp_path / "plain.mcap"
    recorder = Recorder(plain, CompressionType.NONE)
    recorder.writer._Writer__enable_crcs = False
    recorder.add("/pose", "PoseInFrame", T0, frame_id="a")
    recorder.add("/joints", "JointStates", T0, joints=[{"name": "a", "position": 1}])
    recorder.add("/cloud", "PointCloud", T0, point_stride=4, data=bytes(40))
    recorder.done()
    for source, count in ((plain.read_bytes(), 100), (GOLDEN.read_bytes(), 15)):
        for number in range(count):
            data = bytearray(source)
            for _ in range(chance.choice((1, 1, 4))):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
            path = tmp_path / f"flipped-{number}.mcap"
            path.write_bytes(data)
            with contextlib.suppress(DexTouchError):
                import_any_mcap(path, store, ImportAttributes(id_prefix=f"{len(source)}-"))
            path.unlink()
