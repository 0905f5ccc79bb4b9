"""A take of one glove and one camera as tests spool it: descriptors, batches, comparison."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dextouch.episodes.spool import LOG_FILE, SpoolWriter
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values

GOLDEN = Path(__file__).parents[2] / "golden"
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


def golden_batch(stream, first, count):
    """Samples of the golden spools, whose values are numbered."""
    k = np.arange(first, first + count, dtype=np.int64)
    if stream.unit == "jpeg":
        values = encoded_values([(GOLDEN / "image.jpg").read_bytes()] * count)
    elif stream.unit == "h264":
        values = encoded_values([b"\0\0\0\1\x65" + bytes([i]) * (i + 1) for i in k.tolist()])
    else:
        values = k[:, None] * stream.shape[0] + np.arange(stream.shape[0])
        values = values.astype(stream.dtype)
    return SampleBatch(k * 10, k * 10 - 5, k + 100, values)


def assert_same(got, expected):
    np.testing.assert_array_equal(got.values, expected.values)
    for stamp in ("t_host_ns", "t_device_ns", "sequence"):
        np.testing.assert_array_equal(getattr(got, stamp), getattr(expected, stamp))


@dataclass(frozen=True)
class Recovered:
    """Samples by stream of a spool that goes on after a crash, and the bytes cut off its log."""

    num_samples: dict[str, int]
    dropped_bytes: int


def recover(path):
    """Go on with a spool whose process died, and leave it again."""
    before = (path / LOG_FILE).stat().st_size if (path / LOG_FILE).exists() else 0
    writer = SpoolWriter.resume(path)
    writer.abandon()
    counts = {s.name: writer.num_samples(s.name) for s in writer.attributes.streams}
    return Recovered(counts, max(0, before - (path / LOG_FILE).stat().st_size))
