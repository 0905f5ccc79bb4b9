"""Batches on the wire: golden bytes, round trips, and every kind of damage refused."""

import struct
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, LimitExceededError, PacketError
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from dextouch.streams import batch as wire

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


CASES = {"batch": (POSE, pose_batch()), "batch_jpeg": (CAMERA, camera_batch())}


def by_hand(name, batch, number):
    """A batch as docs/wire_format.md describes it."""
    body = b""
    for host, device, sequence, values in zip(*vars(batch).values(), strict=True):
        body += struct.pack("<qqq", host, device, sequence)
        if isinstance(values, bytes):
            body += struct.pack("<I", len(values)) + values
        else:
            body += struct.pack("<7d", *values)
    return framed(name, body, len(batch), number)


def framed(name, body, count, number=0, *, length=None):
    crc = google_crc32c.value(body)
    length = len(body) if length is None else length
    head = struct.pack("<4sHHIIII", b"DXTB", 2, len(name), number, count, length, crc)
    head += name.encode()
    return head + struct.pack("<I", google_crc32c.value(head)) + body


def assert_same(got, expected):
    for stamp in ("t_host_ns", "t_device_ns", "sequence", "values"):
        np.testing.assert_array_equal(getattr(got, stamp), getattr(expected, stamp))


@pytest.mark.parametrize("name", CASES)
def test_golden_bytes(name):
    """The bytes of a version never change: a station may be older than the store."""
    descriptor, batch = CASES[name]
    golden = (GOLDEN / f"{name}_v2.bin").read_bytes()
    assert golden == by_hand(descriptor.name, batch, 5)
    assert wire.encode_batch(descriptor, batch, number=5) == golden
    assert_same(wire.decode_batch(golden, descriptor, number=5), batch)
    assert wire.read_batch(golden, descriptor, number=5) == wire.encode_samples(descriptor, batch)


@pytest.mark.parametrize("version", [0, 1, 3])
def test_another_version_is_refused_with_what_to_do(version):
    descriptor, batch = CASES["batch"]
    data = bytearray(wire.encode_batch(descriptor, batch, number=5))
    struct.pack_into("<H", data, 4, version)
    told = (
        f"batch 5 of 'wrist_left': got wire version {version}, expected 2; "
        "use a station and a store of the same release"
    )
    with pytest.raises(PacketError, match=f"^{told}$"):
        wire.read_batch(bytes(data), descriptor, number=5)


@pytest.mark.parametrize("name", CASES)
def test_bodies_end_to_end_are_a_body(name):
    descriptor, batch = CASES[name]
    parts = [SampleBatch(*(c[k : k + 1] for c in vars(batch).values())) for k in range(len(batch))]
    bodies = [wire.encode_body(descriptor, part) for part in parts]
    whole = wire.encode_body(descriptor, batch)
    assert b"".join(bodies) == whole
    ends = wire.sample_ends(descriptor, whole, len(batch))
    assert ends == np.cumsum([len(body) for body in bodies]).tolist()


@pytest.mark.parametrize("name", CASES)
def test_every_flipped_bit_and_every_cut_is_refused(name):
    descriptor, _ = CASES[name]
    data = (GOLDEN / f"{name}_v2.bin").read_bytes()
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


ONE = struct.pack("<qqq7d", 5, -1, 0, *range(7))
JPEG = (GOLDEN / "image.jpg").read_bytes()


def image(data, length=None):
    return struct.pack("<qqqI", 5, -1, 0, len(data) if length is None else length) + data


@pytest.mark.parametrize(
    ("descriptor", "body", "count", "told"),
    [
        (POSE, ONE[:-1], 1, "79 bytes are not those of 1 samples of 'wrist_left'"),
        (POSE, ONE + ONE, 1, "160 bytes"),
        (POSE, ONE, 65_536, "65536 samples"),
        (POSE, b"", 0, "an empty batch"),
        (POSE, ONE + struct.pack("<qqq7d", 4, -1, 0, *range(7)), 2, "goes back"),
        # Their difference as an int64 is 1.
        (POSE, b"".join(struct.pack("<q", t) + ONE[8:] for t in (2**63 - 1, -(2**63))), 2, "back"),
        (CAMERA, image(JPEG)[:-1], 1, "1 samples of 'camera_head'"),
        (CAMERA, image(JPEG) + b"\0", 1, "1 samples"),
        (CAMERA, image(JPEG) + image(JPEG)[:20], 2, "2 samples"),
        (CAMERA, image(JPEG), 65_536, "65536 samples"),
        (CAMERA, image(JPEG, 2**32 - 1), 1, "1 samples"),
        (CAMERA, image(b"") + image(JPEG), 2, "image 0 of the batch"),
        (CAMERA, image(b"no image"), 1, "8 bytes are not a JPEG"),
    ],
)
def test_a_whole_body_with_wrong_content_is_refused(descriptor, body, count, told):
    with pytest.raises(InvalidInputError, match=told):
        wire.read_batch(framed(descriptor.name, body, count), descriptor, number=0)


def test_a_body_of_another_stream_or_number_or_size_is_refused():
    for data in (framed("wrist_right", ONE, 1), framed("wrist_left", ONE, 1, 7)):
        with pytest.raises(InvalidInputError, match=r"expected batch 0 of 'wrist_left'"):
            wire.read_batch(data, POSE, number=0)
    with pytest.raises(PacketError, match="expected 4294967295"):
        wire.read_batch(framed("wrist_left", ONE, 1, length=2**32 - 1), POSE, number=0)
    with pytest.raises(LimitExceededError, match="65536"):
        wire.read_batch(framed("wrist_left", ONE, 2**32 - 1), POSE, number=0)


def test_numbers_keep_their_bits():
    """NaN of both signs with a payload, infinities and -0.0: recordings hold raw values."""
    bits = np.array([2**63 - 5, -5, 0x7FF << 52, -(1 << 52), -(2**63), 1, 0], dtype=np.int64)
    values = bits.view(np.float64).reshape(1, 7)
    zeros = np.zeros(1, np.int64)
    data = wire.encode_batch(POSE, SampleBatch(zeros, zeros, zeros, values), number=0)
    found = wire.decode_batch(data, POSE, number=0)
    assert found.values.view(np.int64).tolist() == [bits.tolist()]


def test_samples_that_arrive_at_one_time_are_taken():
    stamps = np.array([7, 7, 8])
    batch = SampleBatch(stamps, stamps, stamps, np.zeros((3, 7)))
    data = wire.encode_batch(POSE, batch, number=0)
    assert_same(wire.decode_batch(data, POSE, number=0), batch)


def test_limits():
    with pytest.raises(InvalidInputError, match="empty"):
        wire.encode_batch(POSE, pose_batch(0), number=0)
    with pytest.raises(InvalidInputError, match="number"):
        wire.encode_batch(POSE, pose_batch(), number=-1)
    with pytest.raises(LimitExceededError, match="65536"):
        wire.encode_batch(POSE, pose_batch(65_537), number=0)
    with pytest.raises(InvalidInputError, match="number"):
        wire.encode_batch(POSE, pose_batch(), number=1 << 32)
    with pytest.raises(LimitExceededError, match="send fewer samples"):
        wire.frame_body("wrist_left", bytes(wire.MAX_BATCH_BYTES), 1, number=0)
    with pytest.raises(LimitExceededError, match="at most"):
        wire.decode_batch(bytes(wire.MAX_BATCH_BYTES + 1), POSE, number=0)
