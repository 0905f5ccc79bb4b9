"""Commits in a process of their own: the same recordings, its errors, and its death on the way."""

import os
import signal

import pytest

from dextouch.episodes import ContentDigest, EpisodeStore
from dextouch.errors import ConflictError, CorruptDataError, UnavailableError
from dextouch.schemas import FinishRecording
from dextouch.streams import encode_batch
from services.episode_store.committing import CommitProcess
from services.episode_store.ingest import Ingest

COUNTS = FinishRecording(num_batches={"glove_left": 1, "wrist_left": 0}, success=True)


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
def commit(settings):
    ours = CommitProcess(settings.store_url)
    yield ours
    ours.close()


@pytest.fixture
def ingest(store, settings, commit, attributes, batch_of):
    ours = Ingest(store, settings, commit=commit)
    for name in ("take-1", "take-2"):
        take = attributes.model_copy(update={"recording_id": name})
        ours.create(take)
        ours.put_batch(
            name, "glove_left", 0, encode_batch(take.streams[0], batch_of(0, 600), number=0)
        )
    yield ours
    ours.close()


def test_the_same_recording_comes_out(ingest, store, commit, batch_of):
    assert ingest.finish("take-1", COUNTS).state == "finished"
    child = commit._child
    assert ingest.finish("take-2", COUNTS).state == "finished"
    assert commit._child is child
    for name in ("take-1", "take-2"):
        recording = store.recording(name)
        recording.verify()
        assert recording.attributes.success is True
        assert recording.read("glove_left").sequence.tolist() == list(range(600))
    commit.close()
    assert child.close() == 0


def test_its_errors_are_ours(ingest, store):
    log = store.root / ".uploads" / "take-1" / "batches.log"
    data = bytearray(log.read_bytes())
    data[5000] ^= 1
    log.write_bytes(bytes(data))
    with pytest.raises(CorruptDataError, match="log of spool 'take-1'"):
        ingest.finish("take-1", COUNTS)
    assert not store.exists("take-1", kind="recording")
    assert ingest.finish("take-2", COUNTS).state == "finished"


def test_it_commits_only_what_was_announced(ingest, store, attributes, batch_of):
    digests = {s.name: ContentDigest(s) for s in attributes.streams}
    digests["glove_left"].add(batch_of(0, 600))
    content = {name: digest.content() for name, digest in digests.items()}
    wrong = content | {"glove_left": content["glove_left"].model_copy(update={"sha256": "0" * 64})}
    with pytest.raises(ConflictError, match="glove_left has 600 samples") as refused:
        ingest.finish("take-1", COUNTS.model_copy(update={"content": wrong}))
    assert refused.value.details["glove_left"]["expected"]["sha256"] == "0" * 64
    assert not store.exists("take-1", kind="recording")
    got = ingest.finish("take-1", COUNTS.model_copy(update={"content": content}))
    assert got.content == content


@pytest.mark.long
def test_its_death_is_survived(ingest, store, commit):
    ingest.finish("take-1", COUNTS)
    child = commit._child._process
    # It dies with the next order in its hands.
    os.kill(child.pid, signal.SIGSTOP)
    child.stdin.flush()
    os.kill(child.pid, signal.SIGKILL)
    with pytest.raises(UnavailableError, match="died") as caught:
        _order_before_the_death_is_seen(ingest, child)
    assert caught.value.details["retry_after_s"] == 1
    assert not store.exists("take-2", kind="recording")
    assert ingest.finish("take-2", COUNTS).state == "finished"
    assert store.recording("take-2").num_samples("glove_left") == 600


def _order_before_the_death_is_seen(ingest, child):
    seen = child.poll
    child.poll = lambda: None
    try:
        ingest.finish("take-2", COUNTS)
    finally:
        child.poll = seen


def test_it_ends_with_the_service(commit, ingest):
    ingest.finish("take-1", COUNTS)
    child = commit._child._process
    child.stdin.close()
    assert child.wait(timeout=30) == 0
    assert child.stdout.read() == b""
    child.stdout.close()
