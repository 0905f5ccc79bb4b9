"""An episode with H.264, JPEG and numbers, and ways to forge its files."""

import base64
import json
import shutil
import struct
import tracemalloc
from contextlib import contextmanager
from itertools import pairwise

import google_crc32c
import numpy as np
from numcodecs.zstd import Zstd

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import (
    ArrayEntry,
    array_metadata,
    canonical_json,
    sha256_hex,
)
from dextouch.episodes.shards import with_crc

ID = "stand-bottle-0003"
VIDEO, STILLS, TOUCH = "camera_head", "camera_wrist_left", "tactile_left"
# More than any test here needs, far less than what the forged numbers ask for.
MEMORY_BYTES = 64 << 20
# Of images of 64 x 64 pixels and fewer.
IMAGE_CHUNK = 4096
_WRITTEN: list[EpisodeStore] = []


def written_once(make_episode, tmp_path_factory):
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


def copy_of(whole_store, folder):
    shutil.copytree(whole_store.root, folder / "store")
    return EpisodeStore(folder / "store")


@contextmanager
def memory_bound():
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MEMORY_BYTES
    finally:
        tracemalloc.stop()


def stamp_version(store, kind, item_id, version):
    """Have the commit record of a group say another format version, with its hash adapted."""
    path = store.root / f"{kind}s" / item_id / "commit.json"
    record = json.loads(path.read_bytes())["record"] | {"format_version": version}
    digest = sha256_hex(canonical_json(record))
    path.write_bytes(canonical_json({"record": record, "sha256": digest}))


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


def descriptors(folder):
    group = json.loads((folder / "zarr.json").read_bytes())["attributes"]["dextouch"]
    return {stream["name"]: stream for stream in group["streams"]}


def record_of(folder):
    return json.loads((folder / "commit.json").read_bytes())["record"]


def rows_of(folder, name):
    """All rows of an array of numbers, decoded by another library than the reader's."""
    entry = record_of(folder)["arrays"][name]
    chunks, _ = chunks_of(shard_of(folder, name), num_chunks(folder, name))
    data = b"".join(Zstd(1).decode(chunk[:-4]) for chunk in chunks)
    rows = np.frombuffer(data, entry["dtype"]).reshape(-1, *entry["shape"][1:])
    return rows[: entry["shape"][0]]


def images_of(folder, name):
    """The encoded images of a camera of format v3, by the description of the format."""
    chunks, _ = chunks_of(shard_of(folder, name), num_chunks(folder, name))
    data = b"".join(chunk[:-4] for chunk in chunks)
    return [data[start:stop] for start, stop, _ in rows_of(folder, f"{name}_index").tolist()]


def write_numbers(folder, name, rows):
    """Write an array of numbers anew, with its checksums in the commit record."""
    size, row_bytes = record_of(folder)["arrays"][name]["chunk_rows"], rows[0].nbytes
    parts = [rows[at : at + size].tobytes() for at in range(0, len(rows), size)]
    chunks = [with_crc(Zstd(1).encode(part.ljust(size * row_bytes, b"\0"))) for part in parts]
    forge_chunks(folder, name, chunks)


def forge_chunks(folder, name, chunks):
    """Write storage chunks of numbers anew, with their checksums in the commit record."""
    write_shard(shard_of(folder, name), chunks)
    crcs = base64.b64encode(b"".join(chunk[-4:] for chunk in chunks)).decode()
    forge_record(folder, lambda record: record["arrays"][name].update(crc32c=crcs))


def write_images(folder, name, images):
    """Write other encoded images, as many as before, with all checksums right."""
    data, ends = b"".join(images), np.cumsum([len(image) for image in images])
    size = record_of(folder)["arrays"][name]["chunk_rows"]
    parts = [data[at : at + size].ljust(size, b"\0") for at in range(0, len(data), size)]
    write_shard(shard_of(folder, name), [with_crc(part) for part in parts])
    crcs = [google_crc32c.value(image) for image in images]
    rows = np.stack([np.concatenate([[0], ends[:-1]]), ends, crcs], axis=1).astype("<i8")
    write_numbers(folder, f"{name}_index", rows)
    forge_record(folder, lambda record: record["arrays"][name].update(shape=[len(data)]))


def as_v2(folder):
    """Write a group of format v3 as releases before wrote it, in format v2."""
    arrays, streams = record_of(folder)["arrays"], descriptors(folder)
    plain = {}
    for name, entry in arrays.items():
        stream = name.removesuffix("_index") if name.endswith("_index") else name
        unit = streams.get(stream, {}).get("unit")
        if stream != name and unit in {"jpeg", "h264"}:
            continue
        column = entry | {"crc32c": None, "attributes": {}}
        owner = max((one for one in streams if name.startswith(one)), key=len)
        column["dimension_names"] = [f"{owner}_time", *entry["dimension_names"][1:]]
        if unit in {"jpeg", "h264"}:
            images, shape = images_of(folder, name), streams[name]["shape"]
            rows = {"jpeg": 1, "h264": 8}[unit]
            groups = [images[at : at + rows] for at in range(0, len(images), rows)]
            shutil.rmtree(folder / name)
            path = folder / name / "c" / "0" / "0" / "0" / "0"
            path.parent.mkdir(parents=True)
            packed = [parts[0] if unit == "jpeg" else group(parts) for parts in groups]
            write_shard(path, [with_crc(part) for part in packed])
            column |= {"shape": [len(images), *shape], "chunk_rows": rows, "codec": unit}
            axes = [f"{name}_axis{axis}" for axis in (1, 2, 3)]
            column["dimension_names"] = [f"{name}_time", *axes]
            shutil.rmtree(folder / f"{name}_index")
        plain[name] = column
        metadata = array_metadata(ArrayEntry.model_validate_json(json.dumps(column)))
        (folder / name / "zarr.json").write_bytes(metadata)
    about = json.loads((folder / "zarr.json").read_bytes())
    del about["consolidated_metadata"]
    forge_record(folder, lambda record: record.update(format_version=2, arrays=plain))
    forge_attributes(folder, canonical_json(about))


def forge_images(folder, name, edit):
    """Replace encoded images by others, in either version."""
    if record_of(folder)["format_version"] == 3:
        write_images(folder, name, edit(images_of(folder, name)))
        return
    path, count = shard_of(folder, name), num_chunks(folder, name)
    chunks, _ = chunks_of(path, count)
    if descriptors(folder)[name]["unit"] == "jpeg":
        write_shard(path, [with_crc(one) for one in edit([chunk[:-4] for chunk in chunks])])
    else:
        forge_first_group(folder, lambda units: group(edit(units)))


def forge_first_group(folder, forge):
    """Replace the first group of pictures of a video of format v2."""
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


def flip(path, place):
    """Turn one bit of a file over."""
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)
