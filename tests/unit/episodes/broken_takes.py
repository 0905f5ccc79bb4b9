"""Takes that break off while they are written."""

import numpy as np
import pytest

from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor

FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)
CAMERA = StreamDescriptor(
    name="camera", kind="image", shape=(48, 64, 3), dtype="uint8", unit="h264", nominal_rate_hz=30
)
# 3600 bytes a sample and 30 samples a storage chunk: noise fills a small disk quickly.
NOISE = StreamDescriptor(
    name="noise", kind="tactile", shape=(900,), dtype="float32", unit="kPa", nominal_rate_hz=60
)


def take(*streams, **changes):
    fields = {"recording_id": "take-1", "task": "t", "instruction": "", "domain": "human"}
    return RecordingAttributes.model_validate(
        fields | {"station": "bench", "streams": streams} | changes
    )


def record(writer, first, count=1):
    """Samples whose value and stamp are their number."""
    numbers = np.arange(first, first + count)
    values = np.repeat(numbers[:, None], 2, axis=1).astype("f4")
    writer.append("force", values=values, t_host_ns=numbers)


def assert_nothing_left(store):
    """Neither a recording, nor a stage, nor anything that a sweep finds."""
    assert store.list(kind="recording") == []
    assert list((store.root / ".staging").iterdir()) == []
    assert store.sweep() == 0


def break_off(store, fill, *streams, error=RuntimeError):
    """A take of some samples that an exception ends."""
    with (
        pytest.raises(error),
        store.writer(kind="recording", attributes=take(*streams)) as writer,
    ):
        _fill_and_fail(writer, fill, error)


def _fill_and_fail(writer, fill, error):
    fill(writer)
    raise error("the glove came off")


def record_17(writer):
    """Three storage chunks of five samples, and two samples that wait in memory."""
    for number in range(17):
        record(writer, number)
