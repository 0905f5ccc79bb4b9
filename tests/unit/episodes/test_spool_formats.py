"""The format of the spool: logs written by hand, a golden one, and those of other versions."""

import hashlib
import json
import re
import shutil
import struct

import google_crc32c
import pytest

from dextouch.episodes import spool
from dextouch.episodes.spool_log import LOG_FILE
from dextouch.errors import CorruptDataError, StorageError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import encode_body
from tests.unit.episodes.spooled_batches import (
    ATTRIBUTES,
    GOLDEN,
    assert_same,
    glove_batch,
    golden_batch,
    recover,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "spool" / "take-1"


def body_of(batch):
    """The body of a record: its samples end to end."""
    return b"".join(
        struct.pack("<qqq360H", host, device, number, *values)
        for host, device, number, values in zip(*vars(batch).values(), strict=True)
    )


def record(place, batch, *, first_sample, stream=0):
    """A record of a log as docs/episode_format.md describes it, of a stream of numbers."""
    body = body_of(batch)
    counts = (stream, len(batch), len(body), google_crc32c.value(body))
    header = struct.pack("<4sQQIIII", b"DXTS", place, first_sample, *counts)
    return header + struct.pack("<I", google_crc32c.value(header)) + body


@pytest.mark.parametrize("first_sample", [0, 1, 2, 3, 2**63])
def test_a_log_written_by_hand_is_read_if_its_samples_follow_each_other(path, first_sample):
    spool.SpoolWriter(path, ATTRIBUTES).abandon()
    data = b"DXTBLOG\x02"
    data += record(len(data), glove_batch(0, 2), first_sample=0)
    data += record(len(data), glove_batch(2, 3), first_sample=first_sample)
    (path / LOG_FILE).write_bytes(data)
    if first_sample == 2:
        assert_same(spool.SpoolReader(path).read("glove_left"), glove_batch(0, 5))
        return
    for read in (lambda: spool.SpoolReader(path).read("glove_left"), lambda: recover(path)):
        with pytest.raises(CorruptDataError, match="stream number 0 do not follow each other"):
            read()


def test_the_golden_spool_is_read_and_goes_on(tmp_path):
    """A station or an upload may be older than this release."""
    shutil.copytree(GOLDEN / "spool_v2", path := tmp_path / "take-1")
    reader = spool.SpoolReader(path)
    for name, stream in reader.streams.items():
        assert_same(reader.read(name), golden_batch(stream, 0, 6))
        assert_same(reader.read(name, 2, 5), golden_batch(stream, 2, 3))
        body = encode_body(stream, golden_batch(stream, 1, 3))
        assert (reader.appended(name, 1), reader.body(name, 1, 4)) == (body, body)
        # Within records of several samples, as an upload of fixed batches cuts them.
        assert reader.body(name, 2, 5) == encode_body(stream, golden_batch(stream, 2, 3))
    with spool.SpoolWriter.resume(path) as writer:
        for stream in reader.streams.values():
            writer.append(stream.name, golden_batch(stream, 6, 2))
    for name, stream in reader.streams.items():
        assert_same(spool.SpoolReader(path).read(name), golden_batch(stream, 0, 8))


def test_the_bytes_of_a_log_never_change(tmp_path):
    golden = GOLDEN / "spool_v2"
    attributes = spool.read_attributes(golden)
    with spool.SpoolWriter(tmp_path / "take-1", attributes) as writer:
        for stream in attributes.streams:
            for first, count in ((0, 1), (1, 3), (4, 2)):
                writer.append(stream.name, golden_batch(stream, first, count))
    assert (tmp_path / "take-1" / LOG_FILE).read_bytes() == (golden / LOG_FILE).read_bytes()


def test_checksums_and_the_seal_are_as_documented(path):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        writer.append("glove_left", glove_batch(0, 7))
        whole = (path / "recording.json").read_bytes()
    start = whole.index(b',"sha256"')
    plain = whole[:start] + b"}"
    assert json.loads(whole) == json.loads(plain) | {"sha256": hashlib.sha256(plain).hexdigest()}
    assert RecordingAttributes.model_validate_json(plain) == ATTRIBUTES
    # The log's first bytes, a header of 40, and seven samples of three stamps and 360 values.
    body = (path / "batches.log").read_bytes()[8 + 40 :]
    row = struct.pack("<QQIIIII", 8, 0, 0, 7, len(body), google_crc32c.value(body), 0)
    assert json.loads((path / "closed").read_text()) == {
        "format_version": 1,
        "num_samples": {"glove_left": 7, "camera_head": 0},
        "log_bytes": 8 + 40 + 7 * (3 * 8 + 360 * 2),
        "records_sha256": hashlib.sha256(row).hexdigest(),
        "recording_sha256": hashlib.sha256(whole).hexdigest(),
    }


@pytest.mark.parametrize("version", [1, 3])
def test_a_log_of_another_version_is_refused_and_kept(path, version):
    with spool.SpoolWriter(path, ATTRIBUTES) as writer:
        writer.append("glove_left", glove_batch(0, 5))
    file = path / LOG_FILE
    file.write_bytes(b"DXTBLOG" + bytes([version]) + file.read_bytes()[8:])
    before = {each.name: each.read_bytes() for each in path.iterdir()}
    told = (
        f"log of spool 'take-1': batches.log has format version {version}, expected 2; "
        "read it with the release that wrote it"
    )
    asks = (
        lambda: spool.SpoolReader(path).read("glove_left"),
        lambda: spool.SpoolWriter.resume(path),
    )
    for ask in asks:
        with pytest.raises(StorageError, match=f"^{re.escape(told)}$") as caught:
            ask()
        assert not isinstance(caught.value, CorruptDataError)
    assert {each.name: each.read_bytes() for each in path.iterdir()} == before


@pytest.mark.parametrize("stream", ["glove_left", "camera_head"])
def test_a_record_of_another_stream_is_refused(tmp_path, stream):
    shutil.copytree(GOLDEN / "spool_v2", path := tmp_path / "take-1")
    attributes = spool.read_attributes(path)
    other = {"glove_left": {"shape": (5,)}, "camera_head": {"unit": "rgb8"}}[stream]
    streams = tuple(
        s.model_copy(update=other) if s.name == stream else s for s in attributes.streams
    )
    changed = attributes.model_copy(update={"streams": streams})
    (path / "recording.json").write_text(changed.model_dump_json())
    with pytest.raises(CorruptDataError, match=r"spool 'take-1': .* written for another stream"):
        spool.SpoolReader(path).read(stream)
