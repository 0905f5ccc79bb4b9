"""Merges of stores: everything comes over as it is, nothing twice, nothing over something else."""

from datetime import UTC, datetime

import pytest

from dextouch.episodes import EpisodeStore, is_rejected, maintenance
from dextouch.episodes.editing import (
    EditOptions,
    MergeOptions,
    merge_stores,
    relabel_item,
    trim_episode,
)
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import EpisodeClicks, ItemNotes, Review, TimedNote
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
REVIEW = Review(verdict="accepted", reviewer="p-7", reviewed_at=NOON)
NOTES = ItemNotes(
    notes=(TimedNote(number=3, start_ns=0, stop_ns=9, text="slips", written_at=NOON),)
)
CLICKS = EpisodeClicks.model_validate({"objects": {"cup": {"state": "absent"}}})
PLAIN = MergeOptions()
KEPT = EditOptions(keep=True)
REJECTED = Review(verdict="rejected", reviewed_at=NOON)


@pytest.fixture
def stores(tmp_path):
    return [EpisodeStore(tmp_path / name) for name in ("one", "two", "target")]


def outcomes(reports):
    return [(one.item_id, one.action, one.new_id) for one in reports]


def files_of(store, name, kind="episode"):
    files = store.files(name, kind=kind)
    return {path: files.get_now(path) for path in files.names()}


def test_items_come_over_byte_for_byte_with_what_people_said(stores):
    one, two, target = stores
    write_take(one, "take")
    one.set_review("take-aligned", REVIEW)
    one.set_clicks("take-aligned", CLICKS)
    one.change_notes("take-aligned", lambda _: NOTES)
    write_episode(two, "other")
    reports = merge_stores([one, two], target, options=PLAIN)
    assert outcomes(reports) == [
        ("take", "copied", "take"),
        ("take-aligned", "copied", "take-aligned"),
        ("other", "copied", "other"),
    ]
    assert files_of(target, "take-aligned") == files_of(one, "take-aligned")
    assert files_of(target, "take", "recording") == files_of(one, "take", "recording")
    assert target.review("take-aligned") == REVIEW
    assert target.notes("take-aligned") == NOTES
    # Copies, not links: one store may be a backup of the other.
    ours, theirs = (s.root / "episodes/take-aligned/action/c/0/0" for s in (target, one))
    assert not ours.samefile(theirs)
    for name in target.list():
        assert not maintenance.inspect_group(target.files(name), "episode").damaged
    assert {a for _, a, _ in outcomes(merge_stores([one, two], target, options=PLAIN))} == {"there"}


def test_remarks_go_to_an_equal_item_that_has_none(stores):
    one, _, target = stores
    for store in (one, target):
        write_episode(store, "a")
    one.set_review("a", REVIEW)
    one.change_notes("a", lambda _: NOTES)
    mine = ItemNotes(notes=(NOTES.notes[0].model_copy(update={"text": "mine"}),))
    target.change_notes("a", lambda _: mine)
    (report,) = merge_stores([one], target, options=PLAIN)
    assert (report.action, report.remarks) == ("there", ("review",))
    assert (target.review("a"), target.notes("a")) == (REVIEW, mine)


def test_an_id_with_other_content_is_refused_or_gets_a_new_id(stores):
    one, _, target = stores
    write_episode(one, "a", seed=1)
    source = write_episode(target, "a", seed=2)
    reports = merge_stores([one], target, options=PLAIN)
    assert outcomes(reports) == [("a", "refused", "")]
    assert "--rename" in reports[0].reason
    for action in ("copied", "there"):
        reports = merge_stores([one], target, options=MergeOptions(rename=True))
        assert outcomes(reports) == [("a", action, "a-merged-1")]
    assert target.open("a").content_sha256 == source.content_sha256
    copy = target.open("a-merged-1")
    copy.verify()
    assert copy.attributes.seed == 1
    (entry,) = copy.attributes.lineage
    assert (entry.id, entry.sha256) == ("a", one.open("a").content_sha256)
    assert entry.operation == "merge --rename"


def test_renamed_items_refer_to_each_other(stores):
    one, _, target = stores
    write_take(target, "take", consent=True)
    write_take(one, "take", num_steps=12, consent=False)
    relabel_item(one, "take-aligned", {"instruction": "up"}, options=KEPT)
    write_episode(target, "take-aligned-relabelled-1", seed=7)
    target.set_review("take", REJECTED, kind="recording")
    merge_stores([one], target, options=MergeOptions(rename=True))
    copy = "take-aligned-merged-1"
    assert target.open(copy).attributes.lineage[0].id == "take-merged-1"
    assert not is_rejected(target, target.open("take-aligned-relabelled-1-merged-1").attributes)
    # Superseded by the copy of its result, not by the item that has the id of that.
    assert target.review(copy).superseded_by == ("take-aligned-relabelled-1-merged-1",)
    target.set_review("take", None, kind="recording")
    target.set_review("take-merged-1", REJECTED, kind="recording")
    rejected = [n for n in target.list() if is_rejected(target, target.open(n).attributes)]
    assert rejected == [copy, "take-aligned-relabelled-1-merged-1"]
    # An edit of the copy is none of the item that has its former id.
    relabel_item(target, copy, {"instruction": "down"}, options=KEPT)
    assert target.review("take-aligned") is None


def test_a_merge_again_brings_back_nothing_that_was_edited_or_deleted(stores):
    one, _, target = stores
    for name in ("a", "b", "c"):
        write_episode(one, name, num_steps=20)
    write_episode(target, "c")
    options = MergeOptions(rename=True)
    merge_stores([one], target, options=options)
    for name in ("a", "c-merged-1"):
        trim_episode(target, name, (1, 20))
    target.purge()
    target.delete("b")
    reports = merge_stores([one], target, options=options)
    ids = ["a-trimmed-1", "b", "c-merged-1-trimmed-1"]
    assert [(one.action, one.new_id) for one in reports] == [("there", name) for name in ids]
    assert target.list() == ["a-trimmed-1", "c", "c-merged-1-trimmed-1"]
    # What an interrupted merge left out is no edited source: the edit itself came over.
    edit = relabel_item(one, "b", {"instruction": "up"}, options=EditOptions("z", keep=True))
    merge_stores([one], target, options=options)
    target.purge()
    merge_stores([one], target, options=options)
    assert {"b", edit.id} <= set(target.list())


def test_names_of_deleted_operators_do_not_come_back(stores, tmp_path):
    one, _, target = stores
    write_recording(target, "take", operator="p-7")
    request = maintenance.DeletionRequest(operator="p-7")
    maintenance.delete_for_good(target.root, request, tmp_path / "receipt.json")
    write_episode(one, "a")
    one.set_review("a", REVIEW)
    mine = NOTES.notes[0].model_copy(update={"author": "p-7"})
    one.change_notes("a", lambda _: ItemNotes(notes=(mine,)))
    merge_stores([one], target, options=PLAIN)
    assert target.review("a") == REVIEW.model_copy(update={"reviewer": None})
    assert target.notes("a") == NOTES


def test_a_note_that_is_written_during_a_merge_stays(stores, monkeypatch):
    one, _, target = stores
    for store in (one, target):
        write_episode(store, "a")
    one.change_notes("a", lambda _: NOTES)
    mine = ItemNotes(notes=(NOTES.notes[0].model_copy(update={"text": "mine"}),))
    real = target.change_notes

    def late(*args, **kwargs):
        real("a", lambda _: mine)
        return real(*args, **kwargs)

    monkeypatch.setattr(target, "change_notes", late)
    merge_stores([one], target, options=PLAIN)
    assert target.notes("a") == mine


def test_damage_is_refused_and_the_rest_is_copied(stores):
    one, _, target = stores
    write_episode(one, "a")
    write_episode(one, "b")
    shard = one.root / "episodes/a/action/c/0/0"
    data = bytearray(shard.read_bytes())
    data[20] ^= 1
    shard.write_bytes(data)
    reports = merge_stores([one], target, options=PLAIN)
    assert outcomes(reports) == [("a", "refused", ""), ("b", "copied", "b")]
    assert target.list() == ["b"]
    assert list((target.root / ".staging").iterdir()) == []


def test_what_was_deleted_for_good_does_not_come_back(stores, tmp_path):
    one, two, target = stores
    for store in (one, target):
        write_take(store, "take", operator="p-1", station="bench")
    write_episode(two, "trained", operator="p-1")
    write_episode(two, "free", operator="p-2")
    request = maintenance.DeletionRequest(operator="p-1")
    maintenance.delete_for_good(target.root, request, tmp_path / "receipt.json")
    reports = merge_stores([one, two], target, options=PLAIN)
    assert [report.action for report in reports] == ["refused", "refused", "copied", "refused"]
    assert "permanently deleted" in reports[0].reason
    assert target.list() == ["free"]


def test_a_dry_run_says_the_same_and_writes_nothing(stores):
    one, _, target = stores
    write_episode(one, "a")
    reports = merge_stores([one], target, options=MergeOptions(dry_run=True))
    assert outcomes(reports) == [("a", "copied", "a")]
    assert not target.root.exists()


@pytest.mark.parametrize("rename", [False, True])
def test_a_dry_run_of_several_stores_counts_as_the_merge_does(stores, rename):
    one, two, target = stores
    for store in (one, two):
        write_take(store, "take")
        write_episode(store, "same")
        write_episode(store, "twice", num_steps=25)
    write_episode(target, "twice")
    write_episode(one, "other")
    write_episode(two, "other", num_steps=30)
    planned, done = (
        merge_stores([one, two], target, options=MergeOptions(rename=rename, dry_run=dry_run))
        for dry_run in (True, False)
    )
    assert outcomes(planned) == outcomes(done)


def test_a_store_is_not_merged_into_itself_and_an_empty_one_is_named(stores, tmp_path):
    one, two, _ = stores
    write_episode(one, "a")
    again = EpisodeStore(tmp_path / "here" / ".." / "one")
    (tmp_path / "here").mkdir()
    for same in (one, again):
        with pytest.raises(InvalidInputError, match="is the store to merge into"):
            merge_stores([same], one, options=PLAIN)
    with pytest.raises(NotFoundError, match="has no item; check its path"):
        merge_stores([two], one, options=PLAIN)


def test_edits_and_merges_work_in_buckets(stores, tmp_path):
    one, _, target = stores
    with running_s3() as server:
        options = CREDENTIALS | {"work_folder": str(tmp_path / "work")}
        check_bucket(one, EpisodeStore(server.url("unit/edits"), options), target)


def check_bucket(one, bucket, target):
    write_episode(one, "a", num_steps=20)
    write_recording(one, "take")
    one.set_review("a", REVIEW)
    assert {r.action for r in merge_stores([one], bucket, options=PLAIN)} == {"copied"}
    assert bucket.review("a") == REVIEW
    trimmed = trim_episode(bucket, "a", (3, 20))
    assert trimmed.source_is == "superseded"
    assert "no trash" in trimmed.messages[0]
    relabelled = relabel_item(bucket, trimmed.id, {"instruction": "up"})
    assert set(bucket.list()) == {"a", trimmed.id, relabelled.id}
    for name in bucket.list():
        assert not maintenance.inspect_group(bucket.files(name), "episode").damaged
    merge_stores([bucket], target, options=PLAIN)
    assert target.open(relabelled.id).content_sha256 == relabelled.sha256
    assert target.review("a").superseded_by == (trimmed.id, relabelled.id)
