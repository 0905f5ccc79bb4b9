"""The spool: what was acknowledged stays, whatever happens to the process, the disk or the bits."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import spool
from dextouch.episodes.files import write_parts
from dextouch.episodes.spool_log import HEADER_BYTES, LOG_FILE, LOG_MAGIC, open_log
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    ShapeError,
    StorageError,
    StorageFullError,
    UnknownNameError,
)
from dextouch.streams import SampleBatch, encode_body, encoded_values
from tests.unit.episodes.spooled_batches import (
    ATTRIBUTES,
    CAMERA,
    GLOVE,
    assert_same,
    camera_batch,
    glove_batch,
    recover,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "spool" / "take-1"


def fill(path, count=10, *, close=True):
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    for first in range(count):
        writer.append("glove_left", glove_batch(first))
    writer.append("camera_head", camera_batch(0, 3))
    if close:
        writer.close()
    else:
        writer.abandon()
    return path


def test_batches_come_back_and_are_the_same_whoever_cuts_them(path):
    fill(path)
    reader = spool.SpoolReader(path)
    assert reader.attributes == ATTRIBUTES
    assert reader.closed
    assert_same(reader.read("glove_left"), glove_batch(0, 10))
    assert_same(reader.read("camera_head", 1, 2), camera_batch(1))
    assert_same(reader.read("glove_left", 8, 10), glove_batch(8, 2))


def test_a_living_spool_is_read_and_left_alone(path):
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    writer.append("glove_left", glove_batch(0, 6))
    reader = spool.SpoolReader(path)
    assert not reader.closed
    assert_same(reader.read("glove_left"), glove_batch(0, 6))
    with pytest.raises(ConflictError, match="another process"):
        recover(path)
    writer.close()
    writer.close()


def test_resume_goes_on_where_it_stopped(path):
    fill(path)
    with spool.SpoolWriter.resume(path) as writer:
        assert not (path / "closed").exists()
        assert writer.num_samples("glove_left") == 10
        with pytest.raises(InvalidInputError, match="goes back"):
            writer.append("glove_left", glove_batch(8))
        writer.append("glove_left", glove_batch(10, 2))
        assert (writer.num_samples("glove_left"), writer.num_batches("glove_left")) == (12, 11)
    reader = spool.SpoolReader(path)
    assert_same(reader.read("glove_left"), glove_batch(0, 12))
    assert_same(reader.read("camera_head"), camera_batch(0, 3))


def test_a_spool_that_is_resumed_takes_nothing_from_before_its_last_sample(path):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        writer.append("glove_left", glove_batch(0, 5))
    with spool.SpoolWriter.resume(path) as writer:
        with pytest.raises(InvalidInputError, match="goes back"):
            writer.append("glove_left", glove_batch(3))
        writer.append("glove_left", glove_batch(5))


def test_what_a_crashed_process_wrote_is_synced_before_it_counts(path, monkeypatch):
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    writer.append("glove_left", glove_batch(0))
    writer.abandon()
    synced = []
    monkeypatch.setattr(
        "os.fdatasync", lambda file: synced.append(Path(f"/proc/self/fd/{file}").readlink().name)
    )
    spool.SpoolWriter.resume(path).abandon()
    assert LOG_FILE in synced


def test_samples_come_back_by_place_and_by_append(path):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        for first, count in ((0, 3), (3, 1), (4, 5)):
            writer.append("glove_left", glove_batch(first, count))
            writer.append("camera_head", camera_batch(first, count))
    reader = spool.SpoolReader(path)
    for start in range(10):
        for stop in range(start, 10):
            assert_same(reader.read("glove_left", start, stop), glove_batch(start, stop - start))
            assert len(reader.read("camera_head", start, stop)) == stop - start
    assert_same(reader.read("camera_head", 2, 5), camera_batch(2, 3))
    body = encode_body(GLOVE, glove_batch(4, 5))
    assert (reader.appended("glove_left", 2), reader.body("glove_left", 4, 9)) == (body, body)
    for number in (-1, 3):
        with pytest.raises(InvalidInputError, match="append"):
            reader.appended("glove_left", number)


GLOVE_BODY = 3 * 8 + 720
GLOVE_RECORD = HEADER_BYTES + GLOVE_BODY


@pytest.fixture
def gloves(path):
    """A spool whose process died; its log is ten records of the same length."""
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    for first in range(10):
        writer.append("glove_left", glove_batch(first))
    writer.abandon()
    assert (path / LOG_FILE).stat().st_size == len(LOG_MAGIC) + 10 * GLOVE_RECORD
    return path


def test_torn_ends_are_cut_and_counted(path):
    fill(path, close=False)
    with (path / LOG_FILE).open("ab") as file:
        file.write(b"\x01" * 1234)
    assert spool.SpoolReader(path).num_samples("glove_left") == 10
    report = recover(path)
    assert report.num_samples == {"glove_left": 10, "camera_head": 3}
    assert report.dropped_bytes == 1234
    assert recover(path).dropped_bytes == 0
    assert_same(spool.SpoolReader(path).read("camera_head"), camera_batch(0, 3))


@pytest.mark.parametrize("lost_bytes", [1, 20, 720, GLOVE_RECORD - 1, GLOVE_RECORD, 3000, 7800])
def test_a_log_cut_off_anywhere_ends_with_its_last_whole_record(gloves, lost_bytes):
    file = gloves / LOG_FILE
    whole = file.read_bytes()
    file.write_bytes(whole[:-lost_bytes])
    expected = max(0, 10 * GLOVE_RECORD - lost_bytes) // GLOVE_RECORD
    assert recover(gloves).num_samples["glove_left"] == expected
    assert_same(spool.SpoolReader(gloves).read("glove_left"), glove_batch(0, expected))
    writer = spool.SpoolWriter.resume(gloves)
    writer.append("glove_left", glove_batch(expected))
    writer.abandon()
    assert (
        file.read_bytes()[: len(LOG_MAGIC) + expected * GLOVE_RECORD]
        == (whole[: len(LOG_MAGIC) + expected * GLOVE_RECORD])
    )
    assert_same(spool.SpoolReader(gloves).read("glove_left"), glove_batch(0, expected + 1))


def test_zeroed_bytes_at_the_end_are_dropped(gloves):
    # Power loss: the length of the file reached the disk, its last bytes did not.
    file = gloves / LOG_FILE
    file.write_bytes(file.read_bytes()[:-1000] + bytes(1000))
    report = recover(gloves)
    assert report.num_samples["glove_left"] == 8
    assert report.dropped_bytes == 2 * GLOVE_RECORD


def test_all_records_whose_bodies_did_not_reach_the_disk_are_dropped(path):
    """Their headers did, in a take that was not closed before the power went."""
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    for first in range(5):
        writer.append("glove_left", glove_batch(first))
    writer.abandon()
    file = path / LOG_FILE
    data = bytearray(file.read_bytes())
    for number in (3, 4):
        start = len(LOG_MAGIC) + number * GLOVE_RECORD + HEADER_BYTES
        data[start : start + GLOVE_BODY] = bytes(GLOVE_BODY)
    file.write_bytes(data)
    with spool.SpoolWriter.resume(path) as writer:
        assert writer.num_samples("glove_left") == 3
        writer.append("glove_left", glove_batch(3, 2))
    assert_same(spool.SpoolReader(path).read("glove_left"), glove_batch(0, 5))


def test_a_mark_is_found_across_the_blocks_that_are_searched(tmp_path):
    """Blocks are of 1 MiB; the mark begins before, on and behind their border."""
    file = tmp_path / LOG_FILE
    for place in range(2**20 - 4, 2**20 + 2):
        file.write_bytes(LOG_MAGIC + bytes(place - len(LOG_MAGIC)) + b"DXTS" + bytes(100))
        with open_log(tmp_path) as log:
            assert log.find(b"DXTS", len(LOG_MAGIC) - 8) == place
            assert log.find(b"DXTS", place + 1) == -1


@pytest.mark.parametrize("place", [0, 5, 13, 20, 25, 30, 37])
def test_a_damaged_header_in_the_middle_is_refused_and_changes_nothing(gloves, place):
    file = gloves / LOG_FILE
    whole = bytearray(file.read_bytes())
    whole[len(LOG_MAGIC) + 3 * GLOVE_RECORD + place] ^= 1
    file.write_bytes(whole)
    with pytest.raises(CorruptDataError, match="not a record, but valid ones follow"):
        recover(gloves)
    assert file.read_bytes() == bytes(whole)
    with pytest.raises(CorruptDataError, match="restore the file"):
        spool.SpoolReader(gloves).num_samples("glove_left")


def test_a_record_that_is_missing_is_refused(gloves):
    file = gloves / LOG_FILE
    whole = file.read_bytes()
    start = len(LOG_MAGIC) + 3 * GLOVE_RECORD
    file.write_bytes(whole[:start] + whole[start + GLOVE_RECORD :])
    # Every record behind lies where it does not say; none holds.
    assert spool.SpoolReader(gloves).num_samples("glove_left") == 3
    file.write_bytes(whole[:start] + bytes(GLOVE_RECORD) + whole[start + GLOVE_RECORD :])
    with pytest.raises(CorruptDataError, match="not a record"):
        spool.SpoolReader(gloves).num_samples("glove_left")


def test_a_flipped_bit_of_a_body_is_refused(gloves):
    file = gloves / LOG_FILE
    whole = bytearray(file.read_bytes())
    whole[len(LOG_MAGIC) + GLOVE_RECORD + 700] ^= 4
    file.write_bytes(whole)
    reader = spool.SpoolReader(gloves)
    assert_same(reader.read("glove_left", 0, 1), glove_batch(0))
    with pytest.raises(CorruptDataError, match="does not match its checksum"):
        reader.read("glove_left")


def test_a_log_inside_an_image_is_not_read_as_one(path):
    """A station may well film a screen, or send anything: records are found by their place."""
    video = CAMERA.model_copy(update={"unit": "h264"})
    attributes = ATTRIBUTES.model_copy(update={"streams": (video,)})
    with spool.SpoolWriter(path, attributes) as writer:
        one = SampleBatch(*np.zeros((3, 1), dtype=np.int64), encoded_values([b"\0\0\1\x65"]))
        writer.append("camera_head", one)
    forged = b"\0\0\1\x65" + (path / LOG_FILE).read_bytes() * 3
    writer = spool.SpoolWriter.resume(path)
    writer.append("camera_head", SampleBatch(*np.ones((3, 1), np.int64), encoded_values([forged])))
    writer.abandon()
    file = path / LOG_FILE
    whole = bytearray(file.read_bytes())
    second = len(whole) - len(forged) - 4 - 24 - HEADER_BYTES
    assert spool.SpoolReader(path).read("camera_head").values[1] == forged
    whole[second] ^= 1
    file.write_bytes(whole)
    assert recover(path).num_samples == {"camera_head": 1}


def test_a_foreign_or_missing_log_is_refused(path):
    fill(path, close=False)
    file = path / LOG_FILE
    file.write_bytes(b"DXTBLOB\x02" + file.read_bytes()[8:])
    with pytest.raises(CorruptDataError, match="expected"):
        recover(path)
    file.unlink()
    with pytest.raises(CorruptDataError, match="missing"):
        spool.SpoolReader(path).num_samples("glove_left")


def test_a_log_of_other_streams_is_refused(path):
    fill(path, close=False)
    smaller = GLOVE.model_copy(update={"shape": (300,)})
    for streams in ((GLOVE,), (smaller, CAMERA)):
        attributes = ATTRIBUTES.model_copy(update={"streams": streams})
        (path / "recording.json").write_text(attributes.model_dump_json())
        with pytest.raises(CorruptDataError, match="stream"):
            spool.SpoolReader(path).read("glove_left")


def test_a_batch_that_cannot_be_flushed_is_not_there(path, monkeypatch):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        writer.append_record(writer.encode("glove_left", glove_batch(0)), flush=True)
        with monkeypatch.context() as patch:
            patch.setattr("os.fdatasync", _fail)
            with pytest.raises(StorageError, match="sync"):
                writer.append_record(writer.encode("glove_left", glove_batch(1)), flush=True)
        assert writer.num_batches("glove_left") == 1
        writer.append_record(writer.encode("glove_left", glove_batch(1, 2)), flush=True)
    assert_same(spool.SpoolReader(path).read("glove_left"), glove_batch(0, 3))


def test_a_spool_that_cannot_be_sealed_is_open_until_it_can(path, monkeypatch):
    """A full disk while a take is saved: saving it again must not do nothing."""
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    writer.append("glove_left", glove_batch(0))
    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.spool.replace_file", _fail)
        with pytest.raises(StorageError, match="close spool"):
            writer.close()
    assert not spool.SpoolReader(path).closed
    writer.close()
    assert spool.SpoolReader(path).closed


def _fail(*_):
    raise OSError(errno.EIO, "the disk is broken")


def test_a_full_disk_keeps_what_was_recorded(path, file_size_limit):
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    with file_size_limit(5000):
        for first in range(6):
            writer.append("glove_left", glove_batch(first))
        with pytest.raises(StorageFullError, match="what was recorded stays"):
            writer.append("glove_left", glove_batch(6))
        assert writer.num_samples("glove_left") == 6
    # Space is free again: recording goes on without a gap in the files.
    writer.append("glove_left", glove_batch(7))
    writer.close()
    got = spool.SpoolReader(path).read("glove_left")
    assert got.sequence.tolist() == [0, 1, 2, 3, 4, 5, 7]


@pytest.mark.parametrize("portion", [1, 7, 40, 43, 44, 45, 700])
def test_short_writes_go_on_where_they_ended(path, monkeypatch, portion):
    whole = os.writev

    def some(descriptor, parts):
        first, *rest = parts
        if len(first) >= portion or not rest:
            return os.write(descriptor, first[:portion])
        return whole(descriptor, [first, rest[0][: portion - len(first)]])

    monkeypatch.setattr(os, "writev", some)
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        for first in range(3):
            writer.append("glove_left", glove_batch(first))
    assert_same(spool.SpoolReader(path).read("glove_left"), glove_batch(0, 3))


def test_more_parts_than_one_call_takes_are_written(tmp_path):
    parts = [bytes([number % 251]) * (1 + number % 3) for number in range(2500)]
    with (tmp_path / "parts").open("wb") as file:
        write_parts(file.fileno(), *parts)
    assert (tmp_path / "parts").read_bytes() == b"".join(parts)


def test_an_encoded_batch_is_written_later_and_must_follow(path):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        records = [writer.encode("glove_left", glove_batch(first)) for first in (0, 1)]
        assert writer.num_samples("glove_left") == 0
        for record in records:
            writer.append_record(record)
        with pytest.raises(InvalidInputError, match="goes back to 0 from 16666667"):
            writer.append_record(records[0])
    assert_same(spool.SpoolReader(path).read("glove_left"), glove_batch(0, 2))


def test_what_does_not_fit_is_refused(path, tmp_path):
    writer = spool.SpoolWriter(path, ATTRIBUTES)
    with pytest.raises(UnknownNameError, match="camera_head"):
        writer.append("glove", glove_batch(0))
    good = glove_batch(0, 2)
    with pytest.raises(ShapeError, match="uint16"):
        writer.append(
            "glove_left",
            SampleBatch(good.t_host_ns, good.t_device_ns, good.sequence, good.values[:, :300]),
        )
    with pytest.raises(InvalidInputError, match="after sample 0"):
        writer.append(
            "glove_left",
            SampleBatch(good.t_host_ns[::-1], good.t_device_ns, good.sequence, good.values),
        )
    with pytest.raises(ShapeError, match="bytes, one an image"):
        writer.append("camera_head", glove_batch(0))
    with pytest.raises(ConflictError, match="exists"):
        spool.SpoolWriter(path, ATTRIBUTES)
    with pytest.raises(NotFoundError):
        spool.SpoolReader(tmp_path / "none")
    with pytest.raises(InvalidInputError, match="without a stream"):
        spool.SpoolWriter(tmp_path / "x", ATTRIBUTES.model_copy(update={"streams": ()}))
    writer.close()
