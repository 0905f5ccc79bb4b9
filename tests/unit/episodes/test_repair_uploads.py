"""Uploads that are damaged before they are finished: what holds becomes a recording."""

import numpy as np
import pytest

from dextouch.episodes import GopEncoder, VideoSettings
from dextouch.episodes.maintenance import inspect_upload, repair_uploads
from dextouch.episodes.spool import SpoolWriter
from dextouch.episodes.spool_log import HEADER_BYTES, LOG_FILE, LOG_MAGIC
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from tests.unit.episodes.hostile_group import flip

FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)


def recording_attributes():
    return RecordingAttributes(
        recording_id="take-1",
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        streams=(FORCE,),
    )


def batch(first, count):
    numbers = np.arange(first, first + count, dtype=np.int64)
    values = np.stack([numbers, numbers + 0.5], axis=1).astype("f4")
    return SampleBatch(numbers * 10, numbers, numbers, values)


@pytest.fixture
def spool(store):
    path = store.root / ".uploads" / "take-1"
    writer = SpoolWriter(path, recording_attributes(), sync=False)
    for number in range(50):
        writer.append("force", batch(number, 1))
    writer.abandon()
    return path


# Bytes of a record: its header, three stamps and two floats.
RECORD = HEADER_BYTES + 3 * 8 + 2 * 4


@pytest.mark.parametrize(
    ("place", "told"),
    [(HEADER_BYTES + 30, "batch 7 of 'force'"), (9, f"bytes {8 + 7 * RECORD} …")],
)
def test_a_damaged_upload_is_salvaged(store, spool, place, told):
    flip(spool / LOG_FILE, len(LOG_MAGIC) + 7 * RECORD + place)
    report = inspect_upload(spool)
    assert report.damaged
    assert told in report.findings[0].message
    (result,) = repair_uploads(store.root)
    assert (result.kind, result.action, result.lost) == ("upload", "salvaged", {"force": 1})
    reader = store.recording("take-1-salvaged-1")
    reader.verify()
    assert reader.read("force").sequence.tolist() == [n for n in range(50) if n != 7]
    expected = batch(0, 50).values[np.arange(50) != 7]
    np.testing.assert_array_equal(reader.read("force").values, expected)
    (ledger,) = reader.attributes.ledger
    assert (ledger.stream, ledger.event, ledger.count) == ("force", "lost_to_damage", 1)
    assert reader.attributes.recovered
    # The station may send all of it anew.
    assert not spool.exists()
    assert not store.exists("take-1", kind="recording")
    store.restore("take-1", kind="upload")
    assert (spool / LOG_FILE).is_file()


@pytest.mark.parametrize(("number", "lost"), [(0, 8), (10, 8), (15, 8), (17, 4), (19, 1)])
def test_of_video_in_an_upload_whole_groups_are_kept(store, number, lost):
    """An image of H.264 cannot do without those before it; what is torn off last is no damage."""
    camera = StreamDescriptor(
        name="camera",
        kind="image",
        shape=(32, 32, 3),
        dtype="uint8",
        unit="h264",
        nominal_rate_hz=30,
    )
    encoder = GopEncoder(32, 32, rate_hz=30.0, settings=VideoSettings())
    units = [encoder.encode(np.full((32, 32, 3), 9 * i, np.uint8)) for i in range(20)]
    attributes = recording_attributes().model_copy(update={"streams": (camera, FORCE)})
    spool = store.root / ".uploads" / "take-1"
    numbers = np.arange(20)
    writer = SpoolWriter(spool, attributes, sync=False)
    for k in range(9):
        writer.append("force", batch(k, 1))
    for k in range(20):
        stamp = numbers[k : k + 1]
        writer.append("camera", SampleBatch(stamp, stamp, stamp, encoded_values([units[k]])))
    writer.abandon()
    camera_record = HEADER_BYTES + 3 * 8 + 4
    start = len(LOG_MAGIC) + 9 * RECORD + sum(camera_record + len(unit) for unit in units[:number])
    flip(spool / LOG_FILE, len(LOG_MAGIC) + HEADER_BYTES + 27)
    flip(spool / LOG_FILE, start + camera_record + 6)
    (result,) = repair_uploads(store.root)
    torn = number == 19
    assert result.lost == {"force": 1} | ({} if torn else {"camera": lost})
    reader = store.recording("take-1-salvaged-1")
    first = number // 8 * 8
    kept = [i for i in range(20) if not first <= i < first + 8] if not torn else list(range(19))
    assert reader.read("camera").sequence.tolist() == kept
    assert reader.encoded_images("camera", 0, len(kept)) == [units[i] for i in kept]
    assert len(reader.images("camera")) == len(kept)


def test_whole_and_torn_uploads_are_left_to_their_station(store, spool):
    assert not inspect_upload(spool).damaged
    file = spool / LOG_FILE
    file.write_bytes(file.read_bytes()[:-3])
    assert not inspect_upload(spool).damaged
    flip(file, -RECORD)
    assert not inspect_upload(spool).damaged
    assert repair_uploads(store.root) == []


@pytest.mark.parametrize("lost_bytes", [3, RECORD, 30 * RECORD])
def test_what_a_closed_upload_has_lost_is_named(store, spool, lost_bytes):
    """Closed by a service that died before it had committed it."""
    SpoolWriter.resume(spool, sync=False).close()
    assert not inspect_upload(spool).damaged
    file = spool / LOG_FILE
    file.write_bytes(file.read_bytes()[:-lost_bytes])
    (finding,) = inspect_upload(spool).findings
    assert f"expected {8 + 50 * RECORD}" in finding.message
    (result,) = repair_uploads(store.root)
    num_lost = -(-lost_bytes // RECORD)
    assert (result.action, result.lost) == ("salvaged", {"force": num_lost})
    reader = store.recording("take-1-salvaged-1")
    assert reader.num_samples("force") == 50 - num_lost
    assert [entry.count for entry in reader.attributes.ledger] == [num_lost]
