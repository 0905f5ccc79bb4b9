"""Writing whole, reading slices, and refusing all that is damaged or does not fit."""

import json

import numpy as np
import pytest
import zarr

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import canonical_json, sha256_hex
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NonFiniteError,
    NotFoundError,
    ShapeError,
    StorageError,
    StorageFullError,
    UnknownNameError,
)
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor


def scalar_stream(name="force", **changes):
    fields = {
        "name": name,
        "kind": "scalar",
        "shape": (2,),
        "dtype": "float32",
        "unit": "N",
        "nominal_rate_hz": 10,
    }
    return StreamDescriptor.model_validate(fields | changes)


def test_everything_comes_back_bit_exact(made, store):
    reader = made.write(store)
    assert reader.attributes.model_copy(update={"streams": ()}) == made.attributes
    assert [reader.streams[d.name] for d in made.descriptors] == made.descriptors
    for name, values in made.values.items():
        data = reader.read(name)
        np.testing.assert_array_equal(data.values, values)
        assert data.values.dtype == values.dtype
        np.testing.assert_array_equal(data.t_ref_ns, made.stamps_ns[name])
    assert reader.verify().num_arrays == 2 * len(made.values)
    assert store.list() == ["stand-bottle-0003"]
    assert store.list(kind="recording") == []


def test_slices_by_time_equal_slices_of_the_whole(made, store):
    reader = made.write(store)
    stamps = made.stamps_ns["tactile_left"]
    for low, high in [(0, 5), (28, 33), (31, 31), (60, len(stamps))]:
        stop = None if high == len(stamps) else int(stamps[high])
        data = reader.read("tactile_left", int(stamps[low]), stop)
        np.testing.assert_array_equal(data.values, made.values["tactile_left"][low:high])
    assert len(reader.read("tactile_left", 10**12)) == 0


def test_zarr_python_reads_empty_streams(make_episode, store):
    made = make_episode(camera_unit="h264")
    camera = scalar_stream("dead_camera", kind="image", shape=(4, 4, 3), dtype="uint8", unit="jpeg")
    made.descriptors += [scalar_stream("dead"), camera]
    made.values |= {"dead": np.zeros((0, 2), "f4"), "dead_camera": np.zeros((0, 4, 4, 3), "u1")}
    made.stamps_ns |= dict.fromkeys(("dead", "dead_camera"), np.zeros(0, np.int64))
    reader = made.write(store)
    reader.verify()
    assert reader.images("dead_camera").shape == (0, 4, 4, 3)
    assert reader.encoded_images("dead_camera", 0, 0) == []
    group = zarr.open_group(store.root / "episodes" / "stand-bottle-0003", mode="r")
    assert group["dead"][:].shape == (0, 2)
    assert group["dead_camera"][:].shape == (0,)
    assert group["dead_camera_index"][:].shape == (0, 3)


def test_same_content_gives_same_bytes(made, store, tmp_path):
    first = made.write(store)
    second = made.write(EpisodeStore(tmp_path / "other"))
    assert first.content_sha256 == second.content_sha256


def test_block_sizes_do_not_matter(made, store):
    made.write(store)
    attributes = made.attributes.model_copy(
        update={"episode_id": "other", "streams": tuple(made.descriptors)}
    )
    with store.writer(attributes=attributes) as writer:
        for name, values in made.values.items():
            for start in range(0, len(values), 7):
                part = slice(start, start + 7)
                writer.append(name, values=values[part], t_ref_ns=made.stamps_ns[name][part])
    one, other = store.open("stand-bottle-0003"), store.open("other")
    for name in made.values:
        assert one._contents.entries[name].sha256 == other._contents.entries[name].sha256


def test_an_exception_leaves_nothing(made, store):
    with pytest.raises(RuntimeError, match="robot fell"), store.writer(attributes=made.attributes):
        raise RuntimeError("robot fell")
    assert store.list() == []
    assert list((store.root / ".staging").iterdir()) == []
    with pytest.raises(NotFoundError, match="stand-bottle-0003"):
        store.open("stand-bottle-0003")


def test_nothing_is_seen_before_commit(made, store):
    with store.writer(attributes=made.attributes) as writer:
        writer.add_stream(scalar_stream())
        assert store.list() == []
        # The stage of a living writer is not swept away.
        assert store.sweep() == 0
    assert store.list() == ["stand-bottle-0003"]


def test_of_two_writers_of_one_id_the_first_to_commit_wins(made, store):
    late = store.writer(attributes=made.attributes)
    late.add_stream(scalar_stream())
    made.write(store)
    with pytest.raises(ConflictError, match="exists already"):
        late.__exit__(None, None, None)
    with pytest.raises(ConflictError, match="exists already"):
        store.writer(attributes=made.attributes)
    np.testing.assert_array_equal(
        store.open("stand-bottle-0003").read("action").values, made.values["action"]
    )


def write_blocks(store, attributes, streams, blocks):
    with store.writer(attributes=attributes) as writer:
        for descriptor in streams:
            writer.add_stream(descriptor)
        for block in blocks:
            writer.append("force", **block)


def test_delete_and_sweep(made, store):
    made.write(store)
    store.delete("stand-bottle-0003")
    assert store.list() == []
    with pytest.raises(NotFoundError):
        store.delete("stand-bottle-0003")
    (store.root / ".staging" / "episode-left-over").mkdir()
    assert store.sweep() == 1


@pytest.mark.parametrize("bad", ["../x", "a/b", "", "A", ".hidden", "a" * 200, "x\n"])
def test_ids_are_no_paths(store, bad):
    with pytest.raises(InvalidInputError, match="expected 1"):
        store.open(bad)


@pytest.mark.parametrize("url", ["gs://bucket", "file://elsewhere/x", "http://host/x", ""])
def test_only_local_folders(url):
    with pytest.raises(InvalidInputError, match="local folder"):
        EpisodeStore(url)


def test_file_urls(tmp_path):
    assert EpisodeStore(f"file://{tmp_path}/a%20b").root == tmp_path / "a b"


@pytest.mark.parametrize(
    ("block", "error", "words"),
    [
        ({"values": np.zeros((2, 3), "f4")}, ShapeError, "expected float32"),
        ({"values": np.zeros((2, 2), "f8")}, ShapeError, "expected float32"),
        ({"values": np.full((2, 2), np.nan, "f4")}, NonFiniteError, "4 values"),
        ({"t_ref_ns": np.array([5, 5])}, InvalidInputError, "at least 1 ns"),
        # Their difference as an int64 is 1.
        ({"t_ref_ns": np.array([2**63 - 1, -(2**63)])}, InvalidInputError, "at least 1 ns"),
        ({"t_ref_ns": np.array([5])}, ShapeError, "like the values"),
        ({"t_ref_ns": np.array([5.0, 6.0])}, ShapeError, "int64"),
        ({"t_host_ns": np.array([5, 6])}, InvalidInputError, "got stamps"),
        ({"t_ref_ns": None}, InvalidInputError, "got stamps"),
    ],
)
def test_blocks_that_do_not_fit(made, store, block, error, words):
    block = {"values": np.zeros((2, 2), "f4"), "t_ref_ns": np.array([5, 6])} | block
    with pytest.raises(error, match=words):
        write_blocks(store, made.attributes, [scalar_stream()], [block])
    assert store.list() == []


def test_stamps_must_rise_across_blocks_too(made, store):
    blocks = [{"values": np.zeros((1, 2), "f4"), "t_ref_ns": np.array([stamp])} for stamp in (5, 4)]
    with pytest.raises(InvalidInputError, match="-1 ns"):
        write_blocks(store, made.attributes, [scalar_stream()], blocks)


def test_unknown_streams_and_colliding_names(made, store):
    block = {"values": np.zeros((1, 2), "f4"), "t_ref_ns": np.array([5])}
    with pytest.raises(UnknownNameError):
        write_blocks(store, made.attributes, [scalar_stream("torque")], [block])
    with pytest.raises(ConflictError):
        write_blocks(store, made.attributes, [scalar_stream(), scalar_stream("force_t_ref_ns")], [])
    with pytest.raises(InvalidInputError, match="no stream"):
        write_blocks(store, made.attributes, [], [])


def damage_cases(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.long
def test_every_flipped_byte_is_found(made, store):
    """One bit of every file, at its start, middle and end: verify names it, nothing is silent."""
    made.write(store)
    folder = store.root / "episodes" / "stand-bottle-0003"
    for path in damage_cases(folder):
        whole = path.read_bytes()
        for place in {0, len(whole) // 2, len(whole) - 1}:
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
            with pytest.raises((CorruptDataError, StorageError)):
                store.open("stand-bottle-0003").verify()
        path.write_bytes(whole)
    store.open("stand-bottle-0003").verify()


def test_truncated_and_missing_files_are_found_by_name(made, store):
    made.write(store)
    shard = store.root / "episodes" / "stand-bottle-0003" / "tactile_left" / "c" / "0" / "0"
    whole = shard.read_bytes()
    for cut in (whole[:-1], whole[: len(whole) // 2], b""):
        shard.write_bytes(cut)
        with pytest.raises(CorruptDataError, match="tactile_left"):
            store.open("stand-bottle-0003").read("tactile_left")
    shard.unlink()
    with pytest.raises(CorruptDataError, match="tactile_left"):
        store.open("stand-bottle-0003").window(0)


def test_a_newer_format_is_refused_as_such(made, store):
    made.write(store)
    path = store.root / "episodes" / "stand-bottle-0003" / "commit.json"
    outer = json.loads(path.read_bytes())
    outer["record"]["format_version"] = 4
    outer["sha256"] = sha256_hex(canonical_json(outer["record"]))
    path.write_bytes(canonical_json(outer))
    with pytest.raises(StorageError, match="version 4, expected 2 or 3"):
        store.open("stand-bottle-0003")


def recording_attributes(**changes):
    fields = {
        "recording_id": "take-1",
        "task": "stand_bottle",
        "instruction": "",
        "domain": "human",
        "station": "bench",
    }
    return RecordingAttributes.model_validate(fields | changes)


def test_recordings_keep_three_stamps(store):
    attributes = recording_attributes(streams=(scalar_stream(),))
    values = np.array([[1, np.nan], [3, 4], [5, 6]], "f4")
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append(
            "force",
            values=values,
            t_host_ns=np.array([10, 10, 12]),
            t_device_ns=np.array([3, 1, 2]),
            sequence=np.array([7, 8, 9]),
        )
        writer.set_attributes(attributes.model_copy(update={"success": True}))
    reader = store.recording("take-1")
    batch = reader.read("force", 10, 12)
    np.testing.assert_array_equal(batch.values, values[:2])
    assert batch.t_device_ns.tolist() == [3, 1]
    assert batch.sequence.tolist() == [7, 8]
    assert reader.attributes.success is True
    with pytest.raises(NotFoundError):
        store.open("take-1")


def test_an_empty_stream_stays_empty(store):
    attributes = recording_attributes(streams=(scalar_stream(), scalar_stream("dead")))
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append("force", values=np.ones((1, 2), "f4"), t_host_ns=np.array([1]))
    reader = store.recording("take-1")
    assert reader.num_samples("dead") == 0
    assert reader.read("dead").values.shape == (0, 2)
    assert reader.read("force").sequence.tolist() == [-1]
    reader.verify()


def test_a_full_disk_is_said_and_nothing_appears(made, store, file_size_limit):
    with file_size_limit(4096), pytest.raises(StorageFullError, match="no space left"):
        made.write(store)
    assert store.list() == []


def test_a_refused_block_leaves_no_trace(made, store):
    with store.writer(attributes=made.attributes) as writer:
        writer.add_stream(scalar_stream())
        writer.append("force", values=np.ones((2, 2), "f4"), t_ref_ns=np.array([1, 2]))
        with pytest.raises(NonFiniteError):
            writer.append("force", values=np.full((1, 2), np.nan, "f4"), t_ref_ns=np.array([9]))
        with pytest.raises(InvalidInputError):
            writer.append("force", values=np.ones((1, 2), "f4"), t_ref_ns=np.array([2]))
        writer.append("force", values=np.ones((1, 2), "f4"), t_ref_ns=np.array([3]))
    data = store.open("stand-bottle-0003").read("force")
    assert data.t_ref_ns.tolist() == [1, 2, 3]
    assert (data.values == 1).all()


def streams(count):
    return tuple(
        StreamDescriptor(
            name=f"s{n}", kind="scalar", shape=(), dtype="float32", unit="N", nominal_rate_hz=10
        )
        for n in range(count)
    )


def write_streams(store, made, count, announced=0):
    attributes = made.attributes.model_copy(update={"streams": streams(count)[:announced]})
    with store.writer(attributes=attributes) as writer:
        for descriptor in streams(count)[announced:]:
            writer.add_stream(descriptor)
        stamps = np.arange(3)
        for descriptor in streams(count):
            writer.append(descriptor.name, values=np.zeros(3, "f4"), t_ref_ns=stamps)


@pytest.mark.long
@pytest.mark.parametrize("announced", [0, 101])
def test_a_stream_too_many_is_refused_by_name(store, made, announced):
    """docs/episode_format.md: at most 100 streams."""
    with pytest.raises(InvalidInputError, match=r"'s100'.*at most 100 streams"):
        write_streams(store, made, 101, announced)
    assert store.list() == []
    assert list((store.root / ".staging").iterdir()) == []
    write_streams(store, made, 100, min(announced, 100))
    assert len(store.open(made.attributes.episode_id).attributes.streams) == 100


def test_a_take_of_an_older_release_with_more_streams_is_read(store, made, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.writer.MAX_STREAMS", 1000)
        write_streams(store, made, 101)
    assert store.open(made.attributes.episode_id).verify().num_arrays == 2 * 101
