"""Reviews: they go where their item goes, are no damage, and say what is trained on."""

from datetime import UTC, datetime

import pytest

from dextouch.episodes import EpisodeStore, is_rejected, maintenance
from dextouch.errors import CorruptDataError
from dextouch.schemas import Review
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
REJECTED, ACCEPTED = (Review(verdict=v, reviewed_at=NOON) for v in ("rejected", "accepted"))


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def rejected(store, name):
    return is_rejected(store, store.open(name).attributes)


def test_a_review_goes_to_the_trash_and_back(store):
    write_episode(store, "a")
    store.set_review("a", REJECTED)
    store.delete("a")
    write_episode(store, "a")
    assert store.review("a") is None
    store.delete("a", for_good=True)
    store.restore("a")
    assert store.review("a") == REJECTED


def test_a_review_is_no_foreign_file(store):
    write_episode(store, "a")
    store.set_review("a", ACCEPTED)
    assert not maintenance.inspect_group(store.files("a"), "episode").findings


@pytest.mark.parametrize("content", ["{", '{"verdict": "liked"}'])
def test_a_review_that_is_none_is_named(store, content):
    write_episode(store, "a")
    (store.root / "episodes" / "a" / "review.json").write_text(content)
    with pytest.raises(CorruptDataError, match=r"episode 'a': review\.json"):
        store.review("a")


def test_a_later_release_may_say_more(store):
    write_episode(store, "a")
    text = '{"verdict": "accepted", "reviewed_at": "2026-05-04T12:00:00Z", "stars": 5}'
    (store.root / "episodes" / "a" / "review.json").write_text(text)
    assert store.review("a") == ACCEPTED


def test_what_is_made_from_rejected_items_is_rejected(store):
    write_take(store, "take")
    lineage = [{"kind": "episode", "id": "take-aligned"}, {"kind": "checkpoint", "id": "take"}]
    write_episode(store, "dream", origin="imagined", lineage=lineage)
    write_episode(store, "other", lineage=[{"kind": "recording", "id": "elsewhere"}])
    assert not any(rejected(store, name) for name in ("take-aligned", "dream", "other"))
    store.set_review("take", REJECTED, kind="recording")
    assert rejected(store, "take-aligned")
    # A verdict on the episode itself counts more than that on its recording.
    store.set_review("take-aligned", ACCEPTED)
    assert not rejected(store, "take-aligned")
    store.set_review("take-aligned", REJECTED)
    assert rejected(store, "dream")
    assert not rejected(store, "other")


def test_recordings_and_episodes_of_one_name_are_told_apart(store):
    write_recording(store, "same")
    write_episode(store, "same")
    store.set_review("same", REJECTED, kind="recording")
    assert store.review("same") is None
    assert not rejected(store, "same")
