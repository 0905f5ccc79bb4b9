"""The digest of a stream: the same from batches as from what is committed, and of every byte."""

import hashlib
import struct

import numpy as np
import pytest

from dextouch.episodes import ContentDigest, EpisodeStore, GopEncoder, VideoSettings
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from tests.unit.episodes.spooled_batches import CAMERA, GLOVE, camera_batch, glove_batch

VIDEO = StreamDescriptor(
    name="camera_wrist",
    kind="image",
    shape=(32, 32, 3),
    dtype="uint8",
    unit="h264",
    nominal_rate_hz=30,
)


def video_batch(count):
    encoder = GopEncoder(32, 32, rate_hz=30.0, settings=VideoSettings())
    units = [encoder.encode(np.full((32, 32, 3), 9 * k, np.uint8)) for k in range(count)]
    k = np.arange(count)
    return SampleBatch(k * 7, k * 5, k, encoded_values(units))


def part(batch, start, stop):
    return SampleBatch(*(column[start:stop] for column in vars(batch).values()))


def digest_of(descriptor, batch, size):
    digest = ContentDigest(descriptor)
    for start in range(0, len(batch), size):
        digest.add(part(batch, start, start + size))
    return digest.content()


def by_hand(values, batch):
    """As documented: the sha256 of the hexadecimal sha256 of the arrays, with spaces between."""
    arrays = [values, *(np.array(c, dtype="<i8").tobytes() for c in list(vars(batch).values())[:3])]
    return hashlib.sha256(
        " ".join(hashlib.sha256(data).hexdigest() for data in arrays).encode()
    ).hexdigest()


def groups_of_eight(images):
    data = b""
    for start in range(0, len(images), 8):
        group = images[start : start + 8]
        data += struct.pack("<I", len(group)) + struct.pack(f"<{len(group)}I", *map(len, group))
        data += b"".join(group)
    return data


CASES = {
    "glove_left": (GLOVE, glove_batch(0, 130), lambda v: v.astype("<u2").tobytes()),
    "camera_head": (CAMERA, camera_batch(0, 21), b"".join),
    "camera_wrist": (VIDEO, video_batch(21), lambda v: groups_of_eight(list(v))),
}


@pytest.mark.parametrize("name", CASES)
def test_a_digest_is_that_of_the_arrays_however_it_is_cut(name):
    descriptor, batch, stored = CASES[name]
    expected = by_hand(stored(batch.values), batch)
    for size in (1, 3, 8, 120):
        got = digest_of(descriptor, batch, size)
        assert (got.num_samples, got.sha256) == (len(batch), expected)


def test_a_recording_says_what_is_committed(tmp_path):
    streams = tuple(descriptor for descriptor, _, _ in CASES.values())
    attributes = RecordingAttributes(
        recording_id="take-1",
        task="t",
        instruction="",
        domain="human",
        station="s",
        streams=(*streams, GLOVE.model_copy(update={"name": "glove_right"})),
    )
    store = EpisodeStore(tmp_path)
    with store.writer(kind="recording", attributes=attributes) as writer:
        for descriptor, batch, _ in CASES.values():
            writer.append(descriptor.name, **vars(batch))
    content = store.recording("take-1").content()
    assert content.pop("glove_right").num_samples == 0
    for name, (descriptor, batch, _) in CASES.items():
        assert content[name] == digest_of(descriptor, batch, 5), name


@pytest.mark.parametrize("column", ["t_host_ns", "t_device_ns", "sequence", "values"])
def test_no_column_may_differ(column):
    other = glove_batch(0, 130)
    getattr(other, column)[-1] += 1
    got, expected = (digest_of(GLOVE, batch, 120) for batch in (other, glove_batch(0, 130)))
    assert got.num_samples == expected.num_samples
    assert got.sha256 != expected.sha256
