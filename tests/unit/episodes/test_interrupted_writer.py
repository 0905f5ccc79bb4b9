"""Takes that an exception, a Ctrl-C, a kill or another writer breaks off: nothing is left."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.shards import ShardWriter
from dextouch.errors import ConflictError, StorageError, StorageFullError
from tests.unit.episodes.broken_takes import (
    CAMERA,
    FORCE,
    assert_nothing_left,
    break_off,
    record,
    record_17,
    take,
)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_nothing(store, error):
    break_off(store, record_17, FORCE, error=error)
    assert_nothing_left(store)
    # Its id is free.
    with store.writer(kind="recording", attributes=take(FORCE)) as writer:
        record_17(writer)
    assert store.recording("take-1").num_samples("force") == 17
    assert not store.recording("take-1").attributes.recovered


CHILD = """
import signal
import sys
import numpy as np
from dextouch.episodes import EpisodeStore
from dextouch.schemas.episodes import RecordingAttributes

# A shell that starts the tests in the background has them ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
attributes = RecordingAttributes.model_validate_json(sys.argv[2])
with EpisodeStore(sys.argv[1]).writer(kind="recording", attributes=attributes) as writer:
    number = 0
    while True:
        values = np.full((1, 2), number, "f4")
        writer.append("force", values=values, t_host_ns=np.array([number]))
        number += 1
        if number == 20_000:
            print("recording", flush=True)
            if sys.argv[3] == "waits":
                sys.stdin.read(1)
"""


@pytest.mark.long
@pytest.mark.parametrize("state", ["waits", "appends"])
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_ctrl_c_leaves_nothing_and_a_kill_what_a_sweep_removes(store, kind, state):
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(store.root), take(FORCE).model_dump_json(), state],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout.readline() == "recording\n"
        # That of a running writer is no one else's.
        assert store.sweep() == 0
        child.send_signal(kind)
        _, said = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode != 0
    if kind == signal.SIGINT:
        assert "KeyboardInterrupt" in said
    else:
        assert store.list(kind="recording") == []
        assert store.sweep() == 1
    assert_nothing_left(store)


def test_images_that_wait_for_their_encoder_are_dropped_and_its_thread_ends(store):
    def fill(writer):
        record(writer, 0, 3)
        for number in range(20):
            image = np.full((1, 48, 64, 3), 90, np.uint8)
            writer.append("camera", values=image, t_host_ns=np.array([number]))

    break_off(store, fill, FORCE, CAMERA)
    assert_nothing_left(store)
    names = [thread.name for thread in threading.enumerate()]
    assert not [name for name in names if name.startswith("encode-camera")]


real_append, real_write = ShardWriter.append, ShardWriter._write


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("write", range(1, 9))
def test_an_interrupt_inside_an_append_leaves_nothing(store, monkeypatch, write, before):
    """Ctrl-C before and after each write of a shard, of which a storage chunk of all has four."""
    calls = []

    def interrupted(self, data):
        calls.append(self._name)
        if len(calls) == write and before:
            raise KeyboardInterrupt
        real_write(self, data)
        if len(calls) == write:
            raise KeyboardInterrupt

    def fill(writer):
        for number in range(40):
            record(writer, number)

    with monkeypatch.context() as patch:
        patch.setattr(ShardWriter, "_write", interrupted)
        break_off(store, fill, FORCE, error=KeyboardInterrupt)
    assert len(calls) == write
    assert_nothing_left(store)


def test_what_follows_a_block_that_was_broken_off_is_refused(store, monkeypatch):
    """Else values and stamps of what follows would not belong together."""

    def full_once(self, data):
        if self._name == "force" and len(self._index) > 1 and not failed:
            failed.append(self._name)
            raise StorageFullError("no space left")
        real_write(self, data)

    def fill(writer):
        record(writer, 0, 9)
        with pytest.raises(StorageFullError):
            record(writer, 9)
        with pytest.raises(StorageError, match=r"force: .*interrupted.*leave the writer"):
            record(writer, 10)

    failed = []
    monkeypatch.setattr(ShardWriter, "_write", full_once)
    break_off(store, fill, FORCE)
    assert_nothing_left(store)


def test_a_take_with_a_block_broken_off_is_not_committed_as_if_whole(store, monkeypatch):
    monkeypatch.setattr(ShardWriter, "append", _fail_at_the_stamps)
    writer = store.writer(kind="recording", attributes=take(FORCE))
    with pytest.raises(RuntimeError, match="stamps"):
        record(writer, 0, 9)
    with pytest.raises(StorageError, match="interrupted"):
        writer.__exit__(None, None, None)
    # Of the values a storage chunk is there, of the stamps none.
    assert_nothing_left(store)


def _fail_at_the_stamps(self, rows):
    if rows.dtype == np.int64:
        raise RuntimeError("stamps")
    real_append(self, rows)


def test_an_id_that_is_taken_at_the_last_moment_is_not_overwritten(store, monkeypatch):
    """Another writer commits between the look at the id and the move into its place."""
    late, first = (store.writer(kind="recording", attributes=take(FORCE)) for _ in range(2))
    record(late, 0, 17)
    record(first, 0, 4)
    rename = Path.rename

    def commit_first(path, target):
        monkeypatch.setattr(Path, "rename", rename)
        first.__exit__(None, None, None)
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", commit_first)
    with pytest.raises(ConflictError, match="exists already"):
        late.__exit__(None, None, None)
    assert store.list(kind="recording") == ["take-1"]
    assert store.recording("take-1").num_samples("force") == 4
    store.recording("take-1").verify()
    assert list((store.root / ".staging").iterdir()) == []


@pytest.mark.parametrize("call", range(1, 5))
def test_ctrl_c_while_a_shard_is_closed_is_no_error_of_the_disk(store, monkeypatch, call):
    """Four arrays, as the take is finished."""
    real, calls = os.close, []

    def interrupted(descriptor):
        real(descriptor)
        calls.append(descriptor)
        if len(calls) == call:
            raise KeyboardInterrupt

    writer = store.writer(kind="recording", attributes=take(FORCE))
    record(writer, 0, 17)
    names = {name: getattr(os, name) for name in dir(os)}
    locked = os.fstat(writer._lock)
    with monkeypatch.context() as patch:
        fake = SimpleNamespace(**names | {"close": interrupted})
        patch.setattr("dextouch.episodes.shards.os", fake)
        with pytest.raises(KeyboardInterrupt):
            writer.__exit__(None, None, None)
    # Each of the four was closed once: a number may already be that of another file.
    assert len(calls) == len(set(calls)) == 4
    assert_nothing_left(store)
    # The lock is free.
    with contextlib.suppress(OSError):
        assert not os.path.samestat(os.fstat(writer._lock), locked)


def test_a_second_interrupt_leaves_what_a_sweep_removes(store, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.writer.shutil.rmtree", interrupted)
        break_off(store, record_17, FORCE, error=KeyboardInterrupt)
    assert store.list(kind="recording") == []
    assert EpisodeStore(store.root).sweep() == 1
    assert_nothing_left(store)
