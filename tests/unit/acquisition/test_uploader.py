import errno
import os
import shutil
import socket
import threading
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from structlog.testing import capture_logs

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError, StorageFullError, UnavailableError
from dextouch.schemas import BatchReceipt, RecordingAttributes, RecordingStatus
from dextouch.streams import SampleBatch, StreamDescriptor, decode_batch
from services.acquisition import uploader as uploader_module
from services.acquisition.settings import Retention
from services.acquisition.uploader import (
    UPLOADED_FILE,
    Uploader,
    batch_samples,
    recover_spool,
    second_id,
)

STREAMS = tuple(
    StreamDescriptor(
        name=name, kind="pose", shape=(7,), dtype="float64", unit="pose_m_wxyz", nominal_rate_hz=100
    )
    for name in ("head", "wrist_left")
)


def spool(root, name="take", count=270, *, streams=STREAMS, close=True):
    attributes = RecordingAttributes(
        recording_id=name, task="t", instruction="i", domain="human", station="s", streams=STREAMS
    )
    writer = SpoolWriter(root / name, attributes)
    stamps = np.arange(count, dtype=np.int64)
    for stream in streams:
        values = np.arange(count * 7.0).reshape(count, 7)
        writer.append(stream.name, SampleBatch(stamps, stamps, stamps, values))
    if close:
        writer.close()
    else:
        writer.abandon()
    return root / name


class FakeStore(EpisodeStoreClient):
    """Keeps batches like the store, and fails when told to."""

    def __init__(self):
        self.batches = {}
        self.finished = {}
        self.replies_until_failure = None
        self.is_closed = False

    def close(self):
        self.is_closed = True

    def _reply(self):
        if self.replies_until_failure is not None:
            if self.replies_until_failure == 0:
                raise UnavailableError("store: no answer")
            self.replies_until_failure -= 1

    def create(self, attributes):
        self._reply()
        self.batches.setdefault(attributes.recording_id, {s.name: [] for s in attributes.streams})
        return self._status(attributes.recording_id)

    def send_batch(self, recording_id, descriptor, batch, *, number):
        self._reply()
        batch = decode_batch(batch, descriptor, number=number)
        kept = self.batches[recording_id][descriptor.name]
        assert number == len(kept), "batch sent twice or out of order"
        kept.append(batch)
        return BatchReceipt(
            recording_id=recording_id,
            stream=descriptor.name,
            number=number,
            num_samples=len(batch),
            replayed=False,
        )

    def finish(self, recording_id, num_batches, *, success=None, ledger=(), content=None):
        self._reply()
        assert num_batches == {n: len(b) for n, b in self.batches[recording_id].items()}
        counts = {n: sum(map(len, b)) for n, b in self.batches[recording_id].items()}
        assert {n: one.num_samples for n, one in content.items()} == counts
        self.finished[recording_id] = (success, ledger)
        return self._status(recording_id).model_copy(update={"content": content})

    def _status(self, recording_id):
        return RecordingStatus(
            recording_id=recording_id,
            state="finished" if recording_id in self.finished else "open",
            next_batch={n: len(b) for n, b in self.batches[recording_id].items()},
        )

    def samples(self, recording_id, stream):
        return np.concatenate([b.values for b in self.batches[recording_id][stream]])


@pytest.mark.long
@pytest.mark.parametrize("failure", range(8))
def test_every_interruption_is_made_up_for(tmp_path, failure):
    path = spool(tmp_path)
    store = FakeStore()
    store.replies_until_failure = failure
    uploader = Uploader(tmp_path, store, period_s=1.0)
    assert uploader.upload_all() == []
    assert not (path / UPLOADED_FILE).exists()
    (status,) = uploader.status()
    assert (status.uploaded, status.error) == (False, "store: no answer")
    store.replies_until_failure = None
    assert Uploader(tmp_path, store, period_s=1.0).upload_all() == ["take"]
    for stream in STREAMS:
        expected = SpoolReader(path).read(stream.name).values
        np.testing.assert_array_equal(store.samples("take", stream.name), expected)
    assert uploader.upload_all() == []
    assert uploader.status()[0].uploaded


class DyingStore(FakeStore):
    """A store that dies at random moments: before it has done what was asked, or right after."""

    def __init__(self, rng, probability):
        super().__init__()
        self.rng, self.probability, self.deaths = rng, probability, 0

    def _die_or(self, action):
        if self.rng.random() < self.probability:
            self.deaths += 1
            if self.rng.random() < 0.5:
                action()
            raise UnavailableError("store: connection lost")
        return action()

    def create(self, attributes):
        return self._die_or(lambda: super(DyingStore, self).create(attributes))

    def send_batch(self, recording_id, descriptor, batch, *, number):
        send = super().send_batch
        return self._die_or(lambda: send(recording_id, descriptor, batch, number=number))

    def finish(self, recording_id, num_batches, *, success=None, ledger=(), content=None):
        finish = super().finish
        return self._die_or(
            lambda: finish(
                recording_id, num_batches, success=success, ledger=ledger, content=content
            )
        )


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 10))]
)
def test_a_store_that_dies_at_random_moments_gets_everything_once(tmp_path, seed):
    names = ["a", "b", "c"]
    paths = {name: spool(tmp_path, name) for name in names}
    store = DyingStore(np.random.default_rng(seed), 0.4)
    done = []
    for _ in range(500):
        # Each time another process of the station.
        done += Uploader(tmp_path, store, period_s=1.0).upload_all()
        if len(done) == len(names):
            break
    assert sorted(done) == names
    assert store.deaths > 0
    for name, path in paths.items():
        for stream in STREAMS:
            expected = SpoolReader(path).read(stream.name).values
            np.testing.assert_array_equal(store.samples(name, stream.name), expected)


def test_a_full_disk_does_not_end_the_uploads(tmp_path, monkeypatch):
    path = spool(tmp_path)
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=1.0)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "writev", full)
    assert uploader.upload_all() == []
    monkeypatch.undo()
    assert "no space left" in uploader.status()[0].error
    assert uploader.upload_all() == ["take"]
    assert (path / UPLOADED_FILE).exists()


def test_open_takes_wait(tmp_path):
    spool(tmp_path, close=False)
    store = FakeStore()
    assert Uploader(tmp_path, store, period_s=1.0).upload_all() == []
    assert store.batches == {}


def test_uploaded_takes_are_removed_when_asked(tmp_path):
    path = spool(tmp_path)
    limits = Retention(keep_uploaded_days=0)
    uploader = Uploader(tmp_path, FakeStore(), period_s=1.0, retention=limits)
    uploader.upload_all()
    uploader.retention.sweep()
    assert not path.exists()


def test_one_refused_take_does_not_hold_up_the_next(tmp_path):
    spool(tmp_path, "a")
    spool(tmp_path, "b")
    store = FakeStore()
    create = store.create

    def refuse_a(attributes):
        if attributes.recording_id == "a":
            raise ConflictError("a: exists with other attributes")
        return create(attributes)

    store.create = refuse_a
    uploader = Uploader(tmp_path, store, period_s=1.0)
    assert uploader.upload_all() == ["b"]
    assert [status.error for status in uploader.status()] == [
        "a: exists with other attributes",
        None,
    ]


@pytest.fixture
def refusing(tmp_path):
    """An uploader of takes `b` and `c`, whose store has refused both for good."""
    for name in ("b", "c"):
        spool(tmp_path, name)
    store = FakeStore()

    def refuse(attributes):
        if attributes.recording_id == "a":
            raise StorageFullError("store: full", retry_after_s=60)
        raise ConflictError(f"{attributes.recording_id}: exists with other attributes")

    store.create = refuse
    uploader = Uploader(tmp_path, store, period_s=1.0)
    for _ in range(3):
        uploader.upload_all()
    return uploader


def test_while_the_store_is_away_one_take_at_a_time_is_read_and_each_has_its_turn(
    tmp_path, monkeypatch
):
    """Reading the logs of a day of takes again and again would hold up what is recorded."""
    for name in "abc":
        spool(tmp_path, name)
    scanned, scan = [], SpoolReader.scan

    def counted(self):
        scanned.append(self.path.name)
        return scan(self)

    monkeypatch.setattr(SpoolReader, "scan", counted)
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=1.0)
    store.replies_until_failure = 0
    for _ in range(4):
        assert uploader.upload_all() == []
    assert scanned == list("abca")
    store.replies_until_failure = None
    assert uploader.upload_all() == list("bca")


def test_only_refusals_in_a_row_set_a_take_aside(tmp_path):
    """Three of them, since one may be a passing one; a store that is away refuses nothing."""
    spool(tmp_path)
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=1.0)

    def refused_after(error, count):
        def fail(_):
            raise error("take: no")

        store.create = fail
        for _ in range(count):
            uploader.upload_all()
        return listed(uploader) == ["take"]

    assert not refused_after(UnavailableError, 10)
    assert not refused_after(ConflictError, 2)
    assert not refused_after(UnavailableError, 1)
    assert not refused_after(ConflictError, 2)
    assert refused_after(ConflictError, 1)


def listed(uploader):
    return [status.recording_id for status in uploader.status(only_refused=True)]


REASONS = {name: f"{name}: exists with other attributes" for name in ("b", "c")}


def test_a_take_is_listed_as_refused_from_when_it_is_set_aside_until_it_is_sent_again(refusing):
    assert (refusing.refused, listed(refusing)) == (REASONS, ["b", "c"])
    refusing.retry("b")
    assert (refusing.refused, listed(refusing)) == ({"c": REASONS["c"]}, ["c"])


def test_refused_takes_stay_listed_while_the_store_is_full_and_after_a_restart(refusing, tmp_path):
    refusing.upload_all()
    spool(tmp_path, "a")
    refusing.upload_all()
    assert (refusing.refused, listed(refusing)) == (REASONS, ["b", "c"])
    restarted = Uploader(tmp_path, None, period_s=1.0)
    assert (restarted.refused, listed(restarted)) == (REASONS, ["b", "c"])


def test_takes_whose_folder_is_removed_by_hand_are_left_out(refusing, tmp_path, monkeypatch):
    refusing.upload_all()
    shutil.rmtree(tmp_path / "b")
    assert (list(refusing.refused), listed(refusing)) == (["c"], ["c"])
    # Removed while the list is being made.
    paths = [tmp_path / "b", tmp_path / "c"]
    monkeypatch.setattr(uploader_module, "spooled_takes", lambda _: iter(paths))
    assert [status.recording_id for status in refusing.status()] == ["c"]


def test_a_second_id_is_valid_and_of_one_take_alone():
    takes = [
        RecordingAttributes(
            recording_id=name, task="t", instruction="i", domain="human", station=station
        )
        for name in ("take", "take-1", "t" * 128)
        for station in ("Desk 1", "Desk 2")
    ]
    ids = [second_id(take) for take in takes]
    assert ids == [second_id(take.model_copy()) for take in takes]
    assert len(set(ids)) == len(takes)
    # The next take of the same station and name is another one, by whichever of its clocks.
    start = datetime(2026, 5, 4, 12, tzinfo=UTC)
    starts = [(start, 5), (start + timedelta(seconds=1), 5), (start, 6), (None, 5), (start, None)]
    repeated = [
        takes[0].model_copy(update={"started_at": at, "started_t_host_ns": t_host_ns})
        for at, t_host_ns in starts
    ]
    assert len({ids[0], *map(second_id, repeated)}) == 1 + len(starts)
    for take, other in zip(takes, ids, strict=True):
        # As an id, it is checked against the pattern of the store.
        renamed = RecordingAttributes.model_validate(take.model_dump() | {"recording_id": other})
        assert renamed.recording_id.startswith(take.recording_id[:100])


def test_thread_uploads_and_stops(tmp_path):
    spool(tmp_path)
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=0.01)
    uploader.start()
    while not (tmp_path / "take" / UPLOADED_FILE).exists():
        uploader._stopping.wait(0.005)
    assert not store.is_closed
    uploader.stop()
    assert "take" in store.finished
    assert store.is_closed


def test_a_mistake_does_not_end_the_uploads(tmp_path, monkeypatch):
    uploader = Uploader(tmp_path, FakeStore(), period_s=0.01)
    monkeypatch.setattr(uploader.retention, "sweep", lambda: 1 / 0)
    uploader.start()
    for name in ("a", "b"):
        spool(tmp_path, name)
        while not (tmp_path / name / UPLOADED_FILE).exists():
            assert uploader._thread.is_alive()
            uploader._stopping.wait(0.005)
    uploader.stop()


def test_a_mistake_with_one_take_keeps_no_other_here(tmp_path, monkeypatch):
    for name in ("a", "b"):
        spool(tmp_path, name)
    store, create = FakeStore(), FakeStore.create

    def begin(self, attributes):
        if attributes.recording_id == "a":
            raise KeyError("offset")
        return create(self, attributes)

    monkeypatch.setattr(FakeStore, "create", begin)
    uploader = Uploader(tmp_path, store, period_s=1.0)
    with capture_logs() as logs:
        assert uploader.upload_all() == ["b"]
        assert uploader.upload_all() == []
    assert [(log["event"], log["recording_id"]) for log in logs if log["log_level"] == "error"] == [
        ("fail_upload", "a")
    ]
    assert "KeyError('offset')" in uploader.status_of("a").error
    monkeypatch.setattr(FakeStore, "create", create)
    assert uploader.upload_all() == ["a"]
    assert uploader.status_of("a").error is None


def test_space_is_made_though_the_uploads_fail(tmp_path, monkeypatch):
    uploader, swept = Uploader(tmp_path, FakeStore(), period_s=0.01), threading.Event()
    monkeypatch.setattr(uploader, "upload_all", lambda: 1 / 0)
    monkeypatch.setattr(uploader.retention, "sweep", swept.set)
    uploader.start()
    assert swept.wait(10)
    uploader.stop()


def test_a_store_is_asked_again_after_an_hour_at_most(tmp_path, monkeypatch):
    def refuse(_):
        raise UnavailableError("store: away", retry_after_s=10**12)

    spool(tmp_path)
    store = FakeStore()
    monkeypatch.setattr(store, "create", refuse)
    uploader = Uploader(tmp_path, store, period_s=1.0)
    assert uploader.upload_all() == []
    assert uploader._retry_after_s == 3600.0


def test_no_connection_outlives_the_uploads(tmp_path):
    spool(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        uploader = Uploader(tmp_path, EpisodeStoreClient(url), period_s=60.0)
        uploader.start()
        connection, _ = server.accept()
        with connection:
            connection.settimeout(10)
            while b'"take"' not in connection.recv(2**16):
                pass
            connection.sendall(b"HTTP/1.1 503 Busy\r\ncontent-length: 0\r\n\r\n")
            uploader.stop()
            assert connection.recv(1) == b""


def test_recovery_closes_what_was_left_open(tmp_path):
    spool(tmp_path, "left", close=False)
    spool(tmp_path, "empty", count=0, close=False)
    # The other tracker had not sent anything yet.
    spool(tmp_path, "only_head", streams=STREAMS[:1], close=False)
    spool(tmp_path, "whole")
    assert recover_spool(tmp_path) == ["left", "only_head"]
    assert SpoolReader(tmp_path / "only_head").num_samples("head") == 270
    left = SpoolReader(tmp_path / "left")
    assert left.closed
    assert {(e.stream, e.event) for e in left.attributes.ledger} == {
        ("head", "interrupted"),
        ("wrist_left", "interrupted"),
    }
    assert not (tmp_path / "empty").exists()
    assert SpoolReader(tmp_path / "whole").attributes.ledger == ()
    assert recover_spool(tmp_path) == []
    assert recover_spool(tmp_path / "nowhere") == []


def test_batches_of_large_images_are_small():
    image = STREAMS[0].model_copy(update={"shape": (480, 640, 3), "dtype": "uint8"})
    assert batch_samples(image) == 9
    assert batch_samples(STREAMS[0]) == 120


def test_a_note_that_cannot_be_read_does_not_end_the_uploads(tmp_path):
    # As on a bad sector, or of another user.
    (spool(tmp_path, "a") / UPLOADED_FILE).mkdir()
    spool(tmp_path, "b")
    uploader = Uploader(tmp_path, FakeStore(), period_s=1.0)
    assert uploader.upload_all() == ["b"]
    assert "note the upload of 'a'" in uploader.status()[0].error
    assert uploader.counts() == {"waiting": 1, "uploaded": 1, "refused": 0}


def test_a_damaged_take_does_not_keep_the_others(tmp_path):
    damaged = spool(tmp_path, "damaged", close=False)
    (damaged / "recording.json").write_text("{")
    spool(tmp_path, "left", close=False)
    assert recover_spool(tmp_path) == ["left"]
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=1.0)
    assert uploader.upload_all() == ["left"]
    damaged_status, left_status = uploader.status()
    assert "damaged" in damaged_status.error
    assert left_status.error is None
