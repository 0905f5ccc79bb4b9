"""A file of another item in the place of one of the same size: intact, and still wrong."""

import shutil

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, LocalGroup
from dextouch.episodes.maintenance import inspect_group, repair_group
from dextouch.errors import CorruptDataError
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor, encoded_values

NUM = 40


def stream(name, **changes):
    fields = {"name": name, "kind": "scalar", "shape": (64,), "dtype": "uint16", "unit": "counts"}
    return StreamDescriptor.model_validate(fields | {"nominal_rate_hz": 10} | changes)


IMAGE = {"kind": "image", "shape": (8, 8, 3), "dtype": "uint8"}
STREAMS = (
    stream("touch"),
    stream("raw", unit="rgb8", **IMAGE),
    stream("stills", unit="jpeg", **IMAGE),
)


def write_take(store, name, seed):
    """Noise, which cannot be compressed, so that all files of two takes have the same sizes."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(NUM) * 100_000_000 + rng.integers(0, 1000, NUM)
    stills = [encode_jpeg(image) for image in rng.integers(0, 255, (NUM, 8, 8, 3), dtype=np.uint8)]
    # A comment after the first marker makes them equally long (ITU-T T.81, B.2.4.5).
    size = 1000
    stills = [
        s[:2]
        + b"\xff\xfe"
        + (size - len(s) - 2).to_bytes(2, "big")
        + bytes(size - len(s) - 4)
        + s[2:]
        for s in stills
    ]
    values = {
        "touch": rng.integers(0, 65536, (NUM, 64), dtype=np.uint16),
        "raw": rng.integers(0, 256, (NUM, 8, 8, 3), dtype=np.uint8),
        "stills": encoded_values(stills),
    }
    attributes = RecordingAttributes(
        recording_id=name, task="t", instruction="", domain="human", station="s", streams=STREAMS
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for stream_name, rows in values.items():
            writer.append(stream_name, values=rows, t_host_ns=stamps)


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path)
    write_take(store, "mine", 1)
    write_take(store, "other", 2)
    return store


@pytest.mark.parametrize("array", ["touch", "raw", "stills", "stills_index", "touch_t_host_ns"])
def test_an_exchanged_file_is_noticed_by_every_way_to_read(store, array):
    mine, other = (
        next((store.root / "recordings" / name / array / "c").rglob("0*"))
        for name in ("mine", "other")
    )
    while mine.is_dir():
        mine, other = mine / "0", other / "0"
    whole = {name: store.recording("mine").read(name) for name in ("touch", "raw", "stills")}
    shutil.copyfile(other, mine)
    reader, name = store.recording("mine"), array.removesuffix("_index").removesuffix("_t_host_ns")
    with pytest.raises(CorruptDataError, match=f"'{array}'|'{name}'"):
        reader.verify()
    ways = [lambda: reader.read(name)]
    if not array.endswith("_ns"):
        ways.append(lambda: reader.values(name, 3, 4))
    for read in ways:
        with pytest.raises(
            CorruptDataError, match=r"not that in the commit record|image [03]: check"
        ):
            read()
    files = LocalGroup(store.root / "recordings" / "mine")
    assert {f.array for f in inspect_group(files, "recording").findings} >= {array}
    # Nothing of the other take gets into what is salvaged.
    repaired = repair_group(store.root, "recording", "mine")
    assert repaired.lost == {name: NUM}
    again = store.recording(repaired.new_id)
    for one in set(whole) - {name}:
        np.testing.assert_array_equal(again.read(one).values, whole[one].values)


def test_nothing_is_noticed_of_what_is_equal(store):
    """The files of this test differ in nothing but their content."""
    for array in ("touch", "raw", "stills"):
        sizes = {
            sum(p.stat().st_size for p in (store.root / "recordings" / name / array).rglob("0"))
            for name in ("mine", "other")
        }
        assert len(sizes) == 1, array
    assert store.recording("mine").verify().num_arrays == 13
