"""A take of one glove and one camera as tests spool it: descriptors, batches, comparison."""

import numpy as np

from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values

GLOVE = StreamDescriptor(
    name="glove_left",
    kind="tactile",
    shape=(360,),
    dtype="uint16",
    unit="counts",
    nominal_rate_hz=60,
)
CAMERA = StreamDescriptor(
    name="camera_head",
    kind="image",
    shape=(8, 8, 3),
    dtype="uint8",
    unit="jpeg",
    nominal_rate_hz=30,
)
ATTRIBUTES = RecordingAttributes(
    recording_id="take-1",
    task="stand_bottle",
    instruction="",
    domain="human",
    station="bench",
    streams=(GLOVE, CAMERA),
)


def glove_batch(first, count=1):
    numbers = np.arange(first, first + count, dtype=np.int64)
    values = (numbers[:, None] + np.arange(360)).astype("<u2")
    return SampleBatch(numbers * 16_666_667, numbers * 1000, numbers, values)


def camera_batch(first, count=1):
    images = [np.full((8, 8, 3), 10 * (first + k), np.uint8) for k in range(count)]
    numbers = np.arange(first, first + count, dtype=np.int64)
    return SampleBatch(
        numbers, np.full(count, -1), numbers, encoded_values([encode_jpeg(i) for i in images])
    )


def assert_same(got, expected):
    np.testing.assert_array_equal(got.values, expected.values)
    for stamp in ("t_host_ns", "t_device_ns", "sequence"):
        np.testing.assert_array_equal(getattr(got, stamp), getattr(expected, stamp))
