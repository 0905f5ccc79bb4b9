"""MCAP: read by the mcap library and google's protobuf, read back by us, foreign files refused."""

import json
import struct
import tracemalloc
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from dextouch.bridges.mcap import MAX_RECORD_BYTES, export_mcap, import_mcap
from dextouch.episodes import EpisodeStore
from dextouch.episodes.editing import add_note
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
)
from dextouch.schemas import NewNote
from dextouch.tactile import DEXTOUCH_V1, colour
from tests.unit.bridges.takes import (
    DISTORTION,
    K_HEAD,
    descriptor,
    differing_streams,
    write_episode,
    write_recording,
)

ACTION_PARTS = ("wrist_left", "wrist_right", "joints_left", "joints_right", "camera_head")
# `date -u -d 2026-01-02 +%s`, the `created_at` of `write_episode`.
CREATED_NS = 1_767_312_000 * 10**9


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def other(tmp_path):
    return EpisodeStore(tmp_path / "other")


def messages_of(path):
    """Per topic the schema's name, and the messages as google's library reads them."""
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory, unknown_fields

    classes, found = {}, {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            if schema.name not in classes:
                pool = descriptor_pool.DescriptorPool()
                for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(proto)
                descriptor = pool.FindMessageTypeByName(schema.name)
                classes[schema.name] = message_factory.GetMessageClass(descriptor)
            parsed = classes[schema.name].FromString(message.data)
            assert len(unknown_fields.UnknownFieldSet(parsed)) == 0
            found.setdefault(channel.topic, (schema.name, []))[1].append((message, parsed))
    return found


def nanoseconds(parsed):
    return parsed.timestamp.seconds * 10**9 + parsed.timestamp.nanos


def pose_of(translation, rotation):
    q = (rotation.w, rotation.x, rotation.y, rotation.z)
    return [translation.x, translation.y, translation.z, *q]


def values_in(name, parsed, shape):
    """The numbers of one message, however its schema keeps them."""
    if name == "foxglove.FrameTransform":
        return np.array(pose_of(parsed.translation, parsed.rotation))
    if name == "foxglove.PosesInFrame":
        return np.array([pose_of(p.position, p.orientation) for p in parsed.poses])
    if name == "foxglove.JointStates":
        return np.array([joint.position for joint in parsed.joints])
    if name == "dextouch.Action":
        assert [len(getattr(parsed, part)) for part in ACTION_PARTS] == [9, 9, 20, 20, 9]
        return np.concatenate([getattr(parsed, part) for part in ACTION_PARTS])
    if name == "foxglove.RawImage":
        assert (parsed.height, parsed.width, parsed.step) == (*shape[:2], shape[1] * 3)
        return np.frombuffer(parsed.data, dtype=np.uint8).reshape(shape)
    assert list(parsed.shape) == list(shape)
    return np.array(parsed.values).reshape(shape)


def test_every_sample_of_an_episode_is_there_for_other_readers(store, tmp_path):
    reader = write_episode(store)
    num_messages = export_mcap(reader, tmp_path / "take.mcap", touch_images=False)
    found = messages_of(tmp_path / "take.mcap")
    assert sum(len(messages) for _, messages in found.values()) == num_messages
    assert set(found) == {f"/{name}" for name in reader.streams} | {"/camera_head/calibration"}
    for name, stream in reader.streams.items():
        schema, messages = found[f"/{name}"]
        data = reader.read(name)
        assert len(messages) == len(data)
        for (message, parsed), t_ns, value in zip(
            messages, data.t_ref_ns, data.values, strict=True
        ):
            at_ns = CREATED_NS + t_ns
            assert message.log_time == message.publish_time == nanoseconds(parsed) == at_ns
            np.testing.assert_array_equal(values_in(schema, parsed, stream.shape), value)


def test_times_are_those_of_the_wall_clock_where_it_is_known(store, tmp_path):
    """Two takes of one day, told apart on Foxglove's timeline, and one without a start."""
    at = datetime(2026, 5, 4, 12, 0, 1, 250_000, tzinfo=UTC)
    starts = {"a": (at, 10**15 - 5), "b": (at + timedelta(seconds=90), 10**15), "c": (None, None)}
    # `date -u -d '2026-05-04 12:00:01' +%s`
    began_ns = 1_777_896_001_250_000_000
    for name, (started_at, started_ns) in starts.items():
        take = {"started_at": started_at, "started_t_host_ns": started_ns}
        export_mcap(write_recording(store, name, **take), tmp_path / name)
    t_ns = store.recording("a").stamps_ns("button")
    wanted = {"a": began_ns + 5, "b": began_ns + 90 * 10**9, "c": 10**15}
    for name, from_ns in wanted.items():
        messages = messages_of(tmp_path / name)["/button"][1]
        expected = [from_ns + one - 10**15 for one in t_ns.tolist()]
        assert [m.log_time for m, _ in messages] == expected
        assert [nanoseconds(parsed) for _, parsed in messages] == expected
        again = EpisodeStore(tmp_path / f"of {name}")
        import_mcap(tmp_path / name, again)
        assert differing_streams(store.recording(name), again.recording(name)) == []


def test_a_wall_clock_that_mcap_cannot_hold_is_none(store, other, tmp_path):
    for name, year in (("early", 1960), ("late", 9999)):
        at = datetime(year, 1, 1, tzinfo=UTC)
        reader = write_recording(store, name, started_at=at, started_t_host_ns=10**15)
        export_mcap(reader, tmp_path / name)
        messages = messages_of(tmp_path / name)["/button"][1]
        assert [m.log_time for m, _ in messages] == reader.stamps_ns("button").tolist()
        import_mcap(tmp_path / name, other)
        assert differing_streams(reader, other.recording(name)) == []


def test_the_decoder_of_mcaps_own_library_reads_every_message(store, tmp_path):
    decoder = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support")
    for reader in (write_episode(store), write_recording(store)):
        num_messages = export_mcap(reader, tmp_path / reader.item_id)
        with (tmp_path / reader.item_id).open("rb") as file:
            mcap = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
            read = [one.decoded_message for one in mcap.iter_decoded_messages()]
            assert mcap.get_summary().statistics.message_count == len(read) == num_messages
            assert all(message.timestamp.ToNanoseconds() >= 0 for message in read)


def test_times_that_do_not_fit_are_refused(store, other, tmp_path):
    path = tmp_path / "take.mcap"
    export_mcap(write_recording(store), path)
    for offset in (str(-(2**63)), "1e9", "9" * 20):
        rewrite(path, about={"time_offset_ns": offset})
        with pytest.raises(CorruptDataError):
            import_mcap(path, other)
    assert other.list(kind="recording") == []


def test_joints_and_parts_of_actions_have_their_names(store, tmp_path):
    reader = write_episode(store, num_steps=3)
    export_mcap(reader, tmp_path / "take.mcap")
    found = messages_of(tmp_path / "take.mcap")
    schema, messages = found["/joints_measured"]
    assert schema == "foxglove.JointStates"
    names = [joint.name for joint in messages[0][1].joints]
    assert len(set(names)) == 40
    assert (names[0], names[4]) == ("l_thumb_cmc_flex", "l_index_finger_mcp_flex")
    assert (names[20], names[39]) == ("r_thumb_cmc_flex", "r_pinky_dip")
    schema, messages = found["/action"]
    assert schema == "dextouch.Action"
    # The first step is the anchor: no translation, and the unit rotation in six numbers.
    assert list(messages[0][1].wrist_right) == [0, 0, 0, 1, 0, 0, 0, 1, 0]


def test_touch_is_also_a_picture_of_the_hand(store, tmp_path):
    reader = write_episode(store)
    export_mcap(reader, tmp_path / "take.mcap")
    schema, messages = messages_of(tmp_path / "take.mcap")["/tactile_right/image"]
    assert schema == "foxglove.RawImage"
    data = reader.read("tactile_right")
    stamps = [message.log_time - CREATED_NS for message, _ in messages]
    # 10 a second of the 60 samples over 4/3 s, each with the time of its sample.
    assert len(messages) == 14
    assert set(stamps) <= set(data.t_ref_ns.tolist())
    _, parsed = messages[7]
    assert (parsed.encoding, parsed.height, parsed.width, parsed.step) == ("rgb8", 28, 26, 78)
    picture = np.frombuffer(parsed.data, dtype=np.uint8).reshape(28, 26, 3)
    row = data.values[data.t_ref_ns.tolist().index(stamps[7])]
    np.testing.assert_array_equal(picture, colour(DEXTOUCH_V1.hand_canvas(row, side="right")))


def test_raw_cells_are_drawn_by_the_largest_of_the_take(store, tmp_path):
    reader = write_recording(store)
    export_mcap(reader, tmp_path / "take.mcap")
    _, messages = messages_of(tmp_path / "take.mcap")["/tactile_left/image"]
    data = reader.read("tactile_left")
    row = DEXTOUCH_V1.select(data.values[0], side="left")
    canvas = DEXTOUCH_V1.hand_canvas(row, side="left")
    expected = colour(canvas, full_scale_kpa=float(data.values.max()))
    assert messages[0][1].data == expected.tobytes()


def test_poses_carry_their_frames_and_the_camera_its_matrix(store, tmp_path):
    export_mcap(write_episode(store), tmp_path / "take.mcap")
    found = messages_of(tmp_path / "take.mcap")
    schema, head = found["/head"]
    assert schema == "foxglove.FrameTransform"
    assert (head[0][1].parent_frame_id, head[0][1].child_frame_id) == ("world", "camera_head")
    assert found["/camera_head"][1][0][1].frame_id == "camera_head"
    calibration = found["/camera_head/calibration"][1][0][1]
    # Half a pixel less: Foxglove counts from the first pixel's centre, the store from its corner.
    K = [60, 0, 31.5, 0, 61, 31, 0, 0, 1]
    assert list(calibration.K) == K
    assert (calibration.height, calibration.width) == (64, 64)
    assert list(calibration.P) == [*K[:3], 0, *K[3:6], 0, *K[6:], 0]
    assert list(calibration.D) == [0.0] * 5
    export_mcap(write_recording(store), tmp_path / "raw.mcap")
    lens = messages_of(tmp_path / "raw.mcap")["/camera_head/calibration"][1][0][1]
    assert (list(lens.D), lens.distortion_model) == (list(DISTORTION), "plumb_bob")


def test_a_recording_keeps_the_devices_own_words(store, tmp_path):
    reader = write_recording(store)
    export_mcap(reader, tmp_path / "take.mcap")
    _, messages = messages_of(tmp_path / "take.mcap")["/tactile_left"]
    data = reader.read("tactile_left")
    assert [m.log_time for m, _ in messages] == data.t_host_ns.tolist()
    assert [p.dextouch_t_device_ns for _, p in messages] == data.t_device_ns.tolist()
    assert [p.dextouch_sequence for _, p in messages] == data.sequence.tolist()
    device = data.t_device_ns
    published = np.where(device < 0, data.t_host_ns, device)
    assert [m.publish_time for m, _ in messages] == published.tolist()


def test_attachments_and_metadata_say_where_it_comes_from(store, tmp_path):
    reader = write_episode(store)
    given = NewNote(start_ns=0, stop_ns=10**8, text="it slips", author="p-7")
    add_note(store, reader.item_id, given)
    export_mcap(reader, tmp_path / "take.mcap")
    with (tmp_path / "take.mcap").open("rb") as file:
        mcap = make_reader(file)
        attached = {a.name: json.loads(a.data) for a in mcap.iter_attachments()}
        metadata = {m.name: m.metadata for m in mcap.iter_metadata()}
    assert attached["attributes.json"]["episode_id"] == "stand-bottle-0003"
    assert attached["calibration.json"]["K_head"] == K_HEAD.tolist()
    assert metadata["dextouch"]["content_sha256"] == reader.content_sha256
    note = json.loads(metadata["dextouch.notes"]["1"])
    assert {key: note[key] for key in given.model_dump()} == given.model_dump()
    assert metadata["dextouch.num_samples"]["tactile_left"] == str(
        reader.num_samples("tactile_left")
    )


@pytest.mark.long
@pytest.mark.parametrize("unit", ["rgb8", "jpeg", "h264"])
def test_an_episode_comes_back_equal(unit, store, other, tmp_path):
    reader = write_episode(store, unit=unit, num_steps=17)
    export_mcap(reader, tmp_path / "take.mcap")
    assert import_mcap(tmp_path / "take.mcap", other) == "stand-bottle-0003"
    again = other.open("stand-bottle-0003")
    assert differing_streams(reader, again) == []
    assert again.attributes == reader.attributes
    assert again.verify().num_arrays == reader.verify().num_arrays
    for name in reader.streams:
        assert again._contents.entries[name].sha256 == reader._contents.entries[name].sha256


def test_a_recording_comes_back_equal(store, other, tmp_path):
    reader = write_recording(store)
    export_mcap(reader, tmp_path / "take.mcap")
    import_mcap(tmp_path / "take.mcap", other)
    again = other.recording("take-0001")
    assert differing_streams(reader, again) == []
    assert again.attributes == reader.attributes


def test_times_before_zero_and_images_without_colour_come_back(store, other, tmp_path):
    reader = write_episode(store, "plain", num_steps=3)
    changes = {"episode_id": "odd", "streams": (), "created_at": None}
    attributes = reader.attributes.model_copy(update=changes)
    t_ref_ns = np.array([-(10**9) - 7, -1, 5], dtype=np.int64)
    shapes = {"depth": ((4, 5), "uint16"), "gray": ((4, 5), "uint8"), "mask": ((2, 3, 4), "uint8")}
    rng = np.random.default_rng(2)
    with store.writer(attributes=attributes) as writer:
        for name, (shape, dtype) in shapes.items():
            writer.add_stream(descriptor(name, "image", shape, dtype, "mm", 30))
            values = rng.integers(0, 256, (3, *shape)).astype(dtype)
            writer.append(name, values=values, t_ref_ns=t_ref_ns)
    path = tmp_path / "take.mcap"
    export_mcap(store.open("odd"), path)
    found = messages_of(path)
    encodings = {topic: name for topic, (name, _) in found.items()}
    assert encodings["/depth"] == encodings["/gray"] == "foxglove.RawImage"
    assert encodings["/mask"] == "dextouch.UInt8Array"
    depth = found["/depth"][1]
    assert (depth[0][1].encoding, depth[0][1].step) == ("mono16", 10)
    assert [message.log_time for message, _ in depth] == (t_ref_ns - t_ref_ns[0]).tolist()
    assert [nanoseconds(parsed) for _, parsed in depth] == (t_ref_ns - t_ref_ns[0]).tolist()
    import_mcap(path, other)
    assert differing_streams(store.open("odd"), other.open("odd")) == []


def test_rgb_images_become_jpeg_when_that_is_asked_for(store, other, tmp_path):
    reader = write_episode(store)
    export_mcap(reader, tmp_path / "take.mcap", jpeg_quality=80)
    schema, messages = messages_of(tmp_path / "take.mcap")["/camera_head"]
    assert schema == "foxglove.CompressedImage"
    assert messages[0][1].format == "jpeg"
    import_mcap(tmp_path / "take.mcap", other)
    again = other.open("stand-bottle-0003")
    assert again.streams["camera_head"].unit == "jpeg"
    assert again.encoded_images("camera_head", 0, 1) == [messages[0][1].data]
    error = again.read("camera_head").values.astype(float) - reader.read("camera_head").values
    assert 0 < np.abs(error).mean() < 8


def test_video_frames_stand_alone_where_they_say_so(store, tmp_path):
    reader = write_episode(store, unit="h264", num_steps=17)
    export_mcap(reader, tmp_path / "take.mcap")
    schema, messages = messages_of(tmp_path / "take.mcap")["/camera_head"]
    assert schema == "foxglove.CompressedVideo"
    assert {parsed.format for _, parsed in messages} == {"h264"}
    kinds = [units_in(parsed.data) for _, parsed in messages]
    keys = [5 in units for units in kinds]
    assert keys[0]
    assert all({7, 8} <= units for units, key in zip(kinds, keys, strict=True) if key)
    assert 0 < sum(keys) < len(keys)


def units_in(data):
    """Types of the NAL units of an Annex B access unit."""
    parts = data.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")
    assert parts[0] == b""
    return {part[0] & 31 for part in parts[1:]}


def test_existing_files_are_kept_unless_told_otherwise(store, tmp_path):
    path = tmp_path / "take.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(ConflictError, match="exists"):
        export_mcap(write_episode(store), path)
    assert path.read_bytes() == b"mine"
    export_mcap(store.open("stand-bottle-0003"), path, overwrite=True)
    assert path.read_bytes() != b"mine"
    assert [p.name for p in tmp_path.iterdir() if "partial" in p.name] == []


def test_an_export_that_fails_leaves_nothing(store, tmp_path):
    with pytest.raises(InvalidInputError, match="quality"):
        export_mcap(write_episode(store), tmp_path / "take.mcap", jpeg_quality=0)
    shard = next((store.root / "episodes" / "stand-bottle-0003" / "tactile_left").rglob("c/*/0"))
    shard.write_bytes(shard.read_bytes()[:-30])
    with pytest.raises(CorruptDataError):
        export_mcap(store.open("stand-bottle-0003"), tmp_path / "take.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["store"]


@pytest.mark.long
@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_and_the_store_stays_empty(keep, store, other, tmp_path):
    path = tmp_path / "take.mcap"
    export_mcap(write_episode(store), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(CorruptDataError, match=r"take\.mcap"):
        import_mcap(path, other)
    assert other.list() == []


def test_flipped_bytes_are_found(store, other, tmp_path):
    path = tmp_path / "take.mcap"
    reader = write_recording(store)
    export_mcap(reader, path)
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    for at in rng.integers(0, len(data), 15):
        damaged = bytearray(data)
        damaged[at] ^= 0x55
        path.write_bytes(bytes(damaged))
        try:
            import_mcap(path, other)
        except (StorageError, InvalidInputError, LimitExceededError):
            assert other.list(kind="recording") == []
        else:  # a byte of what is not ours to check, such as an index of the file
            assert differing_streams(reader, other.recording("take-0001")) == []
            other.delete("take-0001", kind="recording")


def foreign(path, **changes):
    with path.open("wb") as file:
        writer = Writer(file, **{"compression": CompressionType.ZSTD} | changes)
        writer.start()
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/x", message_encoding="json", schema_id=schema)
        for t_ns in range(50):
            writer.add_message(channel_id=channel, log_time=t_ns, publish_time=t_ns, data=b"{}")
        writer.finish()
    return path


def test_files_of_others_are_refused_with_a_reason(other, tmp_path):
    path = tmp_path / "other.mcap"
    with pytest.raises(NotFoundError):
        import_mcap(path, other)
    path.write_bytes(b"PK\3\4 this is a zip")
    with pytest.raises(InvalidInputError, match="not an MCAP file"):
        import_mcap(path, other)
    with pytest.raises(InvalidInputError, match=r"attributes\.json"):
        import_mcap(foreign(path), other)
    with pytest.raises(InvalidInputError, match=r"attributes\.json"):
        import_mcap(foreign(path, compression=CompressionType.LZ4), other)


def chunk_record(*, announced, data):
    head = struct.pack("<QQQI", 0, 1, announced, 0)
    body = head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


@pytest.mark.parametrize(
    ("announced", "error"),
    [(1000, CorruptDataError), (MAX_RECORD_BYTES + 1, LimitExceededError)],
)
def test_a_bomb_is_not_unfolded(announced, error, other, tmp_path):
    bomb = zstandard.ZstdCompressor().compress(b"\0" * (1 << 25))
    header = b"\x01" + struct.pack("<Q", 8) + b"\0" * 8
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + header + chunk_record(announced=announced, data=bomb))
    tracemalloc.start()
    try:
        with pytest.raises(error):
            import_mcap(path, other)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()


def rewrite(path, *, drop=0, about=None, attributes=None):
    """The same file with messages left out, or with other words about it."""
    with path.open("rb") as file:
        reader = make_reader(file)
        attached = list(reader.iter_attachments())
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        messages = list(reader.iter_messages())
    metadata["dextouch"] |= about or {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for attachment in attached:
            data = attachment.data if attributes is None else attributes
            writer.add_attachment(0, 0, attachment.name, "application/json", data)
        for name, words in metadata.items():
            writer.add_metadata(name, words)
        ids = {}
        for schema, channel, message in messages[drop:]:
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, "protobuf", number)
            writer.add_message(
                ids[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()


def test_files_that_were_cut_or_come_from_the_future_are_refused(store, other, tmp_path):
    path = tmp_path / "take.mcap"
    reader = write_recording(store)
    export_mcap(reader, path)
    rewrite(path)
    import_mcap(path, other)
    assert differing_streams(reader, other.recording("take-0001")) == []
    with pytest.raises(ConflictError):
        import_mcap(path, other)
    other.delete("take-0001", kind="recording")
    rewrite(path, drop=9)
    with pytest.raises(CorruptDataError, match="cut or filtered"):
        import_mcap(path, other)
    rewrite(path, about={"bridge_version": "7"})
    with pytest.raises(StorageError, match="'7'"):
        import_mcap(path, other)
    rewrite(path, about={"bridge_version": "2"}, attributes=b'{"recording_id": "../../etc"}')
    with pytest.raises(CorruptDataError, match=r"attributes\.json"):
        import_mcap(path, other)
    assert other.list(kind="recording") == []
