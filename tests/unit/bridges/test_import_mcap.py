"""MCAP files of others: written by mcap's and rosbags' writers, with Foxglove's own schemas."""

import base64
import struct
import tracemalloc
from functools import partial

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from dextouch.bridges import import_mcap, import_streams
from dextouch.bridges.import_mcap import import_any_mcap
from dextouch.bridges.import_messages import items_of
from dextouch.bridges.import_recording import ImportAttributes
from dextouch.bridges.import_streams import mapped_form
from dextouch.bridges.mcap import export_mcap, records
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.hands.robot_hand import RobotHand
from tests.unit.bridges.foreign_files import (
    GOLDEN,
    PIXELS,
    STEP,
    T0,
    Recorder,
    encoded,
    foxglove_file,
    json_file,
    video,
)
from tests.unit.bridges.takes import K_HEAD, write_episode, write_recording


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def test_foxglove_protobuf_arrives_sample_by_sample(store, tmp_path):
    path = foxglove_file(tmp_path / "fox.mcap")
    mapping = {"camera_head": "/cam/jpeg", "wrist_left": "/tf:left", "keypoints_left": "/poses"}
    report = import_any_mcap(path, store, ImportAttributes(mapping=mapping))
    recording = store.recording("fox")
    t_ns = T0 + STEP * np.arange(8)

    assert recording.encoded_images("camera_head", 2, 3) == [encoded(PIXELS[2], "jpeg")]
    np.testing.assert_array_equal(recording.values("cam_png", 0, 8), PIXELS)
    np.testing.assert_array_equal(recording.values("cam_raw", 0, 8), PIXELS)
    deep = PIXELS[..., 0].astype(np.uint16) * 256 + np.arange(8, dtype=np.uint16)[:, None, None]
    np.testing.assert_array_equal(recording.values("cam_deep", 0, 8), deep)
    # x y z w qx qy qz: Foxglove names the parts of a quaternion, the store has w first.
    pose = recording.values("wrist_left", 3, 4)[0]
    assert pose.tolist() == [3, 2, 3, 0.9, 0.1, 0.2, 0.3]
    assert recording.values("keypoints_left", 0, 1)[0].tolist() == [[1, 2, 3]] * 25
    points = recording.values("points", 0, 2)
    assert points[0, :2].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert np.isnan(points[0, 2]).all()
    assert points[1, 2].tolist() == [8, 9, 10, 11]
    # The joints come in another order in every second message.
    assert recording.values("joints", 0, 2).tolist() == [[0.5, 1.5]] * 2
    assert np.isnan(recording.values("joints_velocity", 0, 1)[0, 0])
    for name in recording.streams:
        assert recording.stamps(name).t_host_ns.tolist() == (t_ns + 5).tolist()
        assert recording.stamps(name).t_device_ns.tolist() == t_ns.tolist()

    about = recording.streams
    frames = {name: one.frame for name, one in about.items()}
    assert frames["camera_head"] == "cam"
    assert (frames["wrist_left"], frames["pose"], frames["points"]) == ("world", "map", "lidar")
    assert about["joints"].names == ("a", "b")
    assert about["points"].names == ("x", "y", "z", "i")
    assert (about["keypoints_left"].kind, about["wrist_left"].side) == ("keypoints", "left")
    assert about["tf_right"].nominal_rate_hz == pytest.approx(30, rel=1e-6)
    assert about["tf_right"].capabilities.device_time
    # Half a pixel: Foxglove counts from the first pixel's centre, the store from its corner.
    K = recording.attributes.calibration["K_head"]
    assert K == ((50, 0, 32), (0, 50, 24), (0, 0, 1))
    assert recording.attributes.calibration["distortion_head"] == ((0.1, 0.2, 0, 0, 0),)

    assert report.kept_as_numbers.keys() == {"points", "log"}
    assert [(one.source, one.reason) for one in report.refused] == [("/nothing", "no messages")]
    assert {one.num_samples for one in report.imported} == {8}
    assert "message" in "\n".join(report.lines())


def test_json_by_the_documented_schemas_and_of_anyone(store, tmp_path):
    recorder = Recorder(tmp_path / "json.mcap", CompressionType.NONE)
    recorder.channel("/image", "foxglove.CompressedImage", "jsonschema", b'{"type": "object"}')
    recorder.channel("/glove", "MyGlove", "jsonschema", b'{"type": "object"}')
    recorder.channel("/bare", "", "")
    recorder.channel("/\x1b[31mred", "", "")
    for k in range(6):
        t = T0 + k * 10**7
        stamp = {"sec": t // 10**9, "nsec": t % 10**9}
        data = base64.b64encode(encoded(PIXELS[k], "jpeg")).decode()
        image = {"timestamp": stamp, "frame_id": "c", "format": "jpeg", "data": data}
        recorder.raw("/image", image, t)
        cells = {"id": "g", "state": {"battery": 0.5, "ok": True}, "taxels": [k, 1.5, 2]}
        # One comes late, so that two have one time.
        recorder.raw("/glove", cells, t - (k == 4) * 10**7)
        recorder.raw("/bare", [1, k] if k else b"{broken", t)
        recorder.raw("/\x1b[31mred", b'{"frame_id": "\\ud800", "\\ud800": 1, "big": 1e999}', t)
    recorder.raw("/glove", {"taxels": [1]}, t)
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    recording = store.recording("json")
    assert recording.encoded_images("image", 5, 6) == [encoded(PIXELS[5], "jpeg")]
    assert recording.stamps("image").t_device_ns.tolist() == [T0 + k * 10**7 for k in range(6)]
    names = ("state.battery", "state.ok", "taxels[0]", "taxels[1]", "taxels[2]")
    assert recording.streams["glove"].names == names
    assert recording.values("glove", 0, 1).tolist() == [[0.5, 1, 0, 1.5, 2]]
    # Half a surrogate pair cannot be stored, and control characters are not shown.
    assert recording.streams["s_31mred"].names == ("?", "big")
    assert "\x1b" not in "\n".join(report.lines())
    assert recording.values("bare", 0, 1).tolist() == [[1, 1]]
    (glove,) = (one for one in report.imported if one.stream == "glove")
    assert glove.num_repeated_stamps == 1
    reasons = {(one.source, one.num_samples): one.reason for one in report.refused}
    assert "numbers float64 [1]" in reasons["/glove", 1]
    assert "not JSON" in reasons["/bare", 1]


def test_ros_2_messages_that_rosbags_wrote(store):
    """Four messages a topic by rosbags 0.11.9, 10 ms apart, logged 1 ms after their stamp."""
    pytest.importorskip("mcap_ros2")
    mapping = {
        "camera_head": "/cam/image_raw/compressed",
        "wrist_left": "/tf:wrist_left",
        "keypoints_left": "/poses",
    }
    report = import_any_mcap(GOLDEN, store, ImportAttributes(mapping=mapping))
    recording = store.recording("ros2_rosbags")

    def first(name):
        return recording.values(name, 0, 1)[0]

    image = (
        np.zeros((4, 4, 6, 3), dtype=np.uint8) + np.arange(4, dtype=np.uint8)[:, None, None, None]
    )
    image[..., 0] = 9
    np.testing.assert_array_equal(recording.values("cam_image_raw", 0, 4), image)
    assert recording.encoded_images("camera_head", 0, 1)[0][:2] == b"\xff\xd8"
    # Big endian, 16 bits.
    assert recording.values("depth", 0, 4)[:, 0, 0].tolist() == [1000, 1001, 1002, 1003]
    assert first("wrist_left").tolist() == [4, 5, 6, 0.9, 0.1, 0.2, 0.3]
    assert first("tfs").tolist() == first("tf_thumb").tolist() == [4, 5, 6, 0.9, 0.1, 0.2, 0.3]
    assert first("pose").tolist() == [1, 2, 3, 0.9, 0.1, 0.2, 0.3]
    assert first("keypoints_left").tolist() == [[1, 2, 3]] * 25
    assert recording.values("joint_states", 0, 2).tolist() == [[1, 2, 3]] * 2
    assert recording.streams["joint_states"].names == ("a", "b", "c")
    raw = np.arange(48, dtype=np.uint8)
    expected = np.ndarray((3, 4), "<f4", raw.tobytes())[:, :3]
    np.testing.assert_array_equal(first("points")[:, :3], expected)
    assert first("points")[:, 3].tolist() == [12 + 13 * 256, 28 + 29 * 256, 44 + 45 * 256]
    # Two by three by its layout's dimensions.
    assert recording.values("f32", 0, 2).tolist() == [
        [[0, 1, 2], [3, 4, 5]],
        [[1, 2, 3], [4, 5, 6]],
    ]
    assert [recording.streams[name].dtype for name in ("f32", "u8")] == ["float32", "uint8"]
    assert first("i32").tolist() == [-2, -1, 0, 1]
    assert recording.streams["i32"].dtype == "int64"
    glove = recording.streams["glove"]
    assert glove.names[:6] == (
        "cells[0]",
        "cells[1]",
        "cells[2]",
        "cells[3]",
        "inner.a",
        "inner.ok",
    )
    assert first("glove").tolist() == [0, 1, 2, 3, 1.5, 1, 2, 0, 2, 0, 0, 1, 2]
    assert recording.stamps("glove").t_device_ns.tolist() == [T0 + k * 10**7 for k in range(4)]
    assert recording.stamps("glove").t_host_ns[0] == T0 + 10**6
    assert recording.stamps("f64").t_device_ns.tolist() == [-1] * 4
    assert recording.attributes.calibration["K_head"] == ((5, 0, 3), (0, 5, 2), (0, 0, 1))
    assert [(r.source, r.reason) for r in report.refused] == [("/s", "message without a number")]


@pytest.mark.parametrize(
    ("schema", "size", "kind", "names"),
    [
        # foxglove.PackedElementField and sensor_msgs/PointField number their types otherwise.
        ("foxglove.PointCloud", "point_stride", "type", "uint8 int8 uint16 int16 uint32 int32"),
        (
            "sensor_msgs/PointCloud2",
            "point_step",
            "datatype",
            "int8 uint8 int16 uint16 int32 uint32",
        ),
    ],
)
def test_points_have_fields_of_all_types(schema, size, kind, names):
    numbers = [*names.split(), "float32", "float64"]
    values = [-2 if one[0] != "u" else 200 for one in numbers]
    parts = [np.array(v, dtype=t).tobytes() for v, t in zip(values, numbers, strict=True)]
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    fields = [
        {"name": name, "offset": offset, kind: index + 1, "count": 1}
        for index, (name, offset) in enumerate(zip(numbers, offsets[:-1], strict=True))
    ]
    stride = offsets[-1]
    cloud = {"fields": fields, "data": b"".join(parts) * 2, size: stride}
    rows = {"width": 2, "height": 1, "row_step": 2 * stride} if size == "point_step" else {}
    (item,) = items_of(schema, cloud | rows)
    assert item.decode().tolist() == [values] * 2
    assert item.form.names == tuple(numbers)


def test_points_in_rows_that_end_in_padding_and_with_fields_of_count_zero():
    """PCL writes no padding, but reads it; drivers write the count 0 and any step of one row."""
    points = np.arange(24, dtype=">f4").reshape(2, 4, 3)
    padded = np.concatenate([points.view("u1").reshape(2, -1), np.full((2, 5), 9, "u1")], axis=1)
    fields = [{"name": n, "offset": 4 * k, "datatype": 7, "count": 0} for k, n in enumerate("xyz")]
    cloud = {"fields": fields, "point_step": 12, "is_bigendian": True}
    rows = {"width": 4, "height": 2, "row_step": 53, "data": padded.tobytes()[:-5]}
    read = partial(items_of, "sensor_msgs/PointCloud2")
    assert read(cloud | rows)[0].decode().tolist() == points.reshape(8, 3).tolist()
    one = {"width": 8, "height": 1, "row_step": 0, "data": points.tobytes()}
    assert read(cloud | one)[0].decode().tolist() == points.reshape(8, 3).tolist()
    for wrong in ({"row_step": 47}, {"height": 3}, {"width": -4, "height": -2}, {"width": 5}):
        with pytest.raises(CorruptDataError, match="bytes for"):
            read(cloud | rows | wrong)
    fields[0]["count"] = 3
    with pytest.raises(InvalidInputError, match="'x' of 3 numbers of type 7"):
        read(cloud | rows)


def test_joints_of_one_name_are_not_mistaken_for_each_other(store, tmp_path):
    def joints(*pairs):
        return {"joints": [{"name": name, "position": value} for name, value in pairs]}

    messages = [
        ("/j", "foxglove.JointStates", joints(("a", 1), ("b", 2), ("a", 3))),
        ("/j", "foxglove.JointStates", joints(("a", 4), ("b", 5), ("a", 6))),
        ("/j", "foxglove.JointStates", joints(("a", 1), ("a", 2), ("b", 3))),
        (
            "/none",
            "foxglove.PointCloud",
            {"data": "", "point_stride": 4, "fields": [{"name": "x", "offset": 0, "type": 7}]},
        ),
    ]
    report = import_any_mcap(json_file(tmp_path / "j.mcap", messages), store, ImportAttributes())
    assert store.recording("j").values("j", 0, 2).tolist() == [[1, 2, 3], [4, 5, 6]]
    reasons = {one.source: one.reason for one in report.refused}
    assert "of other names" in reasons["/j"]
    assert reasons["/none"] == "samples without a number, numbers float32 [0, 1]"


def stripped(reader, store, folder, name):
    """What becomes of an export of ours that another tool filtered."""
    export_mcap(reader, folder / "whole.mcap", overwrite=True)
    path, channels = folder / f"{name}.mcap", {}
    writer = Writer(str(path))
    writer.start()
    with (folder / "whole.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "protobuf", number)
            stamps = (message.publish_time, message.sequence)
            writer.add_message(channels[channel.id], message.log_time, message.data, *stamps)
    writer.finish()
    import_any_mcap(path, store, ImportAttributes())
    return store.recording(name)


def test_a_stripped_export_of_ours_has_its_matrices_stamps_and_types(store, tmp_path):
    episode, wrist = write_episode(store), ((50.0, 0.0, 31.25), (0.0, 50.0, 30.0), (0.0, 0.0, 1.0))
    episode.attributes.calibration.update(K_wrist_left=wrist)
    found = stripped(episode, store, tmp_path, "e")
    for name, K in (("K_head", K_HEAD), ("K_wrist_left", wrist)):
        np.testing.assert_allclose(found.attributes.calibration[name], K)
    np.testing.assert_array_equal(found.values("action", 0, 21), episode.read("action").values)
    assert found.streams["action"].names[9] == "wrist_right[0]"
    assert found.stamps("action").sequence.tolist() == [-1] * 21

    recording = write_recording(store)
    found = stripped(recording, store, tmp_path, "r")
    for name in ("tactile_left", "camera_head", "wrist_left"):
        ours, theirs = recording.stamps(name), found.stamps(name)
        expected = np.where(ours.t_device_ns > 0, ours.t_device_ns, -1)
        assert theirs.t_device_ns.tolist() == expected.tolist()
        assert theirs.sequence[1:].tolist() == ours.sequence[1:].tolist()
        assert found.streams[name].dtype == recording.streams[name].dtype


def test_numbers_are_neither_dropped_nor_rounded_unsaid(store, tmp_path):
    stamped = {"header": {"stamp": {"sec": 1, "nsec": 2}, "seq": 7}, "v": 1}
    messages = [
        ("/a", "", {"timestamp": 12345, "v": 1}),
        ("/b", "", {"big": 0, "list": [1, 2]}),
        ("/b", "", {"big": 2**60 + 1, "list": [1, 2**53 + 1]}),
        ("/c", "", stamped),
        ("/d", "", {"dextouch_sequence": "a", "dextouch_t_device_ns": 10**30, "v": 1}),
        ("/d", "", {"dextouch_sequence": 10**30, "timestamp": {"sec": 1.75}, "v": 2}),
        ("/deep", "", b'{"a":' * 900 + b"1" + b"}" * 900),
        ("/lists", "", b'{"a":' + b"[" * 900 + b"1" + b"]" * 900 + b"}"),
        ("/empty", "", b'{"a":[' + b"{}," * (1 << 20) + b"{}]}"),
    ]
    report = import_any_mcap(json_file(tmp_path / "a.mcap", messages), store, ImportAttributes())
    streams = store.recording("a").streams
    assert (streams["a"].names, streams["c"].names) == (("timestamp", "v"), ("header.seq", "v"))
    assert store.recording("a").stamps("c").t_device_ns.tolist() == [10**9 + 2]
    odd = store.recording("a").stamps("d")
    assert (odd.sequence.tolist(), odd.t_device_ns.tolist()) == ([-1, -1], [-1, 1_750_000_000])
    notes = {one.source: one.notes for one in report.imported}
    assert notes["/b"] == ("above 2^53, rounded: big, list",)
    reasons = {one.source: one.reason for one in report.refused}
    assert "more than 64 deep" in reasons["/deep"]
    assert "more than 64 deep" in reasons["/lists"]
    assert "more than 1048576 values" in reasons["/empty"]


def test_whole_numbers_of_a_message_stay_whole(store, tmp_path):
    """As counts of raw cells, which as floats would be taxels in kPa."""
    pytest.importorskip("mcap_ros2")
    recorder = Recorder(tmp_path / "cells.mcap")
    fields = (b"uint16[360] cells", b"int64 n\nuint64 u", b"int64 n\nfloat64[] x", b"uint64 u")
    for k, field in enumerate(fields):
        recorder.channel(f"/m{k}", f"lab/msg/M{k}", "ros2msg", field, "cdr")
    cells = np.arange(360, dtype="<u2")
    for k, body in enumerate(
        (
            cells.tobytes(),
            struct.pack("<qQ", 2**60 + 1, 5),
            struct.pack("<qIxxxxd", 3, 1, 0.5),
            struct.pack("<Q", 2**64 - 2),
        )
    ):
        recorder.raw(f"/m{k}", b"\0\1\0\0" + body, T0)
    about = ImportAttributes(mapping={"tactile_left": "/m0"})
    report = import_any_mcap(recorder.done(), store, about)
    recording = store.recording("cells")
    stream = recording.streams["tactile_left"]
    assert (stream.unit, stream.kind, stream.shape) == ("counts", "tactile", (360,))
    assert recording.values("tactile_left", 0, 1)[0].tolist() == cells.tolist()
    assert recording.values("m1", 0, 1).tolist() == [[2**60 + 1, 5]]
    assert recording.values("m2", 0, 1).tolist() == [[3, 0.5]]
    assert [one.notes for one in report.imported if one.notes] == [("above 2^53, rounded: u",)]


def test_whole_numbers_beyond_int64_make_their_topic_float64(store, tmp_path):
    pytest.importorskip("mcap_ros2")
    recorder, numbers = Recorder(tmp_path / "a.mcap"), [7, 2**64 - 1, 2**60, 2**63 - 1, 2**63]
    recorder.channel("/u", "lab/msg/U", "ros2msg", b"uint64 u", "cdr")
    for k, number in enumerate(numbers):
        recorder.raw("/u", b"\0\1\0\0" + struct.pack("<Q", number), T0 + k)
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    assert not report.refused
    assert store.recording("a").values("u", 0, 5)[:, 0].tolist() == [float(n) for n in numbers]
    assert "float64, as not all samples are int64; rounded above 2^53" in report.imported[0].notes


@pytest.mark.parametrize(
    ("count", "unit", "dtype"), [(320, "kPa", "float32"), (360, "counts", "int64")]
)
@pytest.mark.parametrize("is_typed", [True, False])
def test_whole_numbers_as_touch_are_what_their_count_says(count, unit, dtype, is_typed):
    (item,) = items_of("lab/Touch", {"p": list(range(count))}, is_typed=is_typed)
    if count == 360 and not is_typed:
        with pytest.raises(InvalidInputError, match=r"numbers float64 \[360\], expected the 320"):
            mapped_form("tactile_left", item.form)
        return
    form, convert, _ = mapped_form("tactile_left", item.form)
    assert (form.unit, form.dtype) == (unit, dtype)
    assert convert(item.decode()).tolist() == list(range(count))


def test_joints_of_our_hands_have_our_order_whatever_that_of_the_message():
    ours = [name for side in ("left", "right") for name in RobotHand(side).joint_names]
    # As of a whole robot, whose publisher sorts the names.
    names = sorted(["arm_1", "arm_2", *ours])
    message = {"name": names, "position": [float(len(name)) for name in names]}
    (item,) = items_of("sensor_msgs/JointState", message)
    form, convert, _ = mapped_form("joints_measured", item.form)
    assert form.names == tuple(ours)
    assert convert(item.decode()).tolist() == [len(name) for name in ours]
    (item,) = items_of("sensor_msgs/JointState", {"name": ["b", "a"], "position": [1.0, 2.0]})
    form, convert, _ = mapped_form("joints_measured", item.form)
    assert (form.names, convert(item.decode()).tolist()) == (("b", "a"), [1, 2])


def test_rectified_images_have_the_matrix_of_their_projection(store, tmp_path):
    size = {"width": 64, "height": 48, "frame_id": "cam"}
    K, P = [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1], [50, 0, 30.5, 0, 0, 50, 22.5, 0, 0, 0, 1, 0]
    lens = {"distortion_model": "plumb_bob", "D": [0.1, 0, 0, 0, 0], "K": K} | size
    data = base64.b64encode(encoded(PIXELS[0], "jpeg")).decode()
    image = {"frame_id": "cam", "format": "jpeg", "data": data}
    images = [(f"/cam/image_{n}", "foxglove.CompressedImage", image) for n in ("raw", "rect")]
    for name, more in (("a", {"P": P}), ("b", {})):
        messages = [("/cam/info", "foxglove.CameraCalibration", lens | more), *images]
        path = json_file(tmp_path / f"{name}.mcap", messages)
        report = import_any_mcap(path, store, ImportAttributes())
        found = store.recording(name).attributes.calibration
        assert found["K_cam_image_raw"] == ((60, 0, 32), (0, 60, 24), (0, 0, 1))
        if more:
            assert found["K_cam_image_rect"] == ((50, 0, 31), (0, 50, 23), (0, 0, 1))
            assert not np.any(found["distortion_cam_image_rect"])
        else:
            assert "K_cam_image_rect" not in found
            assert "no P" in report.refused[0].reason


def test_quantised_inverse_depth_becomes_metres(store, tmp_path):
    """As compressed_depth_image_transport has it: depth = a / (value − b)."""
    values = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    data = struct.pack("<iff", 0, 100.0, 1.0) + encoded(values, "png")
    message = {"format": "32FC1; compressedDepth png", "data": base64.b64encode(data).decode()}
    path = json_file(tmp_path / "a.mcap", [("/depth", "sensor_msgs/CompressedImage", message)])
    import_any_mcap(path, store, ImportAttributes())
    found = store.recording("a").values("depth", 0, 1)[0]
    assert np.isnan(found[0, 0])
    np.testing.assert_allclose(found.ravel()[1:], 100 / (values.ravel()[1:] - 1.0), rtol=1e-6)


def test_memory_of_the_whole_is_limited(store, tmp_path, monkeypatch):
    def cloud(count):
        fields = [{"name": "x", "offset": 0, "type": 7}]
        data = base64.b64encode(bytes(4 * count)).decode()
        return {"point_stride": 4, "fields": fields, "data": data}

    recorder = Recorder(tmp_path / "a.mcap")
    recorder.channel("/p", "foxglove.PointCloud", "jsonschema", b"{}")
    for k, count in enumerate((1000, 1, 1, 1)):
        recorder.raw("/p", cloud(count), T0 - k)
    monkeypatch.setattr(import_streams, "MAX_HELD_BYTES", 15_000)
    with pytest.raises(InvalidInputError, match="too much to sort"):
        import_any_mcap(recorder.done(), store, ImportAttributes())
    path = tmp_path / "b.mcap"
    writer = Writer(str(path), chunk_size=1 << 28, compression=CompressionType.LZ4)
    writer.start()
    channel = writer.register_channel("/x", "json", 0)
    for k in range(20_000):
        writer.add_message(channel, k, b"1", k)
    writer.finish()
    # Of the 620 kB of messages not all are in memory as objects.
    tracemalloc.start()
    assert sum(1 for _ in records(path)) > 20_000
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_publishers_of_one_topic_have_streams_of_their_own(store, tmp_path):
    def joints(*names):
        parts = {"position": [len(name) for name in names], "velocity": [0.5] * len(names)}
        return ("/joint_states", "sensor_msgs/JointState", {"name": list(names)} | parts)

    arm, hand = joints("elbow", "wrist"), joints("thumb", "index", "wrist")
    path = json_file(tmp_path / "a.mcap", [arm, hand, joints("wrist", "elbow"), arm])
    report = import_any_mcap(path, store, ImportAttributes())
    counts = {one.source: (one.num_samples, one.shape) for one in report.imported}
    assert counts == {
        "/joint_states:elbow": (3, (2,)),
        "/joint_states:elbow:velocity": (3, (2,)),
        "/joint_states:index": (1, (3,)),
        "/joint_states:index:velocity": (1, (3,)),
    }
    assert store.recording("a").values("joint_states_elbow", 0, 3).tolist() == [[5, 5]] * 3


def test_a_schema_is_read_once(store, tmp_path, monkeypatch):
    read, count = import_mcap._decoder_of, []
    monkeypatch.setattr(import_mcap, "_decoder_of", lambda *a: count.append(a) or read(*a))
    messages = [(f"/{k}", "x", {"v": k}) for k in range(5)]
    recorder = Recorder(tmp_path / "a.mcap")
    number = recorder.writer.register_schema("x", "jsonschema", b"{}")
    for topic, _, message in messages:
        recorder.channels[topic] = recorder.writer.register_channel(topic, "json", number)
        recorder.raw(topic, message, T0)
    recorder.channels["/none"] = recorder.writer.register_channel("/none", "cdr", number)
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    assert (len(count), len(report.imported)) == (1, 5)


@pytest.mark.parametrize(
    ("codec", "keyint", "note"),
    [
        ("libx264", 8, "video kept"),
        ("libx264", 16, "h264 decoded, encoded as h264"),
        ("libx264", 30, "h264 decoded, encoded as h264"),
        ("libx265", 30, "h265 decoded, encoded as h264"),
    ],
)
def test_video_is_kept_or_decoded(codec, keyint, note, store, tmp_path):
    units = video(20, keyint=keyint, codec=codec)
    recorder = Recorder(tmp_path / "video.mcap")
    # It begins in the middle: images before the first key frame cannot be decoded.
    first = -3 if keyint == 30 else 0
    units = [units[1]] * -first + units
    form = {"libx264": "h264", "libx265": "h265"}[codec]
    for k, data in enumerate(units):
        recorder.add("/video", "CompressedVideo", T0 + k * STEP, data=data, format=form)
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    recording = store.recording("video")
    (stream,) = report.imported
    assert stream.notes == (note,)
    assert stream.num_samples == 20
    if keyint == 8:
        assert recording.encoded_images("video", 0, 20) == units
    level = recording.values("video", 0, 20).mean((1, 2, 3))
    np.testing.assert_allclose(level, [20 * (k % 10) for k in range(20)], atol=6)
    assert recording.stamps("video").t_device_ns[0] == T0 - first * STEP
    assert sum(one.num_samples for one in report.refused) == -first


@pytest.mark.parametrize(
    ("codec", "lost"),
    [("libx264", {5}), ("libx264", {5, 6, 7}), ("libx264", set(range(8, 24))), ("libx265", {5, 6})],
)
def test_images_after_lost_packets_are_refused_until_a_key_frame(codec, lost, store, tmp_path):
    """Sixteen images later frame_num is the one that was expected."""
    recorder = Recorder(tmp_path / "video.mcap")
    form = {"libx264": "h264", "libx265": "h265"}[codec]
    for k, data in enumerate(video(60, keyint=30, codec=codec)):
        if k not in lost:
            recorder.add("/video", "CompressedVideo", T0 + k * STEP, data=data, format=form)
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    recording = store.recording("video")
    good = [k for k in range(60) if k < min(lost) or k >= 30]
    assert recording.stamps("video").t_device_ns.tolist() == [T0 + k * STEP for k in good]
    level = recording.values("video", 0, len(good)).mean((1, 2, 3))
    np.testing.assert_allclose(level, [20 * (k % 10) for k in good], atol=6)
    (refused,) = report.refused
    assert "key frame" in refused.reason
    assert refused.num_samples == 60 - len(good) - len(lost)


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_video_with_b_frames_is_refused(codec, store, tmp_path):
    recorder = Recorder(tmp_path / "video.mcap")
    units = video(24, keyint=8, codec=codec, bframes=2, tune="animation")
    form = {"libx264": "h264", "libx265": "h265"}[codec]
    for k, data in enumerate(units):
        recorder.add("/video", "CompressedVideo", T0 + k * STEP, data=data, format=form)
    with pytest.raises(InvalidInputError, match="B-frames"):
        import_any_mcap(recorder.done(), store, ImportAttributes())


def test_images_of_another_size_later_in_a_video_are_refused(store, tmp_path):
    """As a camera sends them whose resolution is changed while it records."""
    recorder = Recorder(tmp_path / "video.mcap")
    units = [*video(16, keyint=8), *video(8, keyint=8, size_px=(64, 96))]
    for k, data in enumerate(units):
        recorder.add("/video", "CompressedVideo", T0 + k * STEP, data=data, format="h264")
    report = import_any_mcap(recorder.done(), store, ImportAttributes())
    level = store.recording("video").values("video", 0, 16).mean((1, 2, 3))
    np.testing.assert_allclose(level, [20 * (k % 10) for k in range(16)], atol=6)
    (refused,) = report.refused
    assert (refused.num_samples, refused.reason[:21]) == (8, "image of another size")
