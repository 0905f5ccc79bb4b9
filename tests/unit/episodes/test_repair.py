"""Damage is named by storage chunk, repaired from a copy, or left out; never filled in."""

import shutil

import numpy as np
import pytest

from dextouch.episodes import GOP_IMAGES, EpisodeStore, LocalGroup
from dextouch.episodes.format import CHUNK_SECONDS
from dextouch.episodes.maintenance import inspect_group, repair_group
from dextouch.errors import ConflictError, CorruptDataError
from tests.unit.episodes.hostile_group import IMAGE_CHUNK, as_v2, flip, record_of, rows_of

ID = "stand-bottle-0003"
NEW = f"{ID}-salvaged-1"
VIDEO, STILLS, TOUCH = "camera_head", "camera_wrist_left", "tactile_left"
TOUCH_ROWS = round(60 * CHUNK_SECONDS)


@pytest.fixture(params=[3, pytest.param(2, marks=pytest.mark.long)])
def truth(request, make_episode, store):
    """What every stream holds before anything is damaged, as it is read."""
    made = make_episode(camera_unit="h264", num_steps=31)
    made.descriptors = [
        d.model_copy(update={"unit": "jpeg"}) if d.name == STILLS else d
        for d in made.descriptors
        if d.name not in {"camera_wrist_right", "tactile_right"}
    ]
    made.write(store)
    if request.param == 2:
        as_v2(store.root / "episodes" / ID)
    reader = store.open(ID)
    assert reader._contents.version == request.param
    return {name: reader.read(name) for name in reader.streams}


@pytest.fixture
def folder(store):
    return store.root / "episodes" / ID


def shard_of(folder, name):
    return next(path for path in (folder / name / "c").rglob("*") if path.is_file())


def place_of_image(folder, name, number):
    """File offset of an image of format v3, and the storage chunk it begins in."""
    start = int(rows_of(folder, f"{name}_index")[number, 0])
    chunk = start // IMAGE_CHUNK
    return start + 4 * chunk, chunk


def damage_chunk(folder, name, number):
    """Flip a byte of one storage chunk, of v3 in the first image of a group; returns its chunk."""
    if record_of(folder)["arrays"][name]["codec"] == "bytes":
        place, chunk = place_of_image(folder, name, number * {VIDEO: GOP_IMAGES, STILLS: 1}[name])
        flip(shard_of(folder, name), place)
        return chunk
    index = EpisodeStore(folder.parents[1]).open(ID)._contents.shard(name).check_index()
    flip(shard_of(folder, name), int(index[number, 0] + index[number, 1] // 2))
    return number


def test_milestones_are_counted_from_the_first_step_that_is_left(store, make_episode):
    events = {"grasp": 0.2, "stand": 1.5}
    made = make_episode(num_steps=31)
    made.write(store, event_times_s=events)
    damage_chunk(store.root / "episodes" / ID, "action", 0)
    lost_s = repair_group(store.root, "episode", ID).lost["action"] / 15
    about = store.open(NEW).attributes
    assert about.event_times_s == pytest.approx({"stand": 1.5 - lost_s})


def test_milestones_after_the_last_step_that_is_left_are_left_out(store, make_episode):
    made = make_episode(num_steps=31)
    made.write(store, event_times_s={"grasp": 0.2, "stand": 2.0})
    damage_chunk(store.root / "episodes" / ID, "action", 3)
    repair_group(store.root, "episode", ID)
    assert store.open(NEW).num_steps < 30
    assert store.open(NEW).attributes.event_times_s == pytest.approx({"grasp": 0.2})


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


@pytest.mark.long
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
    chunk = damage_chunk(folder, array, number)
    report = inspect_group(LocalGroup(folder), "episode")
    assert [(f.array, f.chunk) for f in report.findings] == [(array, chunk)]
    message = report.findings[0].message
    assert f"episode {ID}: array {array!r}: storage chunk {chunk}" in message
    if array in {VIDEO, STILLS} and store.open(ID)._contents.version == 3:
        assert message.endswith(f"damaged images: {rows[0]}")
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


@pytest.mark.long
@pytest.mark.parametrize("name", [TOUCH, VIDEO, STILLS, f"{STILLS}_t_ref_ns"])
@pytest.mark.parametrize("place", [-1, -5, -20, -28])
def test_a_damaged_index_costs_no_sample(store, folder, truth, name, place):
    flip(shard_of(folder, name), place)
    with pytest.raises(CorruptDataError, match="shard index"):
        store.open(ID).read(name.removesuffix("_t_ref_ns"))
    assert repair_group(store.root, "episode", ID).lost == {}
    check_salvaged(store, truth, {})


@pytest.mark.parametrize("place", [-1, -20])
def test_a_damaged_index_and_chunk_cost_that_chunk(store, folder, truth, place):
    damage_chunk(folder, VIDEO, 1)
    flip(shard_of(folder, VIDEO), place)
    repair_group(store.root, "episode", ID)
    check_salvaged(store, truth, {VIDEO: list(range(GOP_IMAGES, 2 * GOP_IMAGES))})


@pytest.mark.parametrize(("name", "kept"), [(TOUCH, TOUCH_ROWS), (VIDEO, GOP_IMAGES), (STILLS, 1)])
def test_of_a_truncated_file_the_front_is_kept(store, folder, truth, name, kept):
    path = shard_of(folder, name)
    if record_of(folder)["arrays"][name]["codec"] == "bytes":
        stop = place_of_image(folder, name, 2 * kept)[0]
    else:
        stop = int(store.open(ID)._contents.shard(name).check_index()[1].sum())
    path.write_bytes(path.read_bytes()[: stop - 1])
    repair_group(store.root, "episode", ID)
    check_salvaged(store, truth, {name: list(range(kept, len(truth[name])))})


@pytest.mark.long
@pytest.mark.parametrize("name", [TOUCH, VIDEO, f"{STILLS}_t_ref_ns"])
@pytest.mark.parametrize("cut", [-16, -32, -6, 16])
def test_an_index_that_is_cut_or_shifted_names_no_other_chunk(store, folder, truth, name, cut):
    """An entry of the index takes 16 bytes: the others then look right at another number."""
    path = shard_of(folder, name)
    data = path.read_bytes()
    path.write_bytes(data[:cut] if cut < 0 else data + bytes(cut))
    assert repair_group(store.root, "episode", ID).lost == {}
    check_salvaged(store, truth, {})


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
    assert result.action == "repaired"
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
    assert result.action == "repaired"
    assert store.open(ID).verify().content_sha256 == sha256
    assert not inspect_group(LocalGroup(folder), "episode").damaged
    assert list((store.root / ".staging").iterdir()) == []
    assert store.trash_list() == []


def test_a_copy_mends_the_commit_record(store, folder, copy):
    sha256 = store.open(ID).content_sha256
    (folder / "commit.json").unlink()
    assert repair_group(store.root, "episode", ID, copy=LocalGroup(copy)).action == "repaired"
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
    monkeypatch.setattr("dextouch.episodes.maintenance.repair.put_into_trash", die)
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
