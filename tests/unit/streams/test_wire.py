"""Batches on the wire: golden bytes, round trips, and every kind of damage refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, LimitExceededError, PacketError
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values, pack, wire

GOLDEN = Path(__file__).parents[2] / "golden"
POSE = StreamDescriptor(
    name="wrist_left",
    kind="pose",
    shape=(7,),
    dtype="float64",
    unit="pose_m_wxyz",
    nominal_rate_hz=100,
)
CAMERA = StreamDescriptor(
    name="camera_head",
    kind="image",
    shape=(4, 4, 3),
    dtype="uint8",
    unit="jpeg",
    nominal_rate_hz=30,
)


def pose_batch(count=3):
    k = np.arange(count, dtype=np.int64)
    return SampleBatch(k * 10, k * 10 - 5, k, np.arange(7.0 * count).reshape(count, 7))


def camera_batch():
    k = np.arange(2, dtype=np.int64)
    return SampleBatch(k, k - 1, k, encoded_values([(GOLDEN / "image.jpg").read_bytes()] * 2))


CASES = {"batch_v1": (POSE, pose_batch()), "batch_jpeg_v1": (CAMERA, camera_batch())}


def assert_same(got, expected):
    for stamp in ("t_host_ns", "t_device_ns", "sequence", "values"):
        np.testing.assert_array_equal(getattr(got, stamp), getattr(expected, stamp))


@pytest.mark.parametrize("name", CASES)
def test_golden_bytes(name):
    """The bytes of version 1 never change: a station may be older than the store."""
    descriptor, batch = CASES[name]
    golden = (GOLDEN / f"{name}.bin").read_bytes()
    assert wire.encode_batch(descriptor, batch, number=5) == golden
    assert_same(wire.decode_batch(golden, descriptor, number=5), batch)


@pytest.mark.parametrize("name", CASES)
def test_every_flipped_bit_and_every_cut_is_refused(name):
    descriptor, batch = CASES[name]
    data = wire.encode_batch(descriptor, batch, number=5)
    for place in range(len(data)):
        for damaged in (
            data[:place],
            data[:place] + bytes([data[place] ^ (1 << place % 8)]) + data[place + 1 :],
        ):
            with pytest.raises(PacketError):
                wire.decode_batch(damaged, descriptor, number=5)
    with pytest.raises(PacketError):
        wire.decode_batch(data + b"\0", descriptor, number=5)


@given(st.binary(max_size=200))
def test_foreign_bytes_are_refused(data):
    with pytest.raises(PacketError):
        wire.decode_batch(data, POSE, number=0)


def framed(body):
    import google_crc32c

    return wire.HEADER.pack(b"DXTB", 1, 0, len(body), google_crc32c.value(body)) + body


STAMPS = {name: np.arange(2) for name in ("t_host_ns", "t_device_ns", "sequence")}
IDENTITY = {"stream": "wrist_left", "number": 0}
VALUES = np.zeros((2, 7))


@pytest.mark.parametrize(
    ("fields", "arrays"),
    [
        (IDENTITY | {"extra": 1}, STAMPS | {"values": VALUES}),
        (IDENTITY | {"number": 1}, STAMPS | {"values": VALUES}),
        (IDENTITY | {"stream": "wrist_right"}, STAMPS | {"values": VALUES}),
        (IDENTITY, STAMPS),
        (IDENTITY, STAMPS | {"values": VALUES, "more": VALUES}),
        (IDENTITY, STAMPS | {"values": VALUES[:1]}),
        (IDENTITY, STAMPS | {"values": np.array(1.0)}),
        (IDENTITY, STAMPS | {"values": VALUES[:, :6]}),
        (IDENTITY, STAMPS | {"values": VALUES.astype("f4")}),
        (IDENTITY, STAMPS | {"values": VALUES, "sequence": np.zeros(2)}),
        (IDENTITY, STAMPS | {"values": VALUES, "t_host_ns": np.array([2, 1])}),
        # Their difference as an int64 is 1.
        (IDENTITY, STAMPS | {"values": VALUES, "t_host_ns": np.array([2**63 - 1, -(2**63)])}),
        (IDENTITY, {name: np.arange(0) for name in STAMPS} | {"values": VALUES[:0]}),
    ],
)
def test_whole_bytes_with_wrong_content_are_refused(fields, arrays):
    with pytest.raises(InvalidInputError):
        wire.decode_batch(framed(pack(fields, arrays)), POSE, number=0)


def test_samples_that_arrive_at_one_time_are_taken():
    stamps = np.array([7, 7, 8])
    batch = SampleBatch(stamps, stamps, stamps, np.zeros((3, 7)))
    data = wire.encode_batch(POSE, batch, number=0)
    assert_same(wire.decode_batch(data, POSE, number=0), batch)


def test_bytes_that_are_no_image_are_refused():
    arrays = STAMPS | {"image_bytes": np.zeros(8, "u1"), "image_end": np.array([4, 8])}
    with pytest.raises(InvalidInputError, match="image 0 of the batch: 4 bytes are not a JPEG"):
        wire.decode_batch(
            framed(pack({"stream": "camera_head", "number": 0}, arrays)), CAMERA, number=0
        )


@pytest.mark.parametrize("ends", [[4, 3], [0, 8], [4, 9], [4], [-1, 8]])
def test_image_ends_must_fit(ends):
    arrays = STAMPS | {"image_bytes": np.zeros(8, "u1"), "image_end": np.array(ends)}
    with pytest.raises(InvalidInputError, match=r"image_end|like the values"):
        wire.decode_batch(
            framed(pack({"stream": "camera_head", "number": 0}, arrays)), CAMERA, number=0
        )


def test_image_ends_whose_steps_overflow_are_refused():
    """Each step is positive as an int64; cut up by them, the images are 4000 times the batch."""
    ends = np.array([2**63 - 1, -(2**63), -1, 4] * 4000)
    arrays = {name: np.arange(len(ends)) for name in STAMPS}
    arrays |= {"image_bytes": np.zeros(4, "u1"), "image_end": ends}
    body = framed(pack({"stream": "camera_head", "number": 0}, arrays))
    with pytest.raises(InvalidInputError, match="image_end must rise"):
        wire.decode_batch(body, CAMERA, number=0)


def test_too_many_images_are_refused_before_they_are_cut_up():
    ends = np.arange(1, 70_001)
    arrays = {name: np.arange(len(ends)) for name in STAMPS}
    arrays |= {"image_bytes": np.zeros(len(ends), "u1"), "image_end": ends}
    body = framed(pack({"stream": "camera_head", "number": 0}, arrays))
    with pytest.raises(LimitExceededError, match="65536"):
        wire.decode_batch(body, CAMERA, number=0)


def test_limits():
    with pytest.raises(InvalidInputError, match="empty"):
        wire.encode_batch(POSE, pose_batch(0), number=0)
    with pytest.raises(InvalidInputError, match="number"):
        wire.encode_batch(POSE, pose_batch(), number=-1)
    with pytest.raises(LimitExceededError, match="65536"):
        wire.encode_batch(POSE, pose_batch(65_537), number=0)
    with pytest.raises(LimitExceededError, match="at most"):
        wire.decode_batch(bytes(wire.MAX_BATCH_BYTES + 1), POSE, number=0)
