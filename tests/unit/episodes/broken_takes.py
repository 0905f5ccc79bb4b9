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


def kept_numbers(store, recording_id="take-1", *, broken_off=True):
    """The numbers of the samples of `force`; stamps and values agree, and nothing is damaged."""
    reader = store.recording(recording_id)
    reader.verify()
    assert reader.attributes.recovered
    ledger = [(entry.stream, entry.event) for entry in reader.attributes.ledger]
    marked = [stream.name for stream in reader.attributes.streams] if broken_off else []
    assert ledger == [(name, "interrupted") for name in marked]
    batch = reader.read("force")
    assert batch.values[:, 0].tolist() == batch.t_host_ns.tolist()
    return batch.t_host_ns.tolist()


def stages(store):
    return list((store.root / ".staging").iterdir())


def break_off(store, fill, *streams, error=RuntimeError, options=None):
    """A take of some samples that an exception ends; what its user is told about it."""
    with (
        pytest.raises(error) as caught,
        store.writer(kind="recording", attributes=take(*streams), options=options) as writer,
    ):
        _fill_and_fail(writer, fill, error)
    return " ".join(getattr(caught.value, "__notes__", []))


def _fill_and_fail(writer, fill, error):
    fill(writer)
    raise error("the glove came off")


def record_17(writer):
    """Three storage chunks of five samples, and two samples that wait in memory."""
    for number in range(17):
        record(writer, number)
