"""A worker process: reports and problems come back, and a killed one takes one recording along."""

import os
import signal
import threading

import psutil
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, UnavailableError
from services.alignment.command_line import align_batch, not_aligned
from services.alignment.jobs import AlignmentWorker
from services.alignment.settings import AlignmentOptions
from tests.unit.alignment.recordings import write_recording

OPTIONS = AlignmentOptions()


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_recording(store, "take")
    write_recording(store, "other")
    write_recording(store, "handless", streams=("head",))
    return store


@pytest.fixture
def no_process_is_left():
    """Of those that the test starts; other tests of this run may keep theirs."""
    before = set(psutil.Process().children())
    yield
    assert set(psutil.Process().children()) <= before


@pytest.mark.long
@pytest.mark.usefixtures("no_process_is_left")
def test_one_process_aligns_refuses_dies_and_is_replaced(store):
    worker = AlignmentWorker(str(store.root))
    try:
        told = []
        report = worker.run("take", OPTIONS, told.append)
        assert store.list() == [report.episode_id]
        assert told
        assert told[0].stage == "dating"
        pid = worker._child.pid
        with pytest.raises(InvalidInputError, match="wrist_left"):
            worker.run("handless", OPTIONS, told.append)
        assert worker._child.pid == pid

        def kill_it(_):
            os.kill(worker._child.pid, signal.SIGKILL)

        with pytest.raises(UnavailableError, match=r"'other'.*killed.*ask for it again"):
            worker.run("other", OPTIONS, kill_it)
        assert len(store.list()) == 1
        assert worker.run("other", OPTIONS, told.append).created
        assert worker._child.pid != pid
    finally:
        worker.stop()
    assert worker._child is None


@pytest.mark.long
def test_stopping_from_another_thread_ends_it_at_once(store):
    worker = AlignmentWorker(str(store.root))
    worker.start()
    process = psutil.Process(worker._child.pid)
    process.suspend()
    failed = []

    def run():
        try:
            worker.run("take", OPTIONS, lambda _: None)
        except UnavailableError as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    worker.stop()
    thread.join(30)
    # Stopped before or after the order reached it: a fresh process may have taken it.
    worker.stop()
    assert not thread.is_alive()
    assert failed or store.list()
    assert store.sweep() == 0


@pytest.mark.long
@pytest.mark.usefixtures("no_process_is_left")
def test_many_recordings_side_by_side(store):
    wanted, impossible = not_aligned(store, OPTIONS)
    assert (wanted, [recording_id for recording_id, _ in impossible]) == (
        ["other", "take"],
        ["handless"],
    )
    found = dict(
        align_batch(
            str(store.root),
            [*wanted, "handless"],
            OPTIONS,
            num_workers=2,
            on_progress=lambda *_: None,
        )
    )
    assert set(found) == {"take", "other", "handless"}
    assert "wrist_left" in found["handless"].message
    assert found["take"].created
    assert not_aligned(store, OPTIONS)[0] == []
