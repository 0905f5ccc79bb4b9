"""The spool: what was acknowledged stays, whatever happens to the process, the disk or the bits."""

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import log
from dextouch.episodes.journal import SAMPLE_JOURNAL
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    ShapeError,
    StorageFullError,
    UnknownNameError,
)
from dextouch.images.jpeg import encode_jpeg
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch, encoded_values

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


@pytest.fixture
def path(tmp_path):
    return tmp_path / "spool" / "take-1"


def fill(path, count=10):
    with log.SpoolWriter(path, ATTRIBUTES) as writer:
        for first in range(count):
            writer.append("glove_left", glove_batch(first))
        writer.append("camera_head", camera_batch(0, 3))
    return path


def test_batches_come_back_and_are_the_same_whoever_cuts_them(path):
    fill(path)
    reader = log.SpoolReader(path)
    assert reader.attributes == ATTRIBUTES
    assert reader.closed
    assert_same(reader.read("glove_left"), glove_batch(0, 10))
    assert_same(reader.read("camera_head", 1, 2), camera_batch(1))
    assert [len(b) for b in reader.batches("glove_left", num_samples=4)] == [4, 4, 2]
    (later,) = reader.batches("glove_left", num_samples=4, first=2)
    assert_same(later, glove_batch(8, 2))


def test_a_living_spool_shows_full_batches_only(path):
    writer = log.SpoolWriter(path, ATTRIBUTES)
    writer.append("glove_left", glove_batch(0, 6))
    reader = log.SpoolReader(path)
    assert not reader.closed
    assert [len(b) for b in reader.batches("glove_left", num_samples=4)] == [4]
    with pytest.raises(ConflictError, match="another process"):
        log.recover(path)
    writer.close()
    writer.close()


def test_resume_goes_on_where_it_stopped(path):
    fill(path)
    with log.SpoolWriter.resume(path) as writer:
        assert not (path / "closed").exists()
        assert writer.num_samples("glove_left") == 10
        with pytest.raises(InvalidInputError, match="goes back"):
            writer.append("glove_left", glove_batch(8))
        writer.append("glove_left", glove_batch(10, 2))
        writer.truncate("camera_head", 1)
    reader = log.SpoolReader(path)
    assert_same(reader.read("glove_left"), glove_batch(0, 12))
    assert_same(reader.read("camera_head"), camera_batch(0))


def test_torn_ends_are_cut_and_counted(path):
    fill(path)
    with (path / "glove_left.journal").open("ab") as journal:
        journal.write(b"\x01" * (SAMPLE_JOURNAL.dtype.itemsize + 7))
    with (path / "glove_left.part").open("ab") as part:
        part.write(b"half a sample")
    assert log.SpoolReader(path).num_samples("glove_left") == 10
    glove, camera = log.recover(path)
    assert (glove.num_samples, glove.dropped_part_bytes) == (10, 13)
    assert glove.dropped_journal_bytes == SAMPLE_JOURNAL.dtype.itemsize + 7
    assert (camera.num_samples, camera.dropped_part_bytes) == (3, 0)
    assert log.recover(path)[0].dropped_part_bytes == 0


@pytest.mark.parametrize("lost_bytes", [1, 720, 3000])
def test_rows_whose_payload_never_arrived_are_dropped(path, lost_bytes):
    fill(path)
    part = path / "glove_left.part"
    whole = part.read_bytes()
    # Power loss: the journal reached the disk, the end of the part file did not, or as zeros.
    part.write_bytes(whole[:-lost_bytes])
    expected = (7200 - lost_bytes) // 720
    assert log.recover(path)[0].num_samples == expected
    assert_same(log.SpoolReader(path).read("glove_left"), glove_batch(0, expected))


def test_zeroed_payloads_at_the_end_are_dropped(path):
    fill(path)
    part = path / "glove_left.part"
    part.write_bytes(part.read_bytes()[:-1000] + bytes(1000))
    assert log.recover(path)[0].num_samples == 8


def test_damage_in_the_middle_is_refused_and_changes_nothing(path):
    fill(path)
    journal = path / "glove_left.journal"
    whole = bytearray(journal.read_bytes())
    whole[len(SAMPLE_JOURNAL.magic) + 3 * SAMPLE_JOURNAL.dtype.itemsize + 8] ^= 1
    journal.write_bytes(whole)
    with pytest.raises(CorruptDataError, match="row 3 of 10"):
        log.recover(path)
    assert journal.read_bytes() == bytes(whole)
    with pytest.raises(CorruptDataError, match="glove_left"):
        log.SpoolReader(path).num_samples("glove_left")
    assert_same(log.SpoolReader(path).read("camera_head"), camera_batch(0, 3))


def test_a_flipped_payload_bit_is_refused(path):
    fill(path)
    part = path / "glove_left.part"
    whole = bytearray(part.read_bytes())
    whole[800] ^= 4
    part.write_bytes(whole)
    reader = log.SpoolReader(path)
    assert_same(reader.read("glove_left", 0, 1), glove_batch(0))
    with pytest.raises(CorruptDataError, match="glove_left"):
        reader.read("glove_left")


def test_a_foreign_journal_is_refused(path):
    fill(path)
    journal = path / "glove_left.journal"
    journal.write_bytes(b"DXTJRNL\x02" + journal.read_bytes()[8:])
    with pytest.raises(CorruptDataError, match="expected"):
        log.recover(path)


def test_a_full_disk_keeps_what_was_recorded(path, file_size_limit):
    writer = log.SpoolWriter(path, ATTRIBUTES)
    with file_size_limit(5000):
        for first in range(6):
            writer.append("glove_left", glove_batch(first))
        with pytest.raises(StorageFullError, match="what was recorded stays"):
            writer.append("glove_left", glove_batch(6))
        assert writer.num_samples("glove_left") == 6
    # Space is free again: recording goes on without a gap in the files.
    writer.append("glove_left", glove_batch(7))
    writer.close()
    got = log.SpoolReader(path).read("glove_left")
    assert got.sequence.tolist() == [0, 1, 2, 3, 4, 5, 7]


def test_what_does_not_fit_is_refused(path, tmp_path):
    writer = log.SpoolWriter(path, ATTRIBUTES)
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
        log.SpoolWriter(path, ATTRIBUTES)
    with pytest.raises(NotFoundError):
        log.SpoolReader(tmp_path / "none")
    with pytest.raises(InvalidInputError, match="without a stream"):
        log.SpoolWriter(tmp_path / "x", ATTRIBUTES.model_copy(update={"streams": ()}))
    writer.close()


CHILD = """
import sys
from pathlib import Path
import numpy as np
from dextouch.episodes.log import SpoolWriter
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.samples import SampleBatch

attributes = RecordingAttributes.model_validate_json(sys.argv[2])
writer = SpoolWriter(Path(sys.argv[1]), attributes)
for number in range(100_000):
    k = np.array([number])
    values = (k[:, None] + np.arange(360)).astype("<u2")
    writer.append("glove_left", SampleBatch(k * 16_666_667, k * 1000, k, values))
    if number % 10 == 0:
        writer.flush()
    sys.stdout.write(f"{number}\\n")
    sys.stdout.flush()
"""


def kill_in_the_middle(path, num_lines):
    """Acknowledged samples of a child that was killed after at least `num_lines` of them."""
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), ATTRIBUTES.model_dump_json()],
        stdout=subprocess.PIPE,
    )
    for _ in range(num_lines):
        child.stdout.readline()
    child.kill()
    rest = child.stdout.read().splitlines(keepends=True)
    child.stdout.close()
    child.wait()
    return num_lines + sum(line.endswith(b"\n") for line in rest)


def check_kills(folder: Path, count: int, seed: int):
    rng = random.Random(seed)
    for trial in range(count):
        path = folder / f"take-{trial}"
        acknowledged = kill_in_the_middle(path, rng.randint(1, 200))
        report = log.recover(path)[0]
        assert acknowledged <= report.num_samples <= acknowledged + 1
        got = log.SpoolReader(path).read("glove_left")
        assert_same(got, glove_batch(0, report.num_samples))


def test_a_killed_process_loses_nothing_acknowledged(tmp_path):
    check_kills(tmp_path, 5, seed=1)


@pytest.mark.slow
def test_a_killed_process_loses_nothing_acknowledged_50_times(tmp_path):
    check_kills(tmp_path, 50, seed=2)
