"""An episode with H.264, JPEG and numbers, and ways to forge its files."""

import json
import shutil
import struct
import tracemalloc
from contextlib import contextmanager
from itertools import pairwise

import numpy as np

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import canonical_json, sha256_hex
from dextouch.episodes.shards import with_crc

ID = "stand-bottle-0003"
VIDEO, STILLS, TOUCH = "camera_head", "camera_wrist_left", "tactile_left"
# More than any test here needs, far less than what the forged numbers ask for.
MEMORY_BYTES = 64 << 20
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


def flip(path, place):
    """Turn one bit of a file over."""
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)
