"""How large storage chunks are, and what a stream must not be: memory stays bounded."""

import base64
import json

import numpy as np
import pytest
import zstandard
from pydantic import ValidationError

from dextouch.episodes import files, staging, stream_arrays
from dextouch.episodes.files import MAX_METADATA_BYTES
from dextouch.episodes.format import (
    CommitRecord,
    array_metadata,
    canonical_json,
    decode_commit,
    encode_commit,
    with_rows,
)
from dextouch.episodes.maintenance import inspect_group, repair_group
from dextouch.episodes.shards import with_crc
from dextouch.errors import CorruptDataError, StorageError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor
from tests.unit.episodes.hostile_group import (
    chunks_of,
    forge_record,
    memory_bound,
    record_of,
    shard_of,
    write_shard,
)

MEBIBYTE = 2**20


def stream(shape, dtype="float64", rate_hz=30.0, **changes):
    fields = {"name": "raw", "kind": "scalar", "shape": shape, "dtype": dtype, "unit": "counts"}
    return StreamDescriptor.model_validate(fields | {"nominal_rate_hz": rate_hz} | changes)


def take(*streams):
    return RecordingAttributes(
        recording_id="take-1",
        task="t",
        instruction="",
        domain="human",
        station="bench",
        streams=streams,
    )


# Rows from the sentences of docs/episode_format.md, by hand.
@pytest.mark.parametrize(
    ("descriptor", "rows", "stamp_rows"),
    [
        # Half a second.
        (stream((360,), "uint16", 60), 30, 30),
        (stream((7,), "float64", 100), 50, 50),
        (stream((64, 64, 3), "uint8"), 15, 15),
        (stream((), "float32", 10_000), 5000, 5000),
        (stream((3,), "float32", 0.1), 1, 1),
        # 1 048 576 bytes: one image of 921 600, four of 230 400, two rows of 400 000.
        (stream((480, 640, 3), "uint8"), 1, 15),
        (stream((240, 320, 3), "uint8"), 4, 12),
        (stream((50_000,), "float64", 10_000), 2, 5000),
        # One row is larger than that.
        (stream((1080, 1920, 3), "uint8"), 1, 15),
    ],
)
@pytest.mark.parametrize("kind", ["episode", "recording"])
def test_rows_of_a_storage_chunk(descriptor, rows, stamp_rows, kind):
    values, *stamps = stream_arrays(descriptor, kind).values()
    assert values.chunk_rows == rows
    assert {stamp.chunk_rows for stamp in stamps} == {stamp_rows}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"shape": (2**40,)}, "8796093022208 bytes"),
        ({"shape": (2**13, 2**13, 2**13)}, "bytes"),
        ({"shape": (2**62, 2**62)}, "bytes"),
        ({"shape": (0,)}, "greater than or equal to 1"),
        ({"shape": (-3, -4)}, "greater than or equal to 1"),
        ({"shape": (1,) * 8}, "at most 7"),
        ({"nominal_rate_hz": 1e-300}, "greater than or equal to 0.000001"),
    ],
)
def test_absurd_streams_are_refused_by_name(changed, says):
    good = {"shape": (3,), "dtype": "float64"}
    with pytest.raises(ValidationError, match=says):
        stream(**(good | {k.replace("nominal_", ""): v for k, v in changed.items()}))


def test_the_largest_image_of_h264_is_a_stream():
    """Level 6.2 of H.264: 139,264 macroblocks of 16 x 16 pixels."""
    assert stream((4352, 8192, 3), "uint8", unit="h264").shape == (4352, 8192, 3)


def raw_images(first, count):
    numbers = np.arange(first, first + count)
    values = np.broadcast_to(numbers[:, None, None, None], (count, 240, 320, 3)).astype("u1")
    return {"values": values, "t_host_ns": numbers}


def test_storage_chunks_of_values_and_stamps_differ(store):
    """Four images a storage chunk, twelve stamps."""
    images = stream((240, 320, 3), "uint8", kind="image", unit="rgb8")
    with store.writer(kind="recording", attributes=take(images)) as writer:
        for number in range(31):
            writer.append("raw", **raw_images(number, 1))
    reader = store.recording("take-1")
    reader.verify()
    batch = reader.read("raw")
    assert batch.t_host_ns.tolist() == list(range(31))
    np.testing.assert_array_equal(batch.values[:, 5, 7, 1], batch.t_host_ns)
    np.testing.assert_array_equal(reader.images("raw", 9, 10), raw_images(9, 1)["values"])


def test_an_episode_with_half_a_second_of_large_images_still_opens(store, monkeypatch):
    """As releases before wrote them: 15 images a storage chunk."""
    monkeypatch.setattr("dextouch.episodes.format.CHUNK_BYTES", 2**40)
    images = stream((240, 320, 3), "uint8", kind="image", unit="rgb8")
    with store.writer(kind="recording", attributes=take(images)) as writer:
        writer.append("raw", **raw_images(0, 31))
    monkeypatch.undo()
    folder = store.root / "recordings" / "take-1"
    record, _ = decode_commit((folder / "commit.json").read_bytes(), what="take-1")
    assert record.arrays["raw"].chunk_rows == 15
    reader = store.recording("take-1")
    reader.verify()
    np.testing.assert_array_equal(reader.images("raw"), raw_images(0, 31)["values"])


def repeated_zeros(num_bytes):
    """A zstd frame of that many zeros: blocks of 128 KiB in four bytes each (RFC 8878)."""
    header = bytes.fromhex("28b52ffd") + b"\xa0" + num_bytes.to_bytes(4, "little")
    blocks, left = [], num_bytes
    while left:
        size = min(left, 1 << 17)
        left -= size
        blocks.append((size << 3 | 1 << 1 | (not left)).to_bytes(3, "little") + b"\x00")
    return header + b"".join(blocks)


def test_a_stored_chunk_of_gigabytes_is_refused_before_it_is_unpacked(store):
    """61 kB on the disk, each checksum right, 2 GB in memory."""
    heavy = stream((50_000,), "float64", 10_000)
    with store.writer(kind="recording", attributes=take(heavy)) as writer:
        writer.append("raw", values=np.zeros((1, 50_000)), t_host_ns=np.array([7]))
    folder = store.root / "recordings" / "take-1"
    chunk = with_crc(repeated_zeros(5000 * 400_000))
    forged = {"chunk_rows": 5000, "crc32c": base64.b64encode(chunk[-4:]).decode()}
    forge_record(folder, lambda record: record["arrays"]["raw"].update(forged))
    record, _ = decode_commit((folder / "commit.json").read_bytes(), what="take-1")
    (folder / "raw" / "zarr.json").write_bytes(array_metadata(record.arrays["raw"]))
    write_shard(shard_of(folder, "raw"), [chunk])
    reader = store.recording("take-1")
    for read in (lambda: reader.read("raw"), reader.verify):
        with memory_bound(), pytest.raises(CorruptDataError, match=r"'raw'.*2000000000 bytes"):
            read()
    assert canonical_json(json.loads((folder / "commit.json").read_bytes()))


def test_rows_behind_the_last_one_are_zero(store):
    """A last storage chunk is filled up with zeros, not with what the one before held."""
    force = stream((2,), "float32", 10)
    with store.writer(kind="recording", attributes=take(force)) as writer:
        numbers = np.arange(1, 13)
        values = np.repeat(numbers[:, None], 2, axis=1).astype("f4")
        writer.append("raw", values=values, t_host_ns=numbers)
    chunks, _ = chunks_of(shard_of(store.root / "recordings" / "take-1", "raw"), 3)
    # Five rows of two numbers, and a checksum of four bytes.
    last = np.frombuffer(zstandard.decompress(chunks[-1][:-4]), "<f4").reshape(5, 2)
    assert last[:, 0].tolist() == [11, 12, 0, 0, 0]


def camera(name):
    return stream((480, 640, 3), "uint8", 60, name=name, kind="image", unit="h264")


def with_checksums(descriptor, hours):
    """Entries of a stream as a writer makes them."""
    for name, entry in stream_arrays(descriptor, "recording").items():
        count = round(hours * 3600 * descriptor.nominal_rate_hz)
        if entry.codec == "zstd":
            crcs = bytes(4 * -(-count // entry.chunk_rows))
            entry = entry.model_copy(update={"crc32c": base64.b64encode(crcs).decode()})  # noqa: PLW2901
        yield name, with_rows(entry, count)


def test_the_record_of_half_a_day_of_three_cameras_can_be_read():
    streams = [camera(f"camera_{n}") for n in range(3)] + [stream((360,), "uint16", 60)]
    arrays = {name: one for each in streams for name, one in with_checksums(each, 12)}
    whole = CommitRecord(kind="recording", id="x", attributes_sha256="0", arrays=arrays)
    assert len(encode_commit(whole)[0]) > MAX_METADATA_BYTES
    data = staging.encoded_record(whole)
    assert len(data) <= MAX_METADATA_BYTES
    kept = decode_commit(data, what="x")[0].arrays
    assert {name: one.shape for name, one in kept.items()} == {
        n: a.shape for n, a in arrays.items()
    }
    # No more than is needed: a camera has four arrays of 1.7 MB, one of which is enough.
    assert sum(kept[name].crc32c != arrays[name].crc32c for name in arrays) <= 4


def test_a_record_without_checksums_is_read_and_verified(store, monkeypatch):
    """A storage chunk a sample makes a long take of a short one."""
    monkeypatch.setattr(staging, "MAX_METADATA_BYTES", 50_000)
    stamps_ns = np.arange(3000) * 10**9
    with store.writer(kind="recording", attributes=take(stream((), rate_hz=1))) as one:
        one.append("raw", values=stamps_ns / 1e9, t_host_ns=stamps_ns)
    folder = store.root / "recordings" / "take-1"
    assert (folder / "commit.json").stat().st_size <= 50_000
    assert None in {array["crc32c"] for array in record_of(folder)["arrays"].values()}
    values = store.recording("take-1").read("raw").values
    np.testing.assert_array_equal(values, stamps_ns / 1e9)
    assert not inspect_group(store.files("take-1", kind="recording"), "recording").findings


def test_what_could_not_be_read_again_is_not_committed(store, made, monkeypatch):
    monkeypatch.setattr(staging, "MAX_METADATA_BYTES", 1000)
    with pytest.raises(StorageError, match="expected at most 1000 each"):
        made.write(store)
    assert store.list() == []
    assert store.sweep() == 0


@pytest.mark.parametrize("limit", ["MAX_COMMIT_BYTES", "MAX_METADATA_BYTES"])
def test_what_is_too_large_is_no_damage_to_salvage(store, made, monkeypatch, limit):
    made.write(store)
    (name,) = store.list()
    monkeypatch.setattr(files, limit, 1000)
    report = repair_group(store.root, "episode", name)
    assert (report.action, report.new_id) == ("left", None)
    assert "expected at most 1000" in report.notes[0]
    assert store.list() == [name]
