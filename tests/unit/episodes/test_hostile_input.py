"""Groups that are damaged or forged: found, named, never served wrong, never unpacked blindly."""

import struct

import numpy as np
import pytest
from numcodecs.zstd import Zstd

from dextouch.episodes.shards import ShardReader, with_crc
from dextouch.errors import CorruptDataError, NotFoundError, StorageError
from tests.unit.episodes.hostile_group import (
    ID,
    STILLS,
    TOUCH,
    VIDEO,
    chunks_of,
    copy_of,
    forge_attributes,
    forge_chunks,
    forge_record,
    memory_bound,
    num_chunks,
    shard_of,
    write_shard,
    written_once,
)


@pytest.fixture
def whole_store(make_episode, tmp_path_factory):
    return written_once(make_episode, tmp_path_factory)


@pytest.fixture
def store(whole_store, tmp_path):
    return copy_of(whole_store, tmp_path)


@pytest.fixture
def folder(store):
    return store.root / "episodes" / ID


@pytest.fixture
def bounded_memory():
    with memory_bound():
        yield


def everything(store):
    """Every way to read a group, by name."""
    reader = store.open(ID)
    ways = {
        "window": lambda: list(reader.window(2, 9, cameras=(VIDEO, STILLS)).images.values()),
        "numbers": lambda: [reader.window(0, 17, cameras=()).tactile_kpa],
    }
    for name, stream in reader.streams.items():
        ways[f"read {name}"] = lambda n=name: [reader.read(n).values, reader.read(n).t_ref_ns]
        if stream.kind == "image":
            count = reader.num_samples(name)
            ways[f"images {name}"] = lambda n=name: [reader.images(n, 5, 21)]
            ways[f"encoded {name}"] = lambda n=name, c=count: reader.encoded_images(n, 0, c)
    return ways


def read_all(store):
    for read in everything(store).values():
        read()


def test_storage_that_refuses_is_no_damage(store, monkeypatch):
    """What repairs on `CorruptDataError` must not act on a permission problem."""

    def refuse(*_):
        raise StorageError("the bucket refused (403 AccessDenied)")

    reader = store.open(ID)
    monkeypatch.setattr(ShardReader, "payload", refuse)
    with pytest.raises(StorageError, match="403") as caught:
        reader.verify()
    assert type(caught.value) is StorageError


def test_all_of_it_is_whole(store):
    assert store.open(ID).verify().num_arrays == 14
    assert len(everything(store)) == 12


@pytest.mark.long
def test_random_damage_is_found_named_and_never_served(whole_store, store, folder):
    """20 files and bytes drawn with a seed: verify names the place, reading refuses or is right."""
    truth = {name: read() for name, read in everything(whole_store).items()}
    rng = np.random.default_rng(20)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    refused = 0
    for _ in range(20):
        path = files[rng.integers(len(files))]
        data = path.read_bytes()
        place, bits = int(rng.integers(len(data))), int(rng.integers(1, 256))
        path.write_bytes(data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :])
        part = path.relative_to(folder).parts
        named = part[0] if len(part) > 1 else f"attributes|{part[0]}"
        with pytest.raises(StorageError, match=named):
            store.open(ID).verify()
        try:
            ways = everything(store)
        except StorageError:
            refused += len(truth)
            ways = {}
        for name, read in ways.items():
            try:
                got = read()
            except StorageError:
                refused += 1
                continue
            for one, true in zip(got, truth[name], strict=True):
                assert np.array_equal(one, true), (path, place, name)
        path.write_bytes(data)
    assert refused > 20
    store.open(ID).verify()


def boundaries(folder, path):
    size = path.stat().st_size
    cuts = {0, 1, size // 2, size - 1}
    if path.suffix != ".json":
        _, index = chunks_of(path, num_chunks(folder, path.relative_to(folder).parts[0]))
        cuts |= {offset + more for offset, _ in index for more in (-1, 0, 1)}
        cuts |= {size - 4, size - 4 - 16 * len(index)}
    return sorted(cut for cut in cuts if 0 <= cut < size)


@pytest.mark.long
def test_files_cut_at_every_boundary_are_found(store, folder):
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        data, parts = path.read_bytes(), path.relative_to(folder).parts
        for cut in boundaries(folder, path):
            path.write_bytes(data[:cut])
            with pytest.raises(StorageError) as refusal:
                store.open(ID).verify()
            assert len(parts) == 1 or repr(parts[0]) in refusal.value.message
        path.write_bytes(data)


@pytest.mark.parametrize(
    "name", ["commit.json", "zarr.json", TOUCH, f"{TOUCH}/c", f"{TOUCH}/c/0/0"]
)
def test_links_inside_a_group_are_refused(store, folder, tmp_path, name):
    """Even to the true bytes: what lies outside may be anybody's, and may change."""
    outside = tmp_path / "outside"
    (folder / name).rename(outside)
    (folder / name).symlink_to(outside)
    with pytest.raises(CorruptDataError, match="symbolic link"):
        store.open(ID).read(TOUCH)


def test_a_group_that_is_a_link_is_refused(store, folder, tmp_path):
    folder.rename(tmp_path / ID)
    folder.symlink_to(tmp_path / ID)
    with pytest.raises(CorruptDataError, match="symbolic link"):
        store.open(ID)


def test_folders_that_are_no_groups_are_not_seen(store):
    (store.root / "episodes" / "foreign").mkdir()
    (store.root / "episodes" / "foreign" / "zarr.json").write_text("{}")
    (store.root / "episodes" / "file").write_text("")
    assert store.list() == [ID]
    with pytest.raises(NotFoundError):
        store.open("foreign")


def edit_array(name, **changes):
    return lambda record: record["arrays"][name].update(changes)


def rename_array(record):
    record["arrays"]["../../../elsewhere"] = record["arrays"].pop(TOUCH)


def add_array(record):
    record["arrays"]["../../../elsewhere"] = record["arrays"][TOUCH]


def rows_of_stream(name, rows):
    def edit(record):
        for array, entry in record["arrays"].items():
            is_row = array in {name, f"{name}_index", f"{name}_t_ref_ns"}
            if is_row and entry["codec"] != "bytes":
                entry["shape"][0] = rows

    return edit


def rows_and_chunks(name, rows):
    def edit(record):
        rows_of_stream(name.removesuffix("_index"), rows)(record)
        record["arrays"][name]["chunk_rows"] = rows

    return edit


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (edit_array(TOUCH, shape=[-5, 320]), "greater than or equal to 0"),
        (edit_array(TOUCH, shape=[10**30, 320]), "less than or equal"),
        (edit_array(TOUCH, chunk_rows=10**30), "less than or equal"),
        (edit_array(TOUCH, chunk_rows=0), "greater than or equal to 1"),
        (edit_array(TOUCH, shape=[]), "at least 1 item"),
        (edit_array(TOUCH, shape=[82, 2**39]), "not what the attributes say"),
        (edit_array(TOUCH, shape=[81, 321]), "not what the attributes say"),
        (edit_array(TOUCH, dtype="float64"), "not what the attributes say"),
        (edit_array(TOUCH, dtype="object"), "float64"),
        (edit_array(STILLS, codec="zstd"), "not what the attributes say"),
        (rows_of_stream(TOUCH, 2**39), "bytes of checksums, expected 4 for each of 18325193797"),
        (rows_of_stream(VIDEO, 2**39), "bytes of checksums, expected 4 for each of 68719476736"),
        (edit_array(VIDEO, shape=[2**39]), "inconsistent with its 549755813888 bytes"),
        (edit_array(TOUCH, crc32c="A?"), "checksums in the commit record"),
        (edit_array(TOUCH, shape=[80, 320]), "not what the attributes say"),
        (rename_array, "not in the commit record"),
        (add_array, "elsewhere"),
        (lambda record: record["arrays"].clear(), "not in the commit record"),
        (lambda record: record.update(arrays=[]), "not a commit record"),
        (lambda record: record.update(id="other"), "commit record says episode other"),
        (lambda record: record.update(id="../../x"), "commit record says"),
        (lambda record: record.update(kind="recording"), "commit record says"),
        (lambda record: record.update(extra=1), "not a commit record"),
        (lambda record: record.update(format_version=[2]), "format version"),
    ],
)
def test_forged_commit_records(store, folder, edit, words):
    forge_record(folder, edit)
    with pytest.raises(StorageError, match=words):
        read_all(store)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("name", [TOUCH, f"{VIDEO}_index", f"{STILLS}_index"])
def test_forged_rows_of_one_storage_chunk(store, folder, name):
    """With a true index of one storage chunk that is said to hold half a million million rows."""
    forge_record(folder, rows_and_chunks(name, 2**39))
    path = shard_of(folder, name)
    chunks, _ = chunks_of(path, 3)
    forge_chunks(folder, name, chunks[:1])
    reader, camera = store.open(ID), name.removesuffix("_index")
    ways = [lambda: reader.images(camera), lambda: reader.encoded_images(camera, 0, 2**39)]
    if name == TOUCH:
        ways = [lambda: reader._contents.shard(name).read()]
    for read in ways:
        with pytest.raises(CorruptDataError, match="need at least"):
            read()


@pytest.mark.long
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("name", [TOUCH, VIDEO, STILLS])
@pytest.mark.parametrize(
    "forged",
    [
        lambda index: [index[1], index[0], *index[2:]],
        lambda index: [index[0], index[0], *index[2:]],
        lambda index: [[0, index[0][1] - 1], *index[1:]],
        lambda index: [*index[:-1], [index[-1][0], 2**62]],
        lambda index: [[2**64 - 8, index[0][1] + 8], *index[1:]],
        lambda index: [[0, 2**64 - 1], [2**64 - 1, index[1][0] + index[1][1] + 1], *index[2:]],
        lambda index: [[1, index[0][1] - 1], *index[1:]],
        lambda index: [[2**64 - 1, 2**64 - 1]] * len(index),
        lambda index: [[0, 0], [0, index[1][0] + index[1][1]], *index[2:]],
    ],
)
def test_forged_offsets(store, folder, name, forged):
    """Overlaps, gaps, wrapped sums, and zarr's own mark of an empty storage chunk."""
    path = shard_of(folder, name)
    chunks, index = chunks_of(path, num_chunks(folder, name))
    write_shard(path, chunks, forged(index))
    words = "need at least" if forged(index)[0] == [0, 0] else "is inconsistent"
    with pytest.raises(CorruptDataError, match=f"{name}.*{words}"):
        store.open(ID).read(name)
    with pytest.raises(CorruptDataError, match=f"{name}.*{words}"):
        store.open(ID).verify()


def frame(announced, blocks=b"\x01\x00\x00"):
    """A zstd frame that says how much it unpacks to; its one block is empty."""
    return bytes.fromhex("28b52ffde0") + struct.pack("<Q", announced) + blocks


def repeated(size):
    """A zstd frame without a size, each block of which repeats one byte."""
    block = (131072 << 3 | 1 << 1).to_bytes(3, "little") + b"\x00"
    return bytes.fromhex("28b52ffd0058") + block * (size >> 17) + b"\x01\x00\x00"


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    "bomb",
    [
        lambda true: frame(2**46),
        lambda true: repeated(2**33),
        lambda true: true + frame(2**46),
        lambda true: true + repeated(2**33),
        lambda true: true + b"\x00",
        lambda true: true[:-1],
        lambda true: frame(30 * 320 * 4),
        lambda true: frame(30 * 320 * 4, b"\x07\x00\x00"),
        lambda true: Zstd(1).encode(bytes(7)),
        lambda true: b"",
    ],
)
def test_bombs_are_not_unpacked(store, folder, bomb):
    path = shard_of(folder, TOUCH)
    chunks, _ = chunks_of(path, num_chunks(folder, TOUCH))
    forge_chunks(folder, TOUCH, [with_crc(bomb(chunks[0][:-4])), *chunks[1:]])
    with pytest.raises(CorruptDataError, match=r"storage chunk 0: (?!is intact)|need at least"):
        store.open(ID).read(TOUCH)


DEEP = b'{"attributes":{"dextouch":' + b"[" * 200_000 + b"]" * 200_000 + b"}}"


@pytest.mark.parametrize("data", [DEEP, b"[]", b"null", b'{"record":[],"sha256":""}', b"\xff\xfe{"])
def test_metadata_that_is_no_record(store, folder, data):
    (folder / "commit.json").write_bytes(data)
    with pytest.raises(CorruptDataError, match=r"commit\.json"):
        store.open(ID)


@pytest.mark.parametrize(
    "data",
    [
        DEEP,
        b"[]",
        b"null",
        b'{"attributes":[]}',
        b'{"attributes":{"dextouch":null}}',
        b'{"attributes":{"dextouch":' + b'{"a":' * 500 + b"1" + b"}" * 502,
        b"\xff\xfe{",
    ],
)
def test_attributes_that_are_none(store, folder, data):
    forge_attributes(folder, data)
    with pytest.raises(StorageError, match="attributes"):
        store.open(ID)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"model_rate_hz":15.0', b'"model_rate_hz":NaN'),
        (b'"model_rate_hz":15.0', b'"model_rate_hz":Infinity'),
        (b'"model_rate_hz":15.0', b'"model_rate_hz":1e999'),
        (b'"K_head":[[60.0', b'"K_head":[[NaN'),
        (b'"nominal_rate_hz":60.0', b'"nominal_rate_hz":NaN'),
        (b'"name":"tactile_left"', b'"name":"../../elsewhere"'),
        (b'"name":"tactile_left"', b'"name":"tactile_left\\n"'),
        (b'"name":"tactile_left"', b'"name":"action"'),
        (b'"shape":[320]', b'"shape":[-320]'),
        (b'"shape":[320]', b'"shape":[1099511627776]'),
        (b'"episode_id":"stand-bottle-0003"', b'"episode_id":"../elsewhere"'),
    ],
)
def test_attributes_with_forged_numbers_and_names(store, folder, old, new):
    data = (folder / "zarr.json").read_bytes()
    assert old in data
    forge_attributes(folder, data.replace(old, new))
    with pytest.raises(StorageError, match=f"episode {ID}"):
        store.open(ID)


def test_metadata_of_gigabytes_is_not_read(store, folder):
    for name in ("commit.json", "zarr.json"):
        true = (folder / name).read_bytes()
        with (folder / name).open("r+b") as file:
            file.truncate(1 << 33)
        with pytest.raises(CorruptDataError, match=f"{name} holds 8589934592 bytes"):
            store.open(ID)
        (folder / name).write_bytes(true)
