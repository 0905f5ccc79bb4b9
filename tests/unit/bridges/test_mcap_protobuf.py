"""Our protobuf bytes against google's own library, and bytes that are no message."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.bridges.mcap.protobuf import decode, descriptor_set, encode
from dextouch.bridges.mcap.schemas import ARRAYS, CALIBRATION, TABLE
from dextouch.errors import CorruptDataError, InvalidInputError

TIME = {"seconds": -3, "nanos": 5}


def google_class(message):
    """The message class that google's library makes from our descriptor set."""
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set(TABLE, message)).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(message))


@pytest.mark.parametrize("message", sorted(TABLE))
def test_descriptors_name_every_field_as_the_table_does(message):
    fields = google_class(message).DESCRIPTOR.fields
    assert {(f.number, f.name, f.is_repeated) for f in fields} == {
        (f.number, f.name, f.repeated) for f in TABLE[message]
    }


def test_google_reads_a_transform_and_writes_what_we_read():
    values = {
        "timestamp": TIME,
        "parent_frame_id": "world",
        "child_frame_id": "wrist_left",
        "translation": {"x": 0.1, "y": -0.0, "z": 1e300},
        "rotation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
        "dextouch_sequence": -1,
    }
    message = google_class("foxglove.FrameTransform")
    data = encode(TABLE, "foxglove.FrameTransform", values)
    parsed = message.FromString(data)
    assert (parsed.timestamp.seconds, parsed.timestamp.nanos) == (-3, 5)
    assert (parsed.parent_frame_id, parsed.rotation.w) == ("world", 0.8)
    assert parsed.dextouch_sequence == -1
    assert decode(TABLE, "foxglove.FrameTransform", data) == values
    again = decode(TABLE, "foxglove.FrameTransform", parsed.SerializeToString())
    assert again["translation"] == {"x": 0.1, "y": -0.0, "z": 1e300}


@pytest.mark.parametrize("dtype", sorted(ARRAYS))
def test_google_reads_every_kind_of_array(dtype):
    message = ARRAYS[dtype][0]
    values = np.arange(7).astype(dtype)
    data = encode(TABLE, message, {"timestamp": TIME, "shape": np.array([7]), "values": values})
    parsed = google_class(message).FromString(data)
    assert list(parsed.values) == values.tolist()
    assert list(parsed.shape) == [7]
    ours = decode(TABLE, message, parsed.SerializeToString())["values"]
    assert ours.astype(dtype).tobytes() == values.tobytes()


def test_numbers_that_are_not_numbers_keep_their_bits():
    values = np.array([np.nan, -np.nan, np.inf, -0.0])
    data = encode(TABLE, "dextouch.Float64Array", {"values": values})
    assert decode(TABLE, "dextouch.Float64Array", data)["values"].tobytes() == values.tobytes()


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_clear_refusal(data):
    for message in ("foxglove.PosesInFrame", CALIBRATION, "dextouch.Float32Array"):
        with suppress(CorruptDataError):
            decode(TABLE, message, data)


@given(st.integers(0, 60))
def test_a_cut_message_is_never_taken_for_a_longer_one(size):
    whole = encode(TABLE, "foxglove.CompressedImage", {"data": b"x" * 40, "format": "jpeg"})
    try:
        values = decode(TABLE, "foxglove.CompressedImage", whole[:size])
    except CorruptDataError:
        return
    assert values.get("data", b"x" * 40) == b"x" * 40


def test_unknown_fields_are_skipped():
    data = encode(TABLE, "foxglove.CompressedImage", {"data": b"a", "format": "jpeg"})
    assert decode(TABLE, "foxglove.Vector3", b"\xa0\x06\x01" + b"\x09" + b"\0" * 8) == {"x": 0.0}
    assert decode(TABLE, "foxglove.CompressedImage", data)["format"] == "jpeg"


def test_a_value_of_another_kind_is_refused():
    with pytest.raises(InvalidInputError, match="format"):
        encode(TABLE, "foxglove.CompressedImage", {"format": 3})
