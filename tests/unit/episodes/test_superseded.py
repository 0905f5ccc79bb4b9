"""What becomes of the sources of edits: superseded by reviews, and left out by learners."""

from datetime import UTC, datetime
from threading import Thread

import pytest

from dextouch.episodes import (
    EpisodeStore,
    is_rejected,
    maintenance,
)
from dextouch.episodes.editing import (
    EditOptions,
    relabel_item,
    trim,
    trim_episode,
)
from dextouch.errors import (
    ConflictError,
    NotFoundError,
)
from dextouch.schemas import Review
from tests.unit.episode_store.episodes import write_episode, write_take
from tests.unit.episodes.conftest import chosen

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
KEPT = EditOptions(keep=True)
REJECTED = Review(verdict="rejected", reviewed_at=NOON)


def test_learners_take_the_result_in_place_of_the_source(store):
    write_episode(store, "a")
    result = trim_episode(store, "a", (1, 9), options=KEPT)
    assert store.list() == ["a", result.id]
    assert chosen(store) == [result.id]
    # To undo it is to delete the result: the mark counts only while that is there.
    store.delete(result.id)
    assert chosen(store) == ["a"]
    store.restore(result.id)
    assert chosen(store) == [result.id]
    store.set_review("a", Review(verdict="accepted", reviewed_at=NOON))
    assert chosen(store) == ["a", result.id]


def test_the_source_goes_to_the_trash_and_comes_back_superseded(store):
    write_episode(store, "a")
    result = trim_episode(store, "a", (1, 9))
    assert result.source_is == "in the trash"
    assert store.list() == [result.id]
    store.restore("a")
    assert store.review("a").reason == f"superseded by {result.id}"
    assert chosen(store) == [result.id]


@pytest.mark.parametrize("options", [KEPT, EditOptions()])
def test_of_a_chain_of_edits_only_the_last_is_taken(store, options):
    write_episode(store, "a", num_steps=20)
    second = trim_episode(store, "a", (1, 20), options=options).id
    third = relabel_item(store, second, {"instruction": "up"}).id
    if options != KEPT:
        store.restore("a")
    assert set(store.list()) == {"a", third}
    assert chosen(store) == [third]
    store.delete(third)
    store.restore(second)
    assert chosen(store) == [second]


def test_parts_of_one_recording_are_taken_unless_they_share_steps(store):
    write_take(store, "take", num_steps=30, quality={"origin_after_start_ns": 4e8})
    name = "take-aligned"
    parts = [
        trim_episode(store, name, span, outcome="keep", options=KEPT).id
        for span in [(0, 12), (12, 30)]
    ]
    assert chosen(store) == parts
    store.delete(parts[0])
    assert chosen(store) == parts[1:]
    trim_episode(store, name, (11, 13), outcome="keep", options=KEPT)
    with pytest.raises(ConflictError, match=r"are of one recording, .*or parts without common"):
        chosen(store)


def test_a_verdict_before_an_edit_is_kept(store):
    write_take(store, "take", num_steps=20)
    name = "take-aligned"
    store.set_review("take", Review(verdict="rejected", reviewed_at=NOON), kind="recording")
    accepted = Review(verdict="accepted", reviewer="p-7", reviewed_at=NOON)
    store.set_review(name, accepted)
    result = trim_episode(store, name, (2, 20), options=KEPT)
    # Accepted in spite of its recording: so is the part.
    assert store.review(result.id) == accepted
    assert chosen(store) == [result.id]
    store.delete(result.id)
    assert chosen(store) == [name]
    # A rejection stays with the source and holds for the part.
    store.set_review(name, REJECTED)
    result = trim_episode(store, name, (3, 20), options=KEPT)
    assert store.review(result.id) == REJECTED
    assert any("accept it" in message for message in result.messages)
    with pytest.raises(NotFoundError, match="rejected in review"):
        chosen(store)


@pytest.mark.parametrize("options", [KEPT, EditOptions()])
def test_an_edit_takes_no_rejection_back(store, options):
    write_episode(store, "a")
    store.set_review("a", REJECTED)
    result = relabel_item(store, "a", {"instruction": "up"}, options=options)
    assert is_rejected(store, store.open(result.id).attributes)
    # Nor one of a recording, for the episodes that were made of it.
    write_take(store, "take")
    store.set_review("take", REJECTED, kind="recording")
    relabel_item(store, "take", {"instruction": "up"}, kind="recording", options=KEPT)
    assert is_rejected(store, store.open("take-aligned").attributes)


def test_a_mark_outlives_reviews_but_not_an_acceptance(store):
    write_episode(store, "a")
    result = relabel_item(store, "a", {"instruction": "up"}, options=KEPT)
    for review in (REJECTED, None):
        store.set_review("a", review)
        assert store.review("a").superseded_by == (result.id,)
        assert store.review("a").earlier == review
    assert chosen(store) == [result.id]
    store.set_review("a", Review(verdict="accepted", reviewed_at=NOON))
    assert chosen(store) == ["a", result.id]


def test_a_review_during_an_edit_waits_and_keeps_its_mark(store, monkeypatch):
    write_episode(store, "a", num_steps=20)
    real, threads = trim._episode_blocks, []
    accepted = Review(verdict="accepted", reviewed_at=NOON)

    def slow(*args, **kwargs):
        if not threads:
            threads.append(Thread(target=store.set_review, args=("a", accepted)))
            threads[0].start()
            threads[0].join(0.3)
        return real(*args, **kwargs)

    monkeypatch.setattr(trim, "_episode_blocks", slow)
    result = trim_episode(store, "a", (1, 20), options=KEPT)
    threads[0].join()
    assert store.review("a").superseded_by == (result.id,)
    assert store.review("a").earlier == accepted
    assert chosen(store) == [result.id]


def test_an_edit_marks_no_other_item_of_its_source_s_id(store):
    write_episode(store, "a", seed=1)
    store.delete("a")
    write_episode(store, "a", seed=2)
    relabel_item(store, "a", {"instruction": "up"}, options=KEPT)
    store.delete("a", for_good=True)
    store.restore("a")
    assert store.open("a").attributes.seed == 1
    assert store.review("a") is None


@pytest.mark.parametrize("salvaged", ["a", "a-trimmed-1"])
def test_what_is_salvaged_of_an_edit_is_superseded_or_supersedes(store, salvaged):
    write_episode(store, "a", num_steps=20)
    trim_episode(store, "a", (1, 20), options=KEPT)
    damage(store, salvaged)
    new_id = maintenance.repair_group(store.root, "episode", salvaged).new_id
    assert chosen(store) == ["a-trimmed-1" if salvaged == "a" else new_id]
    write_episode(store, "b")
    store.set_review("b", REJECTED)
    damage(store, "b")
    assert store.review(maintenance.repair_group(store.root, "episode", "b").new_id) == REJECTED


def damage(store, name):
    shard = store.root / "episodes" / name / "tactile_left" / "c" / "0" / "0"
    shard.unlink()
    shard.write_bytes(b"x" * 10)


def test_a_damaged_result_has_its_id(store):
    write_episode(store, "a", num_steps=20)
    trim_episode(store, "a", (1, 20), options=KEPT)
    (store.root / "episodes/a-trimmed-1/commit.json").write_bytes(b"{}")
    assert trim_episode(store, "a", (2, 20)).id == "a-trimmed-2"


def test_an_edit_that_was_interrupted_after_its_commit_is_completed(store, monkeypatch):
    write_episode(store, "a")
    with monkeypatch.context() as patch:
        patch.setattr(EpisodeStore, "delete", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            trim_episode(store, "a", (1, 9))
    assert chosen(store) == ["a-trimmed-1"]
    assert trim_episode(store, "a", (1, 9)).id == "a-trimmed-1"
    assert store.list() == ["a-trimmed-1"]
