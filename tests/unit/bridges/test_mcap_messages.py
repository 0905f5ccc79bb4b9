"""Messages against Foxglove's own classes, bytes written by hand, and bytes that are no message."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st

from dextouch.bridges.mcap import import_mcap
from dextouch.bridges.mcap_messages import MessageCodec, Sent, descriptor_set, joint_names
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError
from tests.unit.bridges.takes import (
    descriptor,
    differing_streams,
    write_episode,
    write_recording,
)

GOLDEN = Path(__file__).parents[2] / "golden"
POSE = descriptor("wrist_left", "pose", (7,), "float64", "pose_m_wxyz", 100, "world")
POSES = descriptor("object_poses", "pose", (2, 7), "float64", "pose_m_wxyz", 100, "world")
JPEG = descriptor("camera_head", "image", (8, 8, 3), "uint8", "jpeg", 30)
RAW = descriptor("camera_head", "image", (1, 2, 3), "uint8", "rgb8", 30)
TOUCH = descriptor("touch", "tactile", (2,), "float32", "kPa", 60)
JOINTS = descriptor("joints_left", "robot_state", (20,), "float64", "rad", 100)
ACTION = descriptor("action", "robot_state", (67,), "float64", "action", 15)
FLAGS = descriptor("flags", "scalar", (3,), "uint8", "bits", 10)
# Timestamp 2 s and 3 ns, frame "touch", shape [2], values [1, 2], each tag and length by hand from
# https://protobuf.dev/programming-guides/encoding.
TOUCH_BYTES = bytes.fromhex(
    "0a04 0802 1003"
    "1205 746f756368"
    "1a04 02000000"
    "2208 0000803f 00000040"
    "c93e ffffffffffffffff"
    "d13e 0900000000000000"
)


def encoded(stream, value, t_ns=2_000_000_003):
    return MessageCodec(stream).encode(Sent(t_ns, -1, 9, value), with_device=True)


def test_an_array_is_the_bytes_of_the_encoding_guide():
    values = np.array([1, 2], dtype=np.float32)
    assert encoded(TOUCH, values) == TOUCH_BYTES
    sent = MessageCodec(TOUCH).decode(TOUCH_BYTES)
    assert (sent.t_ns, sent.t_device_ns, sent.sequence) == (2_000_000_003, -1, 9)
    np.testing.assert_array_equal(sent.value, values)


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64", "uint16", "uint8"])
def test_the_schema_of_an_array_reads_its_values(dtype):
    values = np.array([0, 1, 200], dtype=dtype)
    codec = MessageCodec(descriptor("x", "scalar", (3,), dtype, "count", 10))
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(codec.message)).file:
        pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(codec.message))
    parsed = message.FromString(codec.encode(Sent(-1, 0, 0, values), with_device=False))
    assert (list(parsed.values), list(parsed.shape)) == ([0, 1, 200], [3])
    assert (parsed.timestamp.seconds, parsed.timestamp.nanos) == (-1, 999_999_999)
    # Another writer's list instead of our bytes, in another order of fields.
    again = codec.decode(parsed.SerializeToString(deterministic=True))
    np.testing.assert_array_equal(again.value, values)


def test_numbers_that_are_not_numbers_keep_their_bits():
    # 0x7fa00001 is a signalling NaN, which a conversion to a Python float makes a quiet one.
    bits = np.array([0x7FA00001, 0xFFC00000], dtype=np.uint32)
    again = MessageCodec(TOUCH).decode(encoded(TOUCH, bits.view(np.float32)))
    assert again.value.tobytes() == bits.tobytes()


def test_joints_and_actions_keep_their_bits_too():
    rng = np.random.default_rng(4)
    for stream in (JOINTS, ACTION):
        bits = rng.integers(0, 2**64, stream.shape, dtype=np.uint64)
        # A signalling NaN with a payload, and a negative zero.
        bits[:2] = 0x7FF4_0000_0000_0001, 1 << 63
        again = MessageCodec(stream).decode(encoded(stream, bits.view(np.float64)))
        assert again.value.tobytes() == bits.tobytes()


def test_joints_are_foxgloves_states():
    parsed = JointStates.FromString(encoded(JOINTS, np.arange(20.0)))
    assert [joint.position for joint in parsed.joints] == list(range(20))
    assert parsed.joints[3].name == "l_thumb_ip"
    theirs = MessageCodec(JOINTS).decode(
        JointStates(timestamp=parsed.timestamp, joints=parsed.joints).SerializeToString()
    )
    np.testing.assert_array_equal(theirs.value, np.arange(20.0))


def test_only_what_holds_joints_has_their_names():
    assert joint_names(JOINTS)[0] == "l_thumb_cmc_flex"
    right = JOINTS.model_copy(update={"name": "x", "side": "right"})
    assert joint_names(right)[0] == "r_thumb_cmc_flex"
    for changes in ({"name": "joints"}, {"shape": (21,)}, {"dtype": "float32"}, {"unit": "m"}):
        assert joint_names(JOINTS.model_copy(update=changes)) == ()


def test_a_pose_is_foxgloves_transform_and_back():
    pose = np.array([0.1, -0.0, 1e300, 0.8, 0.0, 0.0, 0.6])
    parsed = FrameTransform.FromString(encoded(POSE, pose))
    assert (parsed.parent_frame_id, parsed.child_frame_id) == ("world", "wrist_left")
    assert (parsed.translation.x, parsed.translation.z) == (0.1, 1e300)
    assert (parsed.rotation.w, parsed.rotation.z) == (0.8, 0.6)
    theirs = MessageCodec(POSE).decode(
        FrameTransform(
            timestamp=parsed.timestamp, translation=parsed.translation, rotation=parsed.rotation
        ).SerializeToString()
    )
    assert (theirs.t_device_ns, theirs.sequence) == (0, 0)
    assert theirs.value.tobytes() == pose.tobytes()


def test_a_pose_of_zeros_is_present():
    zeros = np.zeros((2, 7))
    assert MessageCodec(POSES).decode(encoded(POSES, zeros)).value.tobytes() == zeros.tobytes()


def test_a_codec_forgets_the_sample_before():
    codec = MessageCodec(POSES)
    first, second = np.arange(28.0).reshape(2, 2, 7)
    codec.encode(Sent(1, 5, 6, first), with_device=True)
    data = codec.encode(Sent(2, -1, -1, second), with_device=True)
    assert data == encoded_as(POSES, Sent(2, -1, -1, second))
    np.testing.assert_array_equal(codec.decode(data).value, second)


def encoded_as(stream, sent):
    return MessageCodec(stream).encode(sent, with_device=True)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_clear_refusal(data):
    for stream in (POSE, POSES, JPEG, RAW, TOUCH, FLAGS, JOINTS, ACTION):
        with suppress(CorruptDataError):
            MessageCodec(stream).decode(data)


@pytest.mark.parametrize(
    ("stream", "value"),
    [
        (JPEG, b"x" * 40),
        (RAW, np.zeros((1, 2, 3), np.uint8)),
        (TOUCH, np.ones(2, np.float32)),
        (JOINTS, np.ones(20)),
        (ACTION, np.ones(67)),
    ],
    ids=["jpeg", "raw", "array", "joints", "action"],
)
def test_a_cut_message_is_never_taken_for_a_whole_one(stream, value):
    whole = encoded(stream, value)
    codec = MessageCodec(stream)
    for size in range(len(whole)):
        with suppress(CorruptDataError):
            found = codec.decode(whole[:size]).value
            assert (found if isinstance(found, bytes) else found.tobytes()) == bytes(value)


def test_a_message_without_its_value_is_refused():
    with pytest.raises(CorruptDataError, match="translation"):
        MessageCodec(POSE).decode(FrameTransform(timestamp={"seconds": 1}).SerializeToString())
    with pytest.raises(CorruptDataError, match="timestamp"):
        MessageCodec(POSE).decode(b"")
    with pytest.raises(CorruptDataError, match="format 'png'"):
        MessageCodec(JPEG).decode(
            encoded(JPEG, b"\xff\xd8").replace(b"\x1a\x04jpeg", b"\x1a\x03png")
        )
    with pytest.raises(CorruptDataError, match="has no field 'data'"):
        MessageCodec(JPEG).decode(encoded(JPEG, b""))
    with pytest.raises(CorruptDataError, match="got 256, expected numbers of uint8"):
        MessageCodec(FLAGS).decode(
            encoded(FLAGS, np.array([1, 2, 255], np.uint8)).replace(b"\xff\0\0\0", b"\0\1\0\0")
        )
    joints = encoded(JOINTS, np.ones(20))
    for wrong in (joints.replace(b"l_thumb_ip", b"r_thumb_ip"), TOUCH_BYTES[:8]):
        with pytest.raises(CorruptDataError, match="joints"):
            MessageCodec(JOINTS).decode(wrong)
    # Nine numbers of one wrist, then ten and eight: as many in all.
    action = encoded(ACTION, np.ones(67)).replace(
        b"\x1aH" + np.ones(9).tobytes() + b"\x22H" + np.ones(9).tobytes(),
        b"\x1aP" + np.ones(10).tobytes() + b"\x22@" + np.ones(8).tobytes(),
    )
    with pytest.raises(CorruptDataError, match="10 numbers of wrist_left, expected 9"):
        MessageCodec(ACTION).decode(action)
    with pytest.raises(CorruptDataError, match="8 bytes, expected"):
        MessageCodec(FLAGS).decode(TOUCH_BYTES)


def test_a_message_that_would_unfold_into_memory_is_refused_before_it_is_parsed():
    # An empty pose takes two bytes in the file and many times that in memory.
    message = PosesInFrame(timestamp={"seconds": 1})
    data = message.SerializeToString() + b"\x1a\x00" * 100_000
    with pytest.raises(CorruptDataError, match=r"200004 bytes, expected at most \d+"):
        MessageCodec(POSES).decode(data)


@pytest.mark.parametrize("version", [1, 2])
def test_files_of_each_version_are_read(version, tmp_path):
    store, other = EpisodeStore(tmp_path / "made"), EpisodeStore(tmp_path / "read")
    episode = write_episode(store, num_steps=2, cameras=("camera_head",))
    recording = write_recording(store, count=6)
    assert import_mcap(GOLDEN / f"episode_mcap_v{version}.mcap", other) == "stand-bottle-0003"
    assert import_mcap(GOLDEN / f"recording_mcap_v{version}.mcap", other) == "take-0001"
    read = other.open("stand-bottle-0003")
    # The last digit of computed poses belongs to the processor.
    poses = {"action", "action_commanded"}
    assert set(differing_streams(episode, read)) <= poses
    for name in poses:
        one, two = episode.read(name), read.read(name)
        assert one.t_ref_ns.tolist() == two.t_ref_ns.tolist()
        np.testing.assert_allclose(two.values, one.values, rtol=0, atol=1e-14)
    # The bytes of a JPEG image belong to the encoder's release.
    assert differing_streams(recording, other.recording("take-0001")) in ([], ["camera_head"])
