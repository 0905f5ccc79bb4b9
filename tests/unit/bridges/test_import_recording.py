"""Recordings from streams of foreign files: names, order, provenance and the report."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from dextouch import __version__
from dextouch.bridges.export_files import Block, wall_offset_ns
from dextouch.bridges.import_recording import (
    ForeignStream,
    ImportAttributes,
    Refused,
    find_format,
    new_attributes,
    recording_id_of,
    stream_names,
    write_recording,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.streams import StreamDescriptor

NOON_NS = 1_700_000_000_000_000_000


def numbers(name: str) -> StreamDescriptor:
    return StreamDescriptor(
        name=name, kind="scalar", shape=(1,), dtype="float64", unit="value", nominal_rate_hz=10.0
    )


def block(*t_ns: int, t_device_ns: int = -1) -> Block:
    t = np.array(t_ns, dtype=np.int64)
    return Block(t, np.full_like(t, t_device_ns), np.full_like(t, -1), t[:, None].astype(float))


def source_file(tmp_path: Path) -> Path:
    path = tmp_path / "Take 7 (copy).mcap"
    path.write_bytes(b"content")
    return path


def test_samples_provenance_and_counts_arrive(tmp_path: Path) -> None:
    store = EpisodeStore(tmp_path / "store")
    path = source_file(tmp_path)
    about = ImportAttributes(task="wipe", domain="robot", id_prefix="lab-")
    attributes = new_attributes(path, about, form="mcap", first_ns=NOON_NS)
    blocks = [block(0, 10, 10), block(10, 40, 30, 50, t_device_ns=7)]
    streams = [ForeignStream(numbers("a"), "/a", blocks), ForeignStream(numbers("b"), "/b")]
    report = write_recording(store, attributes, streams, refused=[Refused("/c", "odd", "x", 3)])

    recording = store.recording("lab-take-7-copy")
    assert recording.stamps("a").t_host_ns.tolist() == [0, 10, 10, 10, 30, 40, 50]
    assert recording.values("a", 0, 7)[:, 0].tolist() == [0, 10, 10, 10, 30, 40, 50]
    assert recording.num_samples("b") == 0
    source = recording.attributes.imported_from
    assert source is not None
    assert source.name == "Take 7 (copy).mcap"
    assert source.sha256 == hashlib.sha256(b"content").hexdigest()
    assert source.importer == f"dextouch {__version__} mcap"
    assert recording.attributes.started_t_host_ns == NOON_NS
    assert str(recording.attributes.started_at) == "2023-11-14 22:13:20+00:00"

    first, second = report.imported
    assert (first.num_samples, first.num_reordered, first.num_repeated_stamps) == (7, 1, 2)
    assert (first.num_device_stamps, first.duration_s) == (4, 50e-9)
    assert second.num_samples == 0
    said = "\n".join(report.lines())
    for part in (
        "1 out of order, sorted",
        "2 stamps repeat",
        "b  <- /b",
        "empty",
        "refused /c (x)",
    ):
        assert part in said


def test_the_start_is_exact_to_the_microsecond(tmp_path: Path) -> None:
    first_ns = NOON_NS + 987_654_321
    about = new_attributes(
        source_file(tmp_path), ImportAttributes(), form="mcap", first_ns=first_ns
    )
    assert wall_offset_ns(about) == 0
    assert about.started_t_host_ns == first_ns - 321


def test_an_import_is_whole_or_not_at_all(tmp_path: Path) -> None:
    store = EpisodeStore(tmp_path / "store")
    attributes = new_attributes(source_file(tmp_path), ImportAttributes(), form="mcap")
    with pytest.raises(InvalidInputError, match=r"/c: odd"):
        write_recording(store, attributes, [], refused=[Refused("/c", "odd")])
    backwards = ForeignStream(numbers("a"), "/a", [block(5), block(4)])
    with pytest.raises(InvalidInputError, match="stamp goes from sample to sample by -1 ns"):
        write_recording(store, attributes, [backwards])
    assert store.list(kind="recording") == []
    good = [ForeignStream(numbers("a"), "/a", [block(5)])]
    write_recording(store, attributes, good)
    with pytest.raises(ConflictError, match="--id-prefix"):
        write_recording(store, attributes, good)
    # Not written by older releases, and absent from recordings that were not imported.
    plain = attributes.model_copy(update={"imported_from": None})
    assert "imported_from" not in plain.model_dump()


@pytest.mark.parametrize(
    ("start", "advice"),
    [
        (b"#ROSBAG V2.0", "rosbags-convert"),
        (b"SQLite format 3\0", "rosbags-convert"),
        (b"version https://git-lfs.github.com/spec/v1", "git lfs pull"),
        (bytes.fromhex("28b52ffd"), "zstd -d"),
        (b"\x89HDF", r"89 48 44 46; expected"),
    ],
)
def test_files_of_other_kinds_say_what_to_do(tmp_path, start, advice) -> None:
    (tmp_path / "a").write_bytes(start)
    with pytest.raises(InvalidInputError, match=advice):
        find_format(tmp_path / "a")


def test_names_follow_the_rule() -> None:
    sources = [
        "/camera/Head/image_raw",
        "/camera_head",
        "/2d",
        "/a/b",
        "/a_b",
        "/x_t_host_ns",
        "/",
        "/ä",
    ]
    names = stream_names(sources, {"camera_head": "/camera/Head/image_raw"})
    assert names == {
        "/camera/Head/image_raw": "camera_head",
        "/camera_head": "camera_head_2",
        "/2d": "s_2d",
        "/a/b": "a_b",
        "/a_b": "a_b_2",
        "/x_t_host_ns": "x_",
        "/": "stream",
        "/ä": "stream_2",
    }
    assert max(map(len, stream_names(["/" + "long" * 40, "/" + "Long" * 40], {}).values())) == 64
    with pytest.raises(UnknownNameError, match="valid: /a"):
        stream_names(["/a"], {"x": "/b"})
    with pytest.raises(InvalidInputError, match="small letters"):
        stream_names(["/a"], {"X": "/a"})
    with pytest.raises(InvalidInputError, match="expected one"):
        stream_names(["/a"], {"x": "/a", "y": "/a"})


def test_names_without_a_latin_letter_have_ids_of_their_own() -> None:
    ids = {recording_id_of(Path(name), "lab-") for name in ("拿瓶.mcap", "放瓶.mcap", "_.mcap")}
    assert len(ids) == 3
    assert all(re.fullmatch("lab-imported-[0-9a-f]{8}", one) for one in ids)
