"""Uploads of deleted takes: a deletion may come at any moment, from another process."""

import pytest
from structlog.testing import capture_logs

from dextouch.episodes import EpisodeStore
from dextouch.episodes.maintenance import DeletionRecords, DeletionRequest, delete_for_good
from dextouch.errors import ConflictError, StorageError
from dextouch.schemas import FinishRecording
from dextouch.streams import encode_batch
from services.episode_store.app import PeriodicThread, deletion_watch
from services.episode_store.committing import commit_spool
from services.episode_store.ingest import Ingest
from tests.unit.episode_store.conftest import GLOVE, glove_batch

ALL = FinishRecording(num_batches={"glove_left": 1, "wrist_left": 0})


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
def delete(store, tmp_path):
    request = DeletionRequest(operator="gone")

    def now():
        return delete_for_good(store.root, request, tmp_path / "receipt.json", unsent=True)

    return now


@pytest.fixture
def take(attributes):
    return attributes.model_copy(update={"operator": "gone"})


def begin(ingest, take):
    ingest.create(take)
    batch = encode_batch(GLOVE, glove_batch(0, 4), number=0)
    ingest.put_batch("take-1", "glove_left", 0, batch)
    return batch


def is_gone(store):
    uploads = store.root / ".uploads"
    return not store.list(kind="recording") and not any(uploads.iterdir())


@pytest.mark.parametrize("step", ["create", "put_batch", "finish"])
def test_every_step_of_an_upload_is_refused_after_the_deletion(store, settings, take, delete, step):
    ingest = Ingest(store, settings)
    batch = begin(ingest, take)
    delete()
    steps = {
        "create": lambda: ingest.create(take),
        "put_batch": lambda: ingest.put_batch("take-1", "glove_left", 1, batch),
        "finish": lambda: ingest.finish("take-1", ALL),
    }
    with pytest.raises(ConflictError) as refused:
        steps[step]()
    assert refused.value.details["reason"] == "take_deleted"
    ended = []
    deletion_watch(DeletionRecords(store.root), ingest.drop_deleted, ended.append)()
    assert ended == ["take-1"]
    assert is_gone(store)
    assert delete().complete


def test_a_deletion_during_the_commit_leaves_no_recording(store, settings, take, delete):
    def commit(spool, attributes, content):
        counts = commit_spool(store, spool, attributes, content)
        # What the deletion finds is too late: it is committed after the search.
        (store.root / "recordings" / "take-1").rename(store.root / "hidden")
        delete()
        (store.root / "hidden").rename(store.root / "recordings" / "take-1")
        return counts

    ingest = Ingest(store, settings, commit=commit)
    begin(ingest, take)
    with pytest.raises(ConflictError, match="deleted permanently"):
        ingest.finish("take-1", ALL)
    ingest.drop_deleted()
    assert is_gone(store)
    assert list((store.root / ".trash").glob("*")) == []


def test_other_uploads_go_on(store, settings, attributes, delete):
    ingest = Ingest(store, settings)
    begin(ingest, attributes.model_copy(update={"operator": "other"}))
    delete()
    assert ingest.drop_deleted() == []
    assert ingest.finish("take-1", ALL).state == "finished"
    assert store.list(kind="recording") == ["take-1"]


def test_a_problem_that_comes_back_is_logged_again():
    """The same failure twice in a row is one warning; after a look that succeeded it is another."""
    looks = iter(["full", "full", None, "full"])

    def look():
        reason = next(looks, "")
        if reason == "":
            watch._stopping.set()
        elif reason is not None:
            raise StorageError(reason)

    watch = PeriodicThread("fail_deletions", 0.0, look)
    with capture_logs() as logs:
        watch.start()
        watch._thread.join()
    assert [(one["event"], one["reason"]) for one in logs] == [("fail_deletions", "full")] * 2
