"""Rows of one shard: how they are fetched, and what they are when the file below changes."""

import os
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import shards
from dextouch.episodes.files import LocalFile
from dextouch.episodes.format import ArrayEntry
from dextouch.episodes.shards import ShardReader, compress, decode_rows, with_crc
from dextouch.errors import CorruptDataError, StorageError

ROWS_EACH = 30
VALUES = np.random.default_rng(5).integers(0, 65536, (95, 4), dtype=np.uint16)
ENTRY = ArrayEntry(
    dtype="uint16",
    shape=VALUES.shape,
    chunk_rows=ROWS_EACH,
    dimension_names=("time", "cell"),
    sha256="0" * 64,
)


class CountedFile(LocalFile):
    """A file that remembers what was read of it."""

    def __init__(self, path):
        super().__init__(path)
        self.reads = []

    def read(self, offset, length):
        self.reads.append((offset, length))
        return super().read(offset, length)


def shard_bytes(values):
    padded = np.zeros((-(-len(values) // ROWS_EACH) * ROWS_EACH, *values.shape[1:]), values.dtype)
    padded[: len(values)] = values
    chunks = [
        with_crc(compress(padded[start : start + ROWS_EACH].tobytes()))
        for start in range(0, len(padded), ROWS_EACH)
    ]
    lengths = [len(chunk) for chunk in chunks]
    offsets = np.cumsum([0, *lengths[:-1]])
    return b"".join(chunks) + with_crc(np.stack([offsets, lengths], axis=1).astype("<u8").tobytes())


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "shard"
    path.write_bytes(shard_bytes(VALUES))
    return path


@pytest.fixture
def source(path):
    return CountedFile(path)


@pytest.fixture
def reader(source):
    return ShardReader(source, ENTRY, what="array 'touch'")


def replace(path: Path, data: bytes) -> None:
    """A new file under the old name, with stamps of its own."""
    fresh = path.with_name("fresh")
    fresh.write_bytes(data)
    os.utime(fresh, ns=(1, 1))
    fresh.replace(path)


@pytest.mark.parametrize("span_bytes", [1, 500, 1 << 21])
def test_every_span_of_rows_equals_the_array(reader, monkeypatch, span_bytes):
    monkeypatch.setattr(shards, "_SPAN_BYTES", span_bytes)
    for start in range(len(VALUES) + 1):
        for stop in range(start, len(VALUES) + 1, 7):
            rows = reader.read(start, stop)
            assert rows.dtype == VALUES.dtype
            np.testing.assert_array_equal(rows, VALUES[start:stop])


def test_rows_are_the_callers_own(reader):
    rows = reader.read(25, 65)
    rows[...] = 0
    np.testing.assert_array_equal(reader.read(25, 65), VALUES[25:65])


def test_a_window_fetches_its_storage_chunks_at_once_and_no_others(reader, source):
    places = reader.check_index().tolist()
    source.reads.clear()
    reader.read(35, 69)
    assert source.reads == [(places[1][0], places[1][1] + places[2][1])]


def test_much_is_fetched_in_bounded_pieces(reader, source, monkeypatch):
    lengths = reader.check_index()[:, 1].tolist()
    monkeypatch.setattr(shards, "_SPAN_BYTES", lengths[0] + lengths[1])
    source.reads.clear()
    reader.read()
    assert [length for _, length in source.reads] == [sum(lengths[:2]), sum(lengths[2:])]


def test_storage_chunks_need_not_lie_in_order(path, reader, source):
    encoded, index = path.read_bytes(), reader.check_index()
    chunks = [encoded[offset : offset + length] for offset, length in index.tolist()]
    path.write_bytes(b"gap".join(reversed(chunks)))
    lengths = index[:, 1]
    offsets = (np.cumsum(lengths[::-1] + np.uint64(3)) - lengths[::-1] - np.uint64(3))[::-1]
    moved = ShardReader(
        source, ENTRY, what="array 'touch'", index=np.stack([offsets, lengths], axis=1)
    )
    np.testing.assert_array_equal(moved.read(20, 95), VALUES[20:95])


def test_an_index_without_all_storage_chunks_serves_nothing(reader, source):
    short = ShardReader(source, ENTRY, what="array 'touch'", index=reader.check_index()[:2])
    np.testing.assert_array_equal(short.read(0, 60), VALUES[:60])
    with pytest.raises(CorruptDataError, match=r"array 'touch'.*names 1 storage chunks"):
        short.read(40, 70)


def test_a_file_written_anew_is_another_file(path, reader):
    np.testing.assert_array_equal(reader.read(0, 40), VALUES[:40])
    before = path.stat()
    replace(path, shard_bytes(VALUES[::-1]))
    # Nothing but its number and its stamps tells it from the old one.
    assert path.stat().st_size == before.st_size
    np.testing.assert_array_equal(reader.read(0, 40), VALUES[::-1][:40])


def test_a_file_cut_after_its_index_was_read_is_refused_by_storage_chunk(path, reader):
    np.testing.assert_array_equal(reader.read(20, 80), VALUES[20:80])
    begin = int(reader.check_index()[1, 0])
    os.truncate(path, begin + 10)
    with pytest.raises(CorruptDataError, match="storage chunk 1 lies outside the file"):
        reader.read(20, 80)
    np.testing.assert_array_equal(reader.read(0, 30), VALUES[:30])
    path.unlink()
    with pytest.raises(CorruptDataError, match="storage chunk 0 lies outside the file"):
        reader.read(20, 80)
    with pytest.raises(CorruptDataError, match="storage chunk 2 lies outside the file"):
        reader.payload(2)


def test_a_flipped_bit_is_refused_in_every_byte_of_a_window(path, reader):
    whole = path.read_bytes()
    offset, length = reader.check_index()[1].tolist()
    for place in range(offset, offset + length, 5):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        replace(path, bytes(damaged))
        with pytest.raises(CorruptDataError, match="storage chunk 1: checksum"):
            reader.read(0, 60)
        path.unlink()
    path.write_bytes(whole)


def test_the_disk_is_named_when_it_fails(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(StorageError, match=r"read .*loop"):
        LocalFile(tmp_path / "loop").read(0, 1)


def test_one_storage_chunk_decodes_to_its_rows_and_padding():
    shorter = ENTRY.model_copy(update={"shape": (5, 4)})
    rows = decode_rows(compress(VALUES[:5].tobytes() + bytes(25 * 8)), shorter, what="touch")
    np.testing.assert_array_equal(rows[:5], VALUES[:5])
    assert rows.shape == (ROWS_EACH, 4)
    assert not rows[5:].any()
