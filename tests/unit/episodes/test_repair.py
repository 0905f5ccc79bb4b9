"""Damage is named by storage chunk, mended from a copy, or left out; never filled in."""

import shutil

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import CHUNK_SECONDS, GOP_IMAGES
from dextouch.episodes.inspection import inspect_group, inspect_stage, inspect_upload
from dextouch.episodes.log import SpoolWriter
from dextouch.episodes.repair import repair_group, repair_unfinished
from dextouch.episodes.sources import LocalGroup
from dextouch.episodes.video import GopEncoder, VideoSettings
from dextouch.episodes.write_options import WriteOptions
from dextouch.errors import ConflictError, CorruptDataError
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch, encoded_values

ID = "stand-bottle-0003"
NEW = f"{ID}-salvaged-1"
VIDEO, STILLS, TOUCH = "camera_head", "camera_wrist_left", "tactile_left"
TOUCH_ROWS = round(60 * CHUNK_SECONDS)
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)


@pytest.fixture
def truth(make_episode, store):
    """What every stream holds before anything is damaged, as it is read."""
    made = make_episode(camera_unit="h264", num_steps=31)
    made.descriptors = [
        d.model_copy(update={"unit": "jpeg"}) if d.name == STILLS else d
        for d in made.descriptors
        if d.name not in {"camera_wrist_right", "tactile_right"}
    ]
    reader = made.write(store)
    return {name: reader.read(name) for name in reader.streams}


@pytest.fixture
def folder(store):
    return store.root / "episodes" / ID


def shard_of(folder, name):
    return next(path for path in (folder / name / "c").rglob("*") if path.is_file())


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)


def damage_chunk(folder, name, number):
    """Flip a byte in the middle of one storage chunk."""
    path = shard_of(folder, name)
    index = EpisodeStore(folder.parents[1]).open(ID)._contents.shard(name).check_index()
    flip(path, int(index[number, 0] + index[number, 1] // 2))


def check_salvaged(store, truth, gone):
    """The salvaged episode holds exactly what is not gone, by stream and row."""
    reader = store.open(NEW)
    reader.verify()
    assert reader.attributes.recovered
    for name, true in truth.items():
        kept = np.ones(len(true), dtype=bool)
        kept[gone.get(name, [])] = False
        data = reader.read(name)
        np.testing.assert_array_equal(data.t_ref_ns, true.t_ref_ns[kept])
        np.testing.assert_array_equal(data.values, true.values[kept])
    lost = {name: len(rows) for name, rows in gone.items() if len(rows)}
    named = {f"{name}_lost_to_damage": float(count) for name, count in lost.items()}
    assert reader.attributes.quality == named
    return lost


@pytest.mark.parametrize(
    ("array", "number", "stream", "rows"),
    [
        (TOUCH, 1, TOUCH, range(TOUCH_ROWS, 2 * TOUCH_ROWS)),
        (f"{TOUCH}_t_ref_ns", 0, TOUCH, range(TOUCH_ROWS)),
        (VIDEO, 1, VIDEO, range(GOP_IMAGES, 2 * GOP_IMAGES)),
        (VIDEO, 7, VIDEO, range(56, 61)),
        (f"{VIDEO}_t_ref_ns", 0, VIDEO, range(GOP_IMAGES)),
        (STILLS, 11, STILLS, [11]),
        (f"{STILLS}_t_ref_ns", 2, STILLS, range(16, 24)),
    ],
)
def test_what_holds_is_salvaged(store, folder, truth, array, number, stream, rows):
    sha256 = store.open(ID).content_sha256
    damage_chunk(folder, array, number)
    report = inspect_group(LocalGroup(folder), "episode")
    assert [(f.array, f.chunk) for f in report.findings] == [(array, number)]
    assert f"episode {ID}: array {array!r}: storage chunk {number}" in report.findings[0].message
    result = repair_group(store.root, "episode", ID)
    assert (result.action, result.new_id) == ("salvaged", NEW)
    assert result.lost == check_salvaged(store, truth, {stream: list(rows)})
    assert store.list() == [NEW]
    (lineage,) = store.open(NEW).attributes.lineage
    assert (lineage.kind, lineage.id, lineage.sha256) == ("episode", ID, sha256)
    # The damaged one is not gone.
    (entry,) = store.trash_list()
    assert (entry.kind, entry.item_id) == ("episode", ID)
    store.restore(ID)
    assert store.open(ID).content_sha256 == sha256


def test_several_damages_add_up(store, folder, truth):
    damage_chunk(folder, VIDEO, 0)
    damage_chunk(folder, f"{VIDEO}_t_ref_ns", 2)
    damage_chunk(folder, STILLS, 60)
    repair_group(store.root, "episode", ID)
    gone = {VIDEO: [*range(8), *range(16, 24)], STILLS: [60]}
    check_salvaged(store, truth, gone)


@pytest.mark.parametrize("name", [TOUCH, VIDEO, STILLS, f"{STILLS}_t_ref_ns"])
@pytest.mark.parametrize("place", [-1, -5, -20, -28])
def test_a_damaged_index_costs_no_sample(store, folder, truth, name, place):
    flip(shard_of(folder, name), place)
    with pytest.raises(CorruptDataError, match="shard index"):
        store.open(ID).read(name.removesuffix("_t_ref_ns"))
    assert repair_group(store.root, "episode", ID).lost == {}
    check_salvaged(store, truth, {})


@pytest.mark.parametrize(("name", "kept"), [(TOUCH, TOUCH_ROWS), (VIDEO, GOP_IMAGES), (STILLS, 1)])
def test_of_a_truncated_file_the_front_is_kept(store, folder, truth, name, kept):
    index = store.open(ID)._contents.shard(name).check_index()
    path = shard_of(folder, name)
    path.write_bytes(path.read_bytes()[: int(index[1].sum()) - 1])
    repair_group(store.root, "episode", ID)
    check_salvaged(store, truth, {name: list(range(kept, len(truth[name])))})


def test_a_lost_file_costs_its_stream(store, folder, truth):
    shard_of(folder, TOUCH).unlink()
    assert repair_group(store.root, "episode", ID).lost == {TOUCH: len(truth[TOUCH])}
    check_salvaged(store, truth, {TOUCH: list(range(len(truth[TOUCH])))})


def test_steps_stay_in_step(store, folder, truth):
    """Measured and commanded actions are found by the same number: both keep the same run."""
    rows = round(15 * CHUNK_SECONDS)
    damage_chunk(folder, "action_commanded", 1)
    repair_group(store.root, "episode", ID)
    gone = list(range(2 * rows))
    check_salvaged(store, truth, {"action": gone, "action_commanded": gone})
    window = store.open(NEW).window(0, 5, cameras=(), action_kind="commanded")
    assert np.diff(window.t_ref_ns).max() < 1.1e9 / 15


def test_metadata_of_arrays_is_written_anew(store, folder, truth):
    sha256 = store.open(ID).content_sha256
    (folder / TOUCH / "zarr.json").write_text("{}")
    (folder / VIDEO / "zarr.json").unlink()
    result = repair_group(store.root, "episode", ID)
    assert result.action == "mended"
    assert len(result.notes) == 2
    assert store.open(ID).verify().content_sha256 == sha256


def test_without_its_commit_record_all_is_salvaged(store, folder, truth):
    (folder / "commit.json").write_bytes(b"{")
    assert repair_group(store.root, "episode", ID).lost == {}
    check_salvaged(store, truth, {})
    (lineage,) = store.open(NEW).attributes.lineage
    assert lineage.sha256 is None


@pytest.mark.usefixtures("truth")
def test_without_its_attributes_nothing_is_guessed(store, folder):
    flip(folder / "zarr.json", 40)
    result = repair_group(store.root, "episode", ID)
    assert result.action == "left"
    assert "--from" in result.notes[-1]
    assert store.list() == [ID]
    assert store.trash_list() == []


@pytest.fixture
def copy(store, folder, truth, tmp_path):
    shutil.copytree(store.root, tmp_path / "copy")
    return tmp_path / "copy" / "episodes" / ID


def test_a_copy_makes_it_whole(store, folder, copy, tmp_path):
    """Damaged in every file here, and in one array there, which is good here."""
    sha256 = store.open(ID).content_sha256
    damage_chunk(copy, TOUCH, 0)
    for path in sorted(folder.rglob("*")):
        if path.is_file() and TOUCH not in path.parts and path.name != "commit.json":
            path.write_bytes(path.read_bytes()[:-3])
    shard_of(folder, VIDEO).unlink()
    shutil.rmtree(folder / STILLS)
    (folder / STILLS).symlink_to(tmp_path)
    result = repair_group(store.root, "episode", ID, copy=LocalGroup(copy))
    assert result.action == "mended"
    assert store.open(ID).verify().content_sha256 == sha256
    assert not inspect_group(LocalGroup(folder), "episode").damaged
    assert list((store.root / ".staging").iterdir()) == []
    assert store.trash_list() == []


def test_a_copy_mends_the_commit_record(store, folder, copy):
    sha256 = store.open(ID).content_sha256
    (folder / "commit.json").unlink()
    assert repair_group(store.root, "episode", ID, copy=LocalGroup(copy)).action == "mended"
    assert store.open(ID).verify().content_sha256 == sha256


def test_what_is_damaged_in_both_is_salvaged(store, folder, copy, truth):
    for place in (folder, copy):
        damage_chunk(place, TOUCH, 1)
    damage_chunk(folder, VIDEO, 1)
    result = repair_group(store.root, "episode", ID, copy=LocalGroup(copy))
    gone = {TOUCH: list(range(TOUCH_ROWS, 2 * TOUCH_ROWS))}
    assert result.lost == check_salvaged(store, truth, gone)


def test_a_copy_of_something_else_is_refused(store, folder, made, tmp_path, truth):
    other = EpisodeStore(tmp_path / "other")
    made.write(other)
    damage_chunk(folder, TOUCH, 0)
    before = shard_of(folder, TOUCH).read_bytes()
    with pytest.raises(ConflictError, match="not proven"):
        repair_group(store.root, "episode", ID, copy=LocalGroup(other.root / "episodes" / ID))
    assert shard_of(folder, TOUCH).read_bytes() == before


def test_an_interrupted_repair_makes_no_second_copy(store, folder, truth, monkeypatch):
    def die(*_, **__):
        raise KeyboardInterrupt

    damage_chunk(folder, TOUCH, 1)
    monkeypatch.setattr("dextouch.episodes.repair.put_into_trash", die)
    with pytest.raises(KeyboardInterrupt):
        repair_group(store.root, "episode", ID)
    monkeypatch.undo()
    assert repair_group(store.root, "episode", ID).new_id == NEW
    assert store.list() == [NEW]


def test_foreign_things_are_named_and_left(store, folder, truth, tmp_path):
    (folder / "notes.txt").write_text("mine")
    (folder / TOUCH / "c" / "1").mkdir()
    (folder / "link").symlink_to(tmp_path)
    report = inspect_group(LocalGroup(folder), "episode")
    assert [f.message.split(": ")[1].split(" ")[0] for f in report.findings] == [
        "link",
        "notes.txt",
        f"{TOUCH}/c/1",
    ]
    assert repair_group(store.root, "episode", ID).action == "left"
    assert (folder / "notes.txt").is_file()
    assert (tmp_path / "store").is_dir()


def recording_attributes():
    return RecordingAttributes(
        recording_id="take-1",
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        streams=(FORCE,),
    )


def batch(first, count):
    numbers = np.arange(first, first + count, dtype=np.int64)
    values = np.stack([numbers, numbers + 0.5], axis=1).astype("f4")
    return SampleBatch(numbers * 10, numbers, numbers, values)


@pytest.fixture
def spool(store):
    path = store.root / ".uploads" / "take-1"
    with SpoolWriter(path, recording_attributes(), sync=False) as writer:
        writer.append("force", batch(0, 50))
    return path


@pytest.mark.parametrize(
    ("file", "place"), [("force.part", 7 * 8 + 3), ("force.journal", 8 + 7 * 44 + 5)]
)
def test_a_damaged_upload_is_salvaged(store, spool, file, place):
    flip(spool / file, place)
    report = inspect_upload(spool)
    assert report.damaged
    assert "row 7" in report.findings[0].message
    (result,) = repair_unfinished(store.root)
    assert (result.kind, result.action, result.lost) == ("upload", "salvaged", {"force": 1})
    reader = store.recording("take-1-salvaged-1")
    reader.verify()
    assert reader.read("force").sequence.tolist() == [n for n in range(50) if n != 7]
    expected = batch(0, 50).values[np.arange(50) != 7]
    np.testing.assert_array_equal(reader.read("force").values, expected)
    (ledger,) = reader.attributes.ledger
    assert (ledger.stream, ledger.event, ledger.count) == ("force", "lost_to_damage", 1)
    assert reader.attributes.recovered
    # The station may send all of it anew.
    assert not spool.exists()
    assert not store.exists("take-1", kind="recording")
    store.restore("take-1", kind="upload")
    assert (spool / file).is_file()


@pytest.mark.parametrize(("number", "lost"), [(0, 8), (10, 8), (15, 8), (17, 4), (19, 1)])
def test_of_video_in_an_upload_whole_groups_are_kept(store, number, lost):
    """An image of H.264 cannot do without those before it; what is torn off last is no damage."""
    camera = StreamDescriptor(
        name="camera",
        kind="image",
        shape=(32, 32, 3),
        dtype="uint8",
        unit="h264",
        nominal_rate_hz=30,
    )
    encoder = GopEncoder(32, 32, rate_hz=30.0, settings=VideoSettings())
    units = [encoder.encode(np.full((32, 32, 3), 9 * i, np.uint8)) for i in range(20)]
    attributes = recording_attributes().model_copy(update={"streams": (camera, FORCE)})
    spool = store.root / ".uploads" / "take-1"
    numbers = np.arange(20)
    with SpoolWriter(spool, attributes, sync=False) as writer:
        writer.append("camera", SampleBatch(numbers, numbers, numbers, encoded_values(units)))
        writer.append("force", batch(0, 9))
    flip(spool / "force.part", 3)
    flip(spool / "camera.part", sum(map(len, units[:number])) + 6)
    (result,) = repair_unfinished(store.root)
    torn = number == 19
    assert result.lost == {"force": 1} | ({} if torn else {"camera": lost})
    reader = store.recording("take-1-salvaged-1")
    first = number // 8 * 8
    kept = [i for i in range(20) if not first <= i < first + 8] if not torn else list(range(19))
    assert reader.read("camera").sequence.tolist() == kept
    assert reader.encoded_images("camera", 0, len(kept)) == [units[i] for i in kept]
    assert len(reader.images("camera")) == len(kept)


def test_whole_and_torn_uploads_are_left_to_their_station(store, spool):
    assert not inspect_upload(spool).damaged
    journal = spool / "force.journal"
    journal.write_bytes(journal.read_bytes()[:-3])
    assert not inspect_upload(spool).damaged
    flip(spool / "force.part", -9)
    assert not inspect_upload(spool).damaged
    assert repair_unfinished(store.root) == []


@pytest.fixture
def stage(store):
    """What a killed writer leaves, with two storage chunks of five rows in its journals."""
    options = WriteOptions(recoverable=True)
    writer = store.writer(kind="recording", attributes=recording_attributes(), options=options)
    part = batch(0, 17)
    writer.append(
        "force",
        values=part.values,
        t_host_ns=part.t_host_ns,
        t_device_ns=part.t_device_ns,
        sequence=part.sequence,
    )
    (stage,) = (store.root / ".staging").iterdir()
    shutil.copytree(stage, store.root / "kept")
    writer.__exit__(KeyboardInterrupt, None, None)
    (store.root / "kept").rename(stage)
    return stage


def test_a_whole_stage_is_recovered(store, stage):
    assert not inspect_stage(stage).damaged
    (result,) = repair_unfinished(store.root)
    assert (result.action, result.item_id) == ("recovered", "take-1")
    assert store.recording("take-1").num_samples("force") == 15


@pytest.mark.parametrize(
    ("file", "place"), [("force.part", 30), ("force.journal", 10), ("force_sequence.part", 9)]
)
def test_a_damaged_stage_is_salvaged(store, stage, file, place):
    flip(stage / file, place)
    assert inspect_stage(stage).damaged
    with pytest.raises(CorruptDataError):
        store.recover()
    (result,) = repair_unfinished(store.root)
    assert (result.kind, result.action, result.lost) == ("stage", "salvaged", {"force": 5})
    reader = store.recording("take-1-salvaged-1")
    reader.verify()
    assert reader.read("force").sequence.tolist() == list(range(5, 15))
    np.testing.assert_array_equal(reader.read("force").values, batch(5, 10).values)
    assert [entry.kind for entry in store.trash_list()] == ["stage"]
