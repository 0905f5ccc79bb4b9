"""Journals of a stage, written byte by byte as docs/episode_format.md describes them."""

import errno
import os
import struct
from pathlib import Path

import google_crc32c
import pytest

from dextouch.episodes.journal import JournalWriter, read_payload, read_rows
from dextouch.errors import CorruptDataError, StorageFullError

PAYLOADS = [b"a" * 10, b"bc" * 6, b"defg" * 5]
OFFSETS = [0, 10, 22]


def row(offset, payload, num_rows=5):
    """Offset u64, rows, payload length, payload crc32c, crc32c of the row: u32 each."""
    body = struct.pack("<QIII", offset, num_rows, len(payload), google_crc32c.value(payload))
    return body + struct.pack("<I", google_crc32c.value(body))


def write_log(folder, rows, part):
    (folder / "force.journal").write_bytes(b"DXTJRNL\x02" + b"".join(rows))
    (folder / "force.part").write_bytes(part)


@pytest.fixture
def rows():
    return [row(*each) for each in zip(OFFSETS, PAYLOADS, strict=True)]


def test_whole_rows_are_read(tmp_path, rows):
    write_log(tmp_path, rows, b"".join(PAYLOADS))
    found = read_rows(tmp_path, "force")
    assert found["offset"].tolist() == OFFSETS
    assert [read_payload(tmp_path, "force", row) for row in found] == PAYLOADS


@pytest.mark.parametrize(
    ("num_bytes", "num_rows"),
    [(42, 3), (41, 2), (22, 2), (21, 1), (10, 1), (9, 0), (0, 0)],
)
def test_a_row_whose_payload_is_not_wholly_there_does_not_count(
    tmp_path, rows, num_bytes, num_rows
):
    """After a power loss the rows may be on the disk and their payloads not."""
    write_log(tmp_path, rows, b"".join(PAYLOADS)[:num_bytes])
    assert read_rows(tmp_path, "force")["offset"].tolist() == OFFSETS[:num_rows]


@pytest.mark.parametrize("offset", [0, 9, 11, 22, 2**63])
def test_a_last_row_that_does_not_follow_does_not_count(tmp_path, rows, offset):
    write_log(tmp_path, [rows[0], row(offset, PAYLOADS[1])], b"".join(PAYLOADS))
    assert read_rows(tmp_path, "force")["offset"].tolist() == [0]


def test_rows_around_a_hole_are_refused(tmp_path, rows):
    """Payloads lie end to end: what no row vouches for must not end up between them."""
    second, third = row(12, PAYLOADS[1]), row(24, PAYLOADS[2])
    part = PAYLOADS[0] + b"??" + PAYLOADS[1] + PAYLOADS[2]
    write_log(tmp_path, [rows[0], second, third], part)
    with pytest.raises(CorruptDataError, match="row 1 of 3 is invalid"):
        read_rows(tmp_path, "force")


def test_a_first_row_begins_at_the_first_byte(tmp_path, rows):
    write_log(tmp_path, [row(2, PAYLOADS[0])], b"??" + PAYLOADS[0])
    assert len(read_rows(tmp_path, "force")) == 0


def test_short_writes_go_on_where_they_ended(tmp_path, monkeypatch):
    whole = os.write
    monkeypatch.setattr(os, "write", lambda file, data: whole(file, bytes(data)[:7]))
    writer = JournalWriter(tmp_path, "force")
    for payload in PAYLOADS:
        writer.append(payload, 5)
    writer.close()
    assert (tmp_path / "force.part").read_bytes() == b"".join(PAYLOADS)
    assert read_rows(tmp_path, "force")["offset"].tolist() == OFFSETS


@pytest.mark.parametrize("write", [1, 2])
def test_what_follows_a_failed_append_lies_where_its_row_says(tmp_path, monkeypatch, write):
    """The first write is that of the payload, the second that of its row."""
    calls = []

    def full(file, data):
        calls.append(file)
        whole(file, bytes(data)[:3])
        if len(calls) == write:
            raise OSError(errno.ENOSPC, "no space")
        return whole(file, bytes(data)[3:]) + 3

    whole = os.write
    writer = JournalWriter(tmp_path, "force")
    writer.append(PAYLOADS[0], 5)
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(StorageFullError):
            writer.append(b"lost", 5)
    writer.append(PAYLOADS[1], 5)
    writer.close()
    found = read_rows(tmp_path, "force")
    assert [read_payload(tmp_path, "force", row) for row in found] == PAYLOADS[:2]


def test_payloads_are_synced_before_the_rows_that_vouch_for_them(tmp_path, monkeypatch):
    synced = []
    writer = JournalWriter(tmp_path, "force")
    writer.append(PAYLOADS[0], 5)
    monkeypatch.setattr(
        os, "fdatasync", lambda file: synced.append(Path(f"/proc/self/fd/{file}").readlink().name)
    )
    writer.sync()
    writer.close()
    assert synced == ["force.part", "force.journal"]
