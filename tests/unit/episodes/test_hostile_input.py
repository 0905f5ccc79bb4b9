"""Groups that are damaged or forged: found, named, never served wrong, never unpacked blindly."""

import json
import shutil
import struct
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numcodecs.zstd import Zstd

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import canonical_json, sha256_hex
from dextouch.episodes.shard_reader import with_crc, zstd_frame_bytes
from dextouch.errors import CorruptDataError, NotFoundError, StorageError
from dextouch.images.jpeg import encode_jpeg

ID = "stand-bottle-0003"
VIDEO, STILLS, TOUCH = "camera_head", "camera_wrist_left", "tactile_left"
# More than any test here needs, far less than what the forged numbers ask for.
MEMORY_BYTES = 64 << 20


_WRITTEN: list[EpisodeStore] = []


@pytest.fixture
def whole_store(make_episode, tmp_path_factory):
    """An episode with H.264, JPEG and numbers, written once."""
    if _WRITTEN:
        return _WRITTEN[0]
    made = make_episode(camera_unit="h264")
    made.descriptors = [
        d.model_copy(update={"unit": "jpeg"}) if d.name == STILLS else d
        for d in made.descriptors
        if d.name not in {"camera_wrist_right", "tactile_right"}
    ]
    store = EpisodeStore(tmp_path_factory.mktemp("hostile") / "store")
    made.write(store)
    _WRITTEN.append(store)
    return store


@pytest.fixture
def store(whole_store, tmp_path):
    shutil.copytree(whole_store.root, tmp_path / "store")
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def folder(store):
    return store.root / "episodes" / ID


@pytest.fixture
def bounded_memory():
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MEMORY_BYTES


def shard_of(folder, name):
    return next(path for path in (folder / name / "c").rglob("*") if path.is_file())


def chunks_of(path, count):
    data = path.read_bytes()
    index = np.frombuffer(data[-4 - 16 * count : -4], "<u8").reshape(-1, 2).tolist()
    return [data[offset : offset + length] for offset, length in index], index


def write_shard(path, chunks, index=None):
    if index is None:
        ends = np.cumsum([0, *map(len, chunks)]).tolist()
        index = [(end, len(chunk)) for end, chunk in zip(ends[:-1], chunks, strict=True)]
    path.write_bytes(b"".join(chunks) + with_crc(np.array(index, "<u8").tobytes()))


def num_chunks(folder, name):
    entry = json.loads((folder / "commit.json").read_bytes())["record"]["arrays"][name]
    return -(-entry["shape"][0] // entry["chunk_rows"])


def forge_record(folder, edit):
    outer = json.loads((folder / "commit.json").read_bytes())
    edit(outer["record"])
    outer["sha256"] = sha256_hex(canonical_json(outer["record"]))
    (folder / "commit.json").write_bytes(canonical_json(outer))


def forge_attributes(folder, data):
    (folder / "zarr.json").write_bytes(data)
    forge_record(folder, lambda record: record.update(attributes_sha256=sha256_hex(data)))


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


def test_all_of_it_is_whole(store):
    assert store.open(ID).verify().num_arrays == 12
    assert len(everything(store)) == 12


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
            if array in {name, f"{name}_t_ref_ns"}:
                entry["shape"][0] = rows

    return edit


def rows_and_chunks(name, rows):
    def edit(record):
        rows_of_stream(name, rows)(record)
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
        (rows_of_stream(TOUCH, 2**39), "too short for its index"),
        (rows_of_stream(VIDEO, 2**39), "too short for its index"),
        (edit_array(TOUCH, shape=[80, 320]), "not what the attributes say"),
        (rename_array, "not in the commit record"),
        (add_array, "elsewhere"),
        (lambda record: record["arrays"].clear(), "not in the commit record"),
        (lambda record: record.update(arrays=[]), "no commit record"),
        (lambda record: record.update(id="other"), "commit record says episode other"),
        (lambda record: record.update(id="../../x"), "commit record says"),
        (lambda record: record.update(kind="recording"), "commit record says"),
        (lambda record: record.update(extra=1), "no commit record"),
        (lambda record: record.update(format_version=[2]), "format version"),
    ],
)
def test_forged_commit_records(store, folder, edit, words):
    forge_record(folder, edit)
    with pytest.raises(StorageError, match=words):
        read_all(store)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("name", [TOUCH, VIDEO, STILLS])
def test_forged_rows_of_one_storage_chunk(store, folder, name):
    """With a true index of one storage chunk that is said to hold half a million million rows."""
    forge_record(folder, rows_and_chunks(name, 2**39))
    path = shard_of(folder, name)
    chunks, _ = chunks_of(path, 3)
    write_shard(path, chunks[:1])
    reader = store.open(ID)
    ways = [lambda: reader.images(name), lambda: reader.encoded_images(name, 0, 2**39)]
    if name == TOUCH:
        ways = [lambda: reader._contents.shard(name).read()]
    for read in ways:
        with pytest.raises(CorruptDataError, match="need at least"):
            read()


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
    with pytest.raises(CorruptDataError, match=name):
        store.open(ID).read(name)
    with pytest.raises(CorruptDataError, match=name):
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
    ("bomb", "words"),
    [
        (lambda true: frame(2**46), "holds 70368744177664 bytes"),
        (lambda true: repeated(2**33), "holds None bytes"),
        (lambda true: true + frame(2**46), "ends at byte"),
        (lambda true: true + repeated(2**33), "ends at byte"),
        (lambda true: true + b"\x00", "ends at byte"),
        (lambda true: true[:-1], "ends at byte None"),
        (lambda true: frame(30 * 320 * 4), "zstd"),
        (lambda true: frame(30 * 320 * 4, b"\x07\x00\x00"), "zstd"),
        (lambda true: Zstd(1).encode(bytes(7)), "holds 7 bytes"),
        (lambda true: b"", "need at least|holds None"),
    ],
)
def test_bombs_are_not_unpacked(store, folder, bomb, words):
    path = shard_of(folder, TOUCH)
    chunks, _ = chunks_of(path, num_chunks(folder, TOUCH))
    write_shard(path, [with_crc(bomb(chunks[0][:-4])), *chunks[1:]])
    with pytest.raises(CorruptDataError, match=words):
        store.open(ID).read(TOUCH)


@pytest.mark.parametrize("size", [0, 1, 255, 256, 65_791, 65_792, 1 << 20])
@pytest.mark.parametrize("checksum", [False, True])
def test_the_end_of_a_frame_is_where_it_is(size, checksum):
    rng = np.random.default_rng(size)
    for data in (bytes(size), rng.bytes(size)):
        encoded = Zstd(1, checksum=checksum).encode(data)
        assert zstd_frame_bytes(encoded + b"more") == len(encoded)
        assert zstd_frame_bytes(encoded[:-1]) is None


def forge_first_group(folder, forge):
    path = shard_of(folder, VIDEO)
    chunks, _ = chunks_of(path, num_chunks(folder, VIDEO))
    payload = chunks[0][:-4]
    count = int.from_bytes(payload[:4], "little")
    lengths = struct.unpack_from(f"<{count}I", payload, 4)
    ends = (4 + 4 * count + np.cumsum([0, *lengths])).tolist()
    units = [payload[low:high] for low, high in pairwise(ends)]
    write_shard(path, [with_crc(forge(units)), *chunks[1:]])


def group(units, count=None, lengths=None):
    lengths = [len(unit) for unit in units] if lengths is None else lengths
    count = len(units) if count is None else count
    return struct.pack(f"<{1 + len(lengths)}I", count, *lengths) + b"".join(units)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    "forge",
    [
        lambda units: group(units, count=0),
        lambda units: group(units, count=9),
        lambda units: group(units, count=2**32 - 1),
        lambda units: group(units, lengths=[2**32 - 1] * 8),
        lambda units: group(units, lengths=[len(u) + 1 for u in units]),
        lambda units: group(units[:7]),
        lambda units: group(units[:1]) + bytes(200),
        lambda units: group([b"".join(units), *[b""] * 7]),
        lambda units: group([units[0], *[b""] * 7]) + bytes(0),
        lambda units: group([units[1], units[0], *units[2:]]),
        lambda units: group([units[0][units[0].rfind(b"\x00\x00\x01") :], *units[1:]]),
        lambda units: group([b"\x00\x00\x00\x01\x09\x10"] * 8),
        lambda units: group([bytes(100)] * 8),
        lambda units: b"\x08",
    ],
)
def test_forged_groups_of_pictures(store, folder, forge):
    forge_first_group(folder, forge)
    with pytest.raises(CorruptDataError, match=VIDEO):
        store.open(ID).images(VIDEO)


def test_a_short_group_in_the_middle_shifts_nothing(store, folder):
    forge_first_group(folder, lambda units: group(units[:7]))
    with pytest.raises(CorruptDataError, match="holds 7 images, expected 8"):
        store.open(ID).encoded_images(VIDEO, 0, 12)


class Bits:
    """Writes the numbers of a parameter set (ITU-T H.264, 9.1)."""

    def __init__(self):
        self.text = ""

    def fixed(self, value, width):
        self.text += f"{value:0{width}b}"

    def golomb(self, *values):
        for value in values:
            self.text += "0" * ((value + 1).bit_length() - 1) + f"{value + 1:b}"

    def unit(self, header):
        text = self.text + "1"
        text += "0" * (-len(text) % 8)
        data = int(text, 2).to_bytes(len(text) // 8, "big")
        # No three bytes may look like a start code.
        while (place := data.find(b"\x00\x00")) >= 0 and place + 2 < len(data):
            if data[place + 2] > 3:
                break
            data = data[: place + 2] + b"\x03" + data[place + 2 :]
        return b"\x00\x00\x00\x01" + bytes([header]) + data


def sequence_parameters(macroblocks_wide, macroblocks_high):
    """Profile baseline, level 6.2, one reference, no cropping."""
    bits = Bits()
    for value in (66, 0xC0, 62):
        bits.fixed(value, 8)
    # id, frame numbers of 4 bits, picture order by decoding, one reference
    bits.golomb(0, 0, 2, 1)
    bits.fixed(0, 1)
    bits.golomb(macroblocks_wide - 1, macroblocks_high - 1)
    for flag in (1, 1, 0, 0):
        bits.fixed(flag, 1)
    return bits.unit(0x67)


def peak_bytes():
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


@pytest.mark.parametrize(("wide", "high"), [(1024, 1024), (1024, 4), (8, 8), (4, 5)])
def test_video_that_announces_another_size(store, folder, wide, high):
    """16,384 x 16,384 pixels would be 400 MB an image."""
    true = store.open(ID).images(VIDEO, 8, 16)

    def forge(units):
        start = b"\x00\x00\x00\x01"
        kept = [part for part in units[0].split(start) if part and part[0] & 0x1F != 7]
        first = sequence_parameters(wide, high) + b"".join(start + part for part in kept)
        return group([first, *units[1:]])

    forge_first_group(folder, forge)
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_bytes()
    reader = store.open(ID)
    with pytest.raises(CorruptDataError, match=VIDEO):
        reader.images(VIDEO, 0, 8)
    assert peak_bytes() - before < MEMORY_BYTES
    # The decoder of this thread is as good as new.
    np.testing.assert_array_equal(reader.images(VIDEO, 8, 16), true)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("shape", [(64, 65), (65, 64), (1, 1), (128, 128)])
def test_a_jpeg_of_another_size(store, folder, shape):
    path = shard_of(folder, STILLS)
    chunks, _ = chunks_of(path, num_chunks(folder, STILLS))
    image = encode_jpeg(np.full((*shape, 3), 90, np.uint8))
    write_shard(path, [with_crc(image), *chunks[1:]])
    with pytest.raises(CorruptDataError, match=r"storage chunk 0.*expected .64, 64."):
        store.open(ID).images(STILLS)


def test_a_jpeg_that_announces_much_and_holds_little(store, folder):
    path = shard_of(folder, STILLS)
    chunks, _ = chunks_of(path, num_chunks(folder, STILLS))
    for forged in (chunks[0][:-80], chunks[0][: len(chunks[0]) // 2], b"\xff\xd8\xff", b"x"):
        write_shard(path, [with_crc(forged), *chunks[1:]])
        with pytest.raises(CorruptDataError, match="storage chunk 0"):
            store.open(ID).images(STILLS)


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


def test_images_larger_than_any_are_refused_before_they_are_made(store, folder):
    data = (folder / "zarr.json").read_bytes()
    forge_attributes(folder, data.replace(b'"shape":[64,64,3]', b'"shape":[8388608,8388608,3]'))

    def edit(record):
        for name in (VIDEO, STILLS):
            record["arrays"][name]["shape"][1:3] = [8388608, 8388608]

    forge_record(folder, edit)
    with pytest.raises(CorruptDataError, match="pixels, expected at most"):
        store.open(ID)
