"""Uploads: exactly once whatever is repeated, lost or killed between; gaps and changes refused."""

import shutil
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NotFoundError,
    PacketError,
    StorageFullError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.schemas import FinishRecording, LedgerEntry
from dextouch.streams import SampleBatch, encode_batch
from services.episode_store import ingest as ingest_module
from services.episode_store.committing import commit_spool
from services.episode_store.ingest import Ingest
from tests.unit.episodes.spooled_batches import GOLDEN, golden_batch


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
def ingest(store, settings):
    ours = Ingest(store, settings.model_copy(update={"max_open_uploads": 2}))
    yield ours
    ours.close()


@pytest.fixture
def send(attributes, batch_of):
    """Send glove batch n, five samples each."""

    def sender(ingest, number):
        data = encode_batch(attributes.streams[0], batch_of(5 * number, 5), number=number)
        return ingest.put_batch(attributes.recording_id, "glove_left", number, data)

    return sender


def finish(ingest, num_batches, **more):
    counts = {"glove_left": num_batches, "wrist_left": 0}
    return ingest.finish("take-1", FinishRecording(num_batches=counts, **more))


def assert_complete(store, batch_of, count):
    got = store.recording("take-1").read("glove_left")
    expected = batch_of(0, count)
    np.testing.assert_array_equal(got.values, expected.values)
    np.testing.assert_array_equal(got.t_host_ns, expected.t_host_ns)
    np.testing.assert_array_equal(got.t_device_ns, expected.t_device_ns)
    np.testing.assert_array_equal(got.sequence, expected.sequence)


def test_a_whole_upload(ingest, store, attributes, send, batch_of):
    status = ingest.create(attributes)
    assert status.next_batch == {"glove_left": 0, "wrist_left": 0}
    receipts = [send(ingest, number) for number in range(3)]
    assert [r.num_samples for r in receipts] == [5, 5, 5]
    assert not any(r.replayed for r in receipts)
    ledger = (LedgerEntry(stream="glove_left", event="dropped", count=2),)
    assert finish(ingest, 3, ledger=ledger, success=True).state == "finished"
    assert_complete(store, batch_of, 15)
    reader = store.recording("take-1")
    reader.verify()
    assert reader.attributes.ledger == ledger
    assert reader.attributes.success is True
    assert reader.num_samples("wrist_left") == 0
    assert not (store.root / ".uploads" / "take-1").exists()


def test_repeats_change_nothing(ingest, store, attributes, send, batch_of):
    ingest.create(attributes)
    send(ingest, 0)
    assert ingest.create(attributes).next_batch["glove_left"] == 1
    assert send(ingest, 0).replayed
    send(ingest, 1)
    assert send(ingest, 0).num_samples == 5
    finish(ingest, 2)
    finish(ingest, 2)
    assert ingest.create(attributes).state == "finished"
    assert ingest.status("take-1").state == "finished"
    assert_complete(store, batch_of, 10)


def test_an_upload_that_an_earlier_process_began_goes_on(ingest, store):
    shutil.copytree(GOLDEN / "spool_v2", store.root / ".uploads" / "take-1")
    streams = SpoolReader(store.root / ".uploads" / "take-1").streams
    for name, stream in streams.items():
        assert ingest.status("take-1").next_batch[name] == 3
        again = encode_batch(stream, golden_batch(stream, 1, 3), number=1)
        assert ingest.put_batch("take-1", name, 1, again).replayed
        other = encode_batch(stream, golden_batch(stream, 2, 3), number=1)
        with pytest.raises(ConflictError, match="other samples"):
            ingest.put_batch("take-1", name, 1, other)
        data = encode_batch(stream, golden_batch(stream, 6, 2), number=3)
        assert not ingest.put_batch("take-1", name, 3, data).replayed
    spool = SpoolReader(store.root / ".uploads" / "take-1")
    for name, stream in streams.items():
        expected = golden_batch(stream, 0, 8)
        for field in ("t_host_ns", "t_device_ns", "sequence", "values"):
            found = getattr(spool.read(name), field)
            np.testing.assert_array_equal(found, getattr(expected, field))


def test_gaps_changes_and_strangers_are_refused(ingest, attributes, send, batch_of):
    with pytest.raises(NotFoundError):
        send(ingest, 0)
    ingest.create(attributes)
    send(ingest, 0)
    with pytest.raises(ConflictError, match="got batch 2, expected 1") as caught:
        send(ingest, 2)
    assert caught.value.details == {"got": 2, "expected": 1}
    other = encode_batch(attributes.streams[0], batch_of(1, 5), number=0)
    with pytest.raises(ConflictError, match="other samples"):
        ingest.put_batch("take-1", "glove_left", 0, other)
    with pytest.raises(UnknownNameError, match="wrist_left"):
        ingest.put_batch("take-1", "glove", 0, other)
    with pytest.raises(PacketError):
        ingest.put_batch("take-1", "glove_left", 1, other[:-1])
    with pytest.raises(InvalidInputError, match="batch 0 of stream"):
        ingest.put_batch("take-1", "glove_left", 1, other)
    with pytest.raises(ConflictError, match="other attributes"):
        ingest.create(attributes.model_copy(update={"task": "stack_bowls"}))
    with pytest.raises(InvalidInputError):
        ingest.status("../take-1")
    # Nothing of all this counted.
    assert ingest.status("take-1").next_batch["glove_left"] == 1


def test_only_complete_uploads_finish(ingest, store, attributes, send):
    ingest.create(attributes)
    with pytest.raises(InvalidInputError, match="without a sample"):
        finish(ingest, 0)
    send(ingest, 0)
    with pytest.raises(ConflictError, match="glove_left has 1 of 2 batches"):
        finish(ingest, 2)
    with pytest.raises(ConflictError, match="glove_left has 1 of 0 batches"):
        finish(ingest, 0)
    with pytest.raises(InvalidInputError, match="announce 0"):
        ingest.finish("take-1", FinishRecording(num_batches={"glove_left": 1}))
    with pytest.raises(InvalidInputError, match="without a stream"):
        ingest.create(attributes.model_copy(update={"recording_id": "empty", "streams": ()}))
    assert store.list(kind="recording") == []
    finish(ingest, 1)
    with pytest.raises(ConflictError, match="finished"):
        send(ingest, 1)


def test_a_restart_keeps_what_was_acknowledged(store, settings, attributes, send, batch_of):
    first = Ingest(store, settings)
    first.create(attributes)
    send(first, 0)
    first.close()
    second = Ingest(store, settings)
    assert second.status("take-1").next_batch == {"glove_left": 1, "wrist_left": 0}
    assert send(second, 0).replayed
    send(second, 1)
    finish(second, 2)
    assert_complete(store, batch_of, 10)


def test_a_crash_before_the_answer_counts_once(
    store, settings, attributes, send, batch_of, monkeypatch
):
    first = Ingest(store, settings)
    first.create(attributes)
    send(first, 0)
    with monkeypatch.context() as patch:
        # The process dies after the samples were spooled and before the station hears of it.
        patch.setattr(ingest_module, "BatchReceipt", _die)
        with pytest.raises(KeyboardInterrupt):
            send(first, 1)
    first.close()
    second = Ingest(store, settings)
    assert second.status("take-1").next_batch["glove_left"] == 2
    assert send(second, 1).replayed
    finish(second, 2)
    assert_complete(store, batch_of, 10)


def _die(*_args, **_kwargs):
    raise KeyboardInterrupt


def test_a_crash_after_the_commit_is_finished_by_repeating(
    store, settings, attributes, send, batch_of, monkeypatch
):
    first = Ingest(store, settings)
    first.create(attributes)
    send(first, 0)
    with monkeypatch.context() as patch:
        patch.setattr(ingest_module.shutil, "rmtree", _die)
        with pytest.raises(KeyboardInterrupt):
            finish(first, 1)
    second = Ingest(store, settings)
    finish(second, 1)
    assert_complete(store, batch_of, 5)
    assert not (store.root / ".uploads" / "take-1").exists()


@pytest.mark.parametrize("is_there", [True, False])
def test_a_commit_in_conflict_is_a_success_only_if_the_recording_is_there(
    store, settings, attributes, send, batch_of, is_there
):
    """It is there if the commit process of a service before completed it meanwhile."""

    def commit(path, finished, content):
        if is_there:
            commit_spool(store, path, finished, content)
        raise ConflictError("recording 'take-1': exists already")

    ingest = Ingest(store, settings, commit=commit)
    ingest.create(attributes)
    send(ingest, 0)
    if is_there:
        assert finish(ingest, 1).state == "finished"
        assert_complete(store, batch_of, 5)
        return
    with pytest.raises(ConflictError, match="exists already"):
        finish(ingest, 1)
    # What was acknowledged is still there, to be finished later.
    again = Ingest(store, settings)
    assert again.status("take-1").next_batch["glove_left"] == 1


def test_a_full_disk_refuses_the_batch_and_keeps_the_rest(
    ingest, store, attributes, send, batch_of, file_size_limit
):
    ingest.create(attributes)
    send(ingest, 0)
    with file_size_limit(5000), pytest.raises(StorageFullError):
        send(ingest, 1)
    assert ingest.status("take-1").next_batch["glove_left"] == 1
    send(ingest, 1)
    finish(ingest, 2)
    assert_complete(store, batch_of, 10)


def test_an_upload_that_goes_on_is_not_dropped(ingest, attributes, send):
    """Something may come between the list of stale uploads and their end."""
    ingest.create(attributes)
    send(ingest, 0)
    assert not ingest.expire("take-1", idle_s=3600.0)
    assert send(ingest, 1).num_samples == 5
    assert ingest.expire("take-1", idle_s=0.0)
    assert not ingest.expire("take-1", idle_s=0.0)


def test_many_uploads_share_few_open_files(ingest, store, attributes, send, batch_of):
    for index in range(5):
        ingest.create(attributes.model_copy(update={"recording_id": f"take-{index}"}))
    assert len(ingest._open) == 2
    for number in range(2):
        for index in range(5):
            data = encode_batch(attributes.streams[0], batch_of(5 * number, 5), number=number)
            ingest.put_batch(f"take-{index}", "glove_left", number, data)
    finish(ingest, 2)
    assert_complete(store, batch_of, 10)


def spool_of(path, attributes, batch_of, count):
    with SpoolWriter(path, attributes, sync=False) as writer:
        writer.append("glove_left", batch_of(0, count))
        k = np.arange(3)
        writer.append("wrist_left", SampleBatch(k, k, k, np.ones((3, 7))))
    return SpoolReader(path)


def test_the_same_batches_from_many_threads_count_once(ingest, store, attributes, batch_of):
    names = [f"take-{index}" for index in range(3)]
    for name in names:
        ingest.create(attributes.model_copy(update={"recording_id": name}))

    def send_all(name):
        replayed = 0
        for number in range(6):
            data = encode_batch(attributes.streams[0], batch_of(5 * number, 5), number=number)
            replayed += ingest.put_batch(name, "glove_left", number, data).replayed
        return replayed

    with ThreadPoolExecutor(9) as pool:
        replayed = list(pool.map(send_all, names * 3))
    assert sum(replayed) == 2 * 6 * 3
    finish(ingest, 6)
    assert_complete(store, batch_of, 30)


def upload(client, spool):
    """What a station does: ask where the upload stands, send the rest, finish."""
    status = client.create(spool.attributes)
    num_batches = {}
    for name, descriptor in spool.streams.items():
        total = spool.num_samples(name)
        num_batches[name] = -(-total // 60)
        if status.state == "open":
            for number in range(status.next_batch[name], num_batches[name]):
                batch = spool.read(name, 60 * number, min(60 * number + 60, total))
                client.send_batch("take-1", descriptor, batch, number=number)
    return client.finish("take-1", num_batches)


def test_an_upload_broken_anywhere_ends_without_duplicates(
    start, settings, attributes, batch_of, tmp_path
):
    """The connection breaks before or after each request in turn; the station just tries again."""
    spool = spool_of(tmp_path / "spool", attributes, batch_of, 150)
    client, attempts = start(), 0
    whole = client._http._transport
    for broken_request in range(6):
        for answered in (False, True):
            client._http._transport = Breaking(whole, broken_request, answered)
            attempts += 1
            try:
                upload(client, spool)
            except UnavailableError:
                continue
    assert attempts == 12
    client._http._transport = whole
    assert upload(client, spool).state == "finished"
    assert_complete(EpisodeStore(settings.store_url), batch_of, 150)


class Breaking:
    """A transport that loses the n-th request, or its answer."""

    def __init__(self, inner, number, answered):
        self.inner, self.left, self.answered = inner, number, answered

    def handle_request(self, request):
        self.left -= 1
        if self.left == -1:
            if self.answered:
                self.inner.handle_request(request)
            raise httpx.ReadError("connection lost")
        return self.inner.handle_request(request)

    def close(self):
        self.inner.close()


@pytest.mark.long
def test_forty_stations_at_once_read_no_log_again(start, attributes, batch_of, monkeypatch):
    """With its files closed in between, each batch would cost a reading of all before it."""
    read_again = []
    real = SpoolWriter.resume
    monkeypatch.setattr(
        SpoolWriter, "resume", lambda path, **how: read_again.append(path) or real(path, **how)
    )
    client = start()
    names = [f"take-{n}" for n in range(40)]
    for name in names:
        client.create(attributes.model_copy(update={"recording_id": name}))
    for number in range(2):
        for name in names:
            client.send_batch(name, attributes.streams[0], batch_of(number, 1), number=number)
    assert read_again == []
