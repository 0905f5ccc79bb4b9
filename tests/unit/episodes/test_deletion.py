"""Deleting an operator's data takes all that stems from it, and shows that nothing is left."""

import json
import struct
from datetime import UTC, datetime
from functools import partial
from threading import Thread

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.editing import MergeOptions, add_note, merge_stores, relabel_item
from dextouch.episodes.maintenance import (
    DeletionRequest,
    delete_for_good,
    deletion,
    plan_deletion,
    repair_group,
    reviews_by,
)
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from dextouch.schemas import LineageEntry, NewNote, RecordingAttributes, Review
from dextouch.streams import SampleBatch, StreamDescriptor
from tests.unit.episode_store import episodes as takes

MINE, OTHER = "op-1", "op-10"
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)


def recording_attributes(recording_id, operator):
    return RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        operator=operator,
        streams=(FORCE,),
    )


def batch(count=20):
    numbers = np.arange(count, dtype=np.int64)
    return SampleBatch(numbers, numbers, numbers, np.ones((count, 2), "f4"))


def write_recording(store, recording_id, operator):
    attributes = recording_attributes(recording_id, operator)
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append("force", values=batch().values, t_host_ns=batch().t_host_ns)
    return LineageEntry(
        kind="recording", id=recording_id, sha256=store.recording(recording_id).content_sha256
    )


def write_episode(store, made, episode_id, *lineage, **changes):
    attributes = made.attributes.model_copy(
        update={"episode_id": episode_id, "lineage": lineage} | changes
    )
    with store.writer(attributes=attributes) as writer:
        writer.add_stream(FORCE)
        writer.append("force", values=batch().values, t_ref_ns=batch().t_host_ns)
    return LineageEntry(kind="episode", id=episode_id, sha256=store.open(episode_id).content_sha256)


@pytest.fixture
def filled(store, made):
    """Two operators: recordings, episodes of them, imagined ones, and all that is unfinished."""
    for prefix, operator in (("a", MINE), ("b", OTHER)):
        take = write_recording(store, f"{prefix}-take", operator)
        episode = write_episode(store, made, f"{prefix}-episode", take)
        by_id = LineageEntry(kind="episode", id=episode.id)
        write_episode(store, made, f"{prefix}-imagined", by_id, origin="imagined")
        write_recording(store, f"{prefix}-deleted", operator)
        store.delete(f"{prefix}-deleted", kind="recording")
        spool = store.root / ".uploads" / f"{prefix}-upload"
        with SpoolWriter(spool, recording_attributes(spool.name, operator), sync=False) as writer:
            writer.append("force", batch())
        leave_stage(store, spool.name, operator)
    return store


def leave_stage(store, recording_id, operator):
    """A stage as a killed commit of an upload leaves it: its name says whose it is."""
    attributes = recording_attributes(recording_id, operator)
    writer = store.writer(kind="recording", attributes=attributes)
    writer.append("force", values=batch().values, t_host_ns=batch().t_host_ns)
    folder = next((store.root / ".staging").glob(f"*{recording_id}*"))
    folder.rename(store.root / "kept")
    writer.__exit__(KeyboardInterrupt, None, None)
    (store.root / "kept").rename(folder)


def everything(root):
    """All files but the record of the deletion itself (tests of its own)."""
    files = {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}
    return {name: data for name, data in files.items() if not name.startswith(".deleted/")}


def of_other(contents):
    return {name: data for name, data in contents.items() if "b-" in name}


def test_all_of_an_operator_goes_and_nothing_of_another(filled, tmp_path):
    before = of_other(everything(filled.root))
    receipt_path = tmp_path / "receipt.json"
    receipt = delete_for_good(filled.root, DeletionRequest(operator=MINE), receipt_path)
    assert receipt.complete
    assert receipt.remaining == ()
    assert sorted((v.place, v.id, v.reason) for v in receipt.deleted) == [
        (".staging", "a-upload", "same id"),
        (".trash", "a-deleted", "operator"),
        (".uploads", "a-upload", "operator"),
        ("episodes", "a-episode", "made from recording a-take"),
        ("episodes", "a-imagined", "made from episode a-episode"),
        ("recordings", "a-take", "operator"),
    ]
    left = everything(filled.root)
    assert of_other(left) == before == left
    assert not [name for name, data in left.items() if b"a-take" in data or b'"op-1"' in data]
    written = json.loads(receipt_path.read_bytes())
    assert written["request"] == {"operator": MINE, "recording": None, "derived": True}
    assert written["before"]["episodes"] == ["a-episode", "a-imagined", "b-episode", "b-imagined"]
    assert written["after"]["episodes"] == ["b-episode", "b-imagined"]
    assert written["counts"]["episodes"] == 2
    assert written["num_files_searched"] > 5
    assert OTHER not in receipt_path.read_text()
    with pytest.raises(NotFoundError, match="nothing in"):
        delete_for_good(filled.root, DeletionRequest(operator=MINE), receipt_path)


def test_reviews_of_an_operator_lose_the_name_and_keep_the_verdict(filled, tmp_path):
    at = datetime(2026, 5, 4, tzinfo=UTC)
    for reviewer, item_id in ((MINE, "b-episode"), (OTHER, "b-imagined"), (MINE, "a-episode")):
        filled.set_review(
            item_id, Review(verdict="rejected", reason="r", reviewer=reviewer, reviewed_at=at)
        )
    request = DeletionRequest(operator=MINE)
    assert [facts.item_id for facts in reviews_by(filled.root, request)] == [
        "a-episode",
        "b-episode",
    ]
    receipt = delete_for_good(filled.root, request, tmp_path / "r.json")
    assert receipt.complete
    assert receipt.unnamed_reviews == ("episodes/b-episode",)
    assert filled.review("b-episode") == Review(verdict="rejected", reason="r", reviewed_at=at)
    assert filled.review("b-imagined").reviewer == OTHER


def test_an_operator_who_only_reviewed_is_forgotten_too(filled, tmp_path):
    review = Review(
        verdict="accepted", reviewer="kim", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC)
    )
    filled.set_review("b-episode", review)
    receipt = delete_for_good(filled.root, DeletionRequest(operator="kim"), tmp_path / "r.json")
    assert receipt.complete
    assert receipt.deleted == ()
    assert receipt.unnamed_reviews == ("episodes/b-episode",)
    assert filled.review("b-episode").verdict == "accepted"


def test_a_recording_with_and_without_what_was_made_of_it(filled, tmp_path):
    alone = DeletionRequest(recording="a-take", derived=False)
    assert [v.id for v in plan_deletion(filled.root, alone)] == ["a-take"]
    receipt = delete_for_good(filled.root, alone, tmp_path / "r.json")
    assert not receipt.complete
    (remaining,) = receipt.remaining
    assert remaining.where == "episodes/a-episode/zarr.json"
    assert "a-take" in remaining.names
    request = DeletionRequest(recording="b-take")
    assert sorted(v.id for v in plan_deletion(filled.root, request)) == [
        "b-episode",
        "b-imagined",
        "b-take",
    ]


@pytest.mark.long
@pytest.mark.parametrize("num_removed", range(6))
def test_an_interrupted_deletion_is_completed_by_repeating_it(
    filled, tmp_path, monkeypatch, num_removed
):
    """The recordings go first here, so that only what was written down leads to the episodes."""
    real, calls = deletion.remove_for_good, []

    def die(folder):
        if len(calls) == num_removed:
            # A stage has no attributes.
            files = [*folder.rglob("*.json"), *(p for p in folder.rglob("*") if p.is_file())]
            files[0].unlink()
            raise KeyboardInterrupt
        calls.append(folder)
        real(folder)

    monkeypatch.setattr(deletion, "remove_for_good", die)
    request, path = DeletionRequest(operator=MINE), tmp_path / "r.json"
    with pytest.raises(KeyboardInterrupt):
        delete_for_good(filled.root, request, path)
    monkeypatch.undo()
    assert not path.exists()
    receipt = delete_for_good(filled.root, request, path)
    assert receipt.complete
    assert {v.id for v in receipt.deleted} == {
        "a-take",
        "a-episode",
        "a-imagined",
        "a-deleted",
        "a-upload",
    }
    assert ".staging" in {v.place for v in receipt.deleted}
    assert "a-take" in receipt.before["recordings"]
    left = everything(filled.root)
    assert left == of_other(left)


def test_what_a_writer_holds_is_listed_until_it_lets_go(filled, tmp_path):
    spool = filled.root / ".uploads" / "a-upload"
    writer = SpoolWriter.resume(spool, sync=False)
    request = DeletionRequest(operator=MINE)
    receipt = delete_for_good(filled.root, request, tmp_path / "r.json")
    assert not receipt.complete
    assert {r.where for r in receipt.remaining} == {
        ".uploads/a-upload",
        ".uploads/a-upload/recording.json",
    }
    assert ".uploads" not in {v.place for v in receipt.deleted}
    writer.abandon()
    receipt = delete_for_good(filled.root, request, tmp_path / "r.json")
    assert receipt.complete
    assert {".uploads", "recordings"} <= {v.place for v in receipt.deleted}


def test_damaged_things_that_name_the_operator_go_too(filled, tmp_path):
    folder = filled.root / "recordings" / "a-take"
    data = (folder / "zarr.json").read_bytes()
    (folder / "zarr.json").write_bytes(data[:-2] + b"\x00")
    receipt = delete_for_good(filled.root, DeletionRequest(operator=MINE), tmp_path / "r.json")
    assert receipt.complete
    assert "a-imagined" in {v.id for v in receipt.deleted}
    assert not folder.exists()


def test_what_cannot_be_read_is_no_proof(filled, tmp_path):
    (filled.root / "episodes" / "b-episode" / "zarr.json").write_bytes(b"\x00")
    receipt = delete_for_good(filled.root, DeletionRequest(operator=MINE), tmp_path / "r.json")
    assert receipt.remaining == ()
    assert receipt.unreadable == ("episodes/b-episode",)
    assert not receipt.complete


def test_salvaged_and_damaged_versions_go_together(filled, tmp_path):
    """The damaged original lies in the trash and may say nothing of itself any more."""
    folder = filled.root / "recordings" / "a-take"
    shard = next(p for p in (folder / "force" / "c").rglob("*") if p.is_file())
    data = bytearray(shard.read_bytes())
    data[3] ^= 1
    shard.write_bytes(data)
    assert repair_group(filled.root, "recording", "a-take").action == "salvaged"
    (trashed,) = (filled.root / ".trash").glob("recording.a-take.*")
    for name in ("zarr.json", "commit.json"):
        (trashed / name).write_bytes(b"\x00")
    request = DeletionRequest(recording="a-take-salvaged-1")
    receipt = delete_for_good(filled.root, request, tmp_path / "r.json")
    assert {v.id for v in receipt.deleted} == {
        "a-take-salvaged-1",
        "a-take",
        "a-episode",
        "a-imagined",
    }
    assert receipt.complete


def test_an_id_that_somebody_else_used_again_is_another_thing(filled, tmp_path):
    filled.delete("a-take", kind="recording")
    write_recording(filled, "a-take", OTHER)
    receipt = delete_for_good(filled.root, DeletionRequest(operator=MINE), tmp_path / "r.json")
    assert filled.list(kind="recording") == ["a-take", "b-take"]
    # It is named, so that somebody looks at it.
    assert {r.where for r in receipt.remaining} >= {"recordings/a-take"}


def test_checkpoints_are_searched_by_name(filled, tmp_path):
    header = {"__metadata__": {"notes": json.dumps({"train_episode_ids": ["a-episode"]})}}
    other = {"__metadata__": {"notes": json.dumps({"train_episode_ids": ["b-episode"]})}}
    models = tmp_path / "models"
    models.mkdir()
    for name, notes in (("mine", header), ("theirs", other)):
        data = json.dumps(notes).encode()
        (models / f"{name}.safetensors").write_bytes(struct.pack("<Q", len(data)) + data + b"0" * 9)
    receipt = delete_for_good(
        filled.root, DeletionRequest(operator=MINE), tmp_path / "r.json", checkpoints=models
    )
    assert [(r.where, r.names) for r in receipt.remaining] == [
        (str(models / "mine.safetensors"), ("a-episode",))
    ]
    assert not receipt.complete


@pytest.mark.long
@pytest.mark.parametrize("operator", ["Zoë", 'a"b', "x y", "a.b*", "ü\\n"])
def test_pseudonyms_of_any_letters(store, made, tmp_path, operator):
    write_recording(store, "take", operator)
    write_recording(store, "kept", operator + "s")
    path = store.root / "recordings" / "kept" / "notes.txt"
    path.write_text(f"like ({operator}), but better")
    receipt = delete_for_good(store.root, DeletionRequest(operator=operator), tmp_path / "r.json")
    assert store.list(kind="recording") == ["kept"]
    assert [r.where for r in receipt.remaining] == ["recordings/kept/notes.txt"]


def test_requests_that_ask_for_nothing_or_both(store, tmp_path):
    for bad in ({}, {"operator": "a", "recording": "b"}, {"operator": ""}):
        with pytest.raises(InvalidInputError, match="exactly one"):
            DeletionRequest(**bad)
    with pytest.raises(InvalidInputError, match="outside"):
        delete_for_good(store.root, DeletionRequest(operator="a"), store.root / "r.json")


def test_a_damaged_plan_is_said(filled, tmp_path):
    request = DeletionRequest(operator=MINE)
    path = deletion._intent_path(filled.root, request)
    path.parent.mkdir()
    path.write_text("{")
    with pytest.raises(CorruptDataError, match="remove it and repeat"):
        delete_for_good(filled.root, request, tmp_path / "r.json")
    path.unlink()
    # Another deletion that was not completed names things as well.
    (path.parent / "other.json").write_text('{"victims": ["a-take"]}')
    receipt = delete_for_good(filled.root, request, tmp_path / "r.json")
    assert [r.where for r in receipt.remaining] == [".deletions/other.json"]


def two_stores(tmp_path):
    """A store into which that of another operator with equal ids was merged."""
    one, other = (EpisodeStore(tmp_path / name) for name in ("one", "other"))
    takes.write_take(one, "t", operator=MINE)
    takes.write_take(other, "t", operator=OTHER, num_steps=12)
    merge_stores([other], one, options=MergeOptions(rename=True))
    return one


@pytest.mark.parametrize(
    ("operator", "left"),
    [(MINE, ["t-aligned-merged-1", "t-merged-1"]), (OTHER, ["t", "t-aligned"])],
)
def test_of_merged_stores_only_the_operator_goes(tmp_path, operator, left):
    store = two_stores(tmp_path)
    receipt = delete_for_good(store.root, DeletionRequest(operator=operator), tmp_path / "r.json")
    assert sorted(store.list() + store.list(kind="recording")) == left
    assert len(receipt.deleted) == 2


def test_of_merged_stores_only_the_recording_goes(tmp_path):
    store = two_stores(tmp_path)
    delete_for_good(store.root, DeletionRequest(recording="t"), tmp_path / "r.json")
    assert store.list() == ["t-aligned-merged-1"]
    assert store.list(kind="recording") == ["t-merged-1"]


@pytest.mark.parametrize("is_stored", [True, False])
def test_the_id_of_an_edited_source_that_somebody_used_again_is_another_thing(tmp_path, is_stored):
    store = EpisodeStore(tmp_path / "store")
    takes.write_recording(store, "t", operator=MINE)
    relabel_item(store, "t", {"instruction": "up"}, kind="recording")
    store.purge()
    takes.write_take(store, "t", operator=OTHER, num_steps=12)
    if not is_stored:
        store.delete("t", kind="recording", for_good=True)
    found = plan_deletion(store.root, DeletionRequest(operator=MINE))
    assert [victim.id for victim in found] == ["t-relabelled-1"]


def test_a_note_that_is_written_during_a_deletion_stays(filled, tmp_path, monkeypatch):
    """A deletion takes names off notes while nobody else changes them."""
    new = partial(NewNote, start_ns=0, stop_ns=10**9)
    add_note(filled, "b-take", new(text="mine", author=MINE), kind="recording")
    real, threads = deletion.without_author, []

    def slow(*args):
        if not threads:
            late = new(text="theirs", author=OTHER)
            threads.append(
                Thread(target=add_note, args=(filled, "b-take", late), kwargs={"kind": "recording"})
            )
            threads[0].start()
            threads[0].join(0.3)
        return real(*args)

    monkeypatch.setattr(deletion, "without_author", slow)
    delete_for_good(filled.root, DeletionRequest(operator=MINE), tmp_path / "r.json")
    threads[0].join()
    notes = filled.notes("b-take", kind="recording").notes
    assert [(one.text, one.author) for one in notes] == [("mine", None), ("theirs", OTHER)]
