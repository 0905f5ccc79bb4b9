"""Takes that an exception, a Ctrl-C or a full disk breaks off: what was appended is kept."""

import contextlib
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, WriteOptions, staged_group
from dextouch.episodes.journal import JournalWriter
from dextouch.episodes.shards import ShardWriter
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    StorageError,
    StorageFullError,
)
from tests.unit.episodes.broken_takes import (
    CAMERA,
    FORCE,
    break_off,
    kept_numbers,
    record,
    record_17,
    stages,
    take,
)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_every_appended_sample_is_kept(store, error):
    told = break_off(store, record_17, FORCE, error=error)
    assert kept_numbers(store) == list(range(17))
    assert stages(store) == []
    assert "kept as 'take-1', marked as recovered" in told


CHILD = """
import signal
import sys
import numpy as np
from dextouch.episodes import EpisodeStore
from dextouch.schemas.recordings import RecordingAttributes

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


@pytest.mark.parametrize("state", ["waits", "appends"])
def test_ctrl_c_keeps_the_take(store, state):
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(store.root), take(FORCE).model_dump_json(), state],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout.readline() == "recording\n"
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode != 0
    assert "KeyboardInterrupt" in said
    assert "kept as 'take-1', marked as recovered" in said
    numbers = kept_numbers(store)
    assert numbers == list(range(len(numbers)))
    assert len(numbers) == 20_000 if state == "waits" else len(numbers) >= 20_000
    assert stages(store) == []


def test_images_that_wait_for_their_encoder_are_kept(store):
    def fill(writer):
        record(writer, 0, 3)
        for number in range(20):
            image = np.full((1, 48, 64, 3), 90, np.uint8)
            writer.append("camera", values=image, t_host_ns=np.array([number]))

    break_off(store, fill, FORCE, CAMERA)
    assert kept_numbers(store) == [0, 1, 2]
    assert len(store.recording("take-1").images("camera")) == 20


real_append = ShardWriter.append


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("write", range(1, 13))
def test_an_interrupt_inside_an_append_loses_that_block_alone(store, monkeypatch, write, before):
    """Ctrl-C before and after each write of a log, of which each storage chunk has four."""
    real, calls = JournalWriter.append, []

    def interrupted(self, payload, num_rows):
        calls.append(self.name)
        if len(calls) == write and before:
            raise KeyboardInterrupt
        real(self, payload, num_rows)
        if len(calls) == write:
            raise KeyboardInterrupt

    def fill(writer):
        for number in range(40):
            record(writer, number)

    with monkeypatch.context() as patch:
        patch.setattr(JournalWriter, "append", interrupted)
        break_off(store, fill, FORCE, error=KeyboardInterrupt)
    # Samples 4, 9 and 14 complete a storage chunk.
    assert kept_numbers(store) == list(range(4 + 5 * ((write - 1) // 4)))


def test_what_follows_a_block_that_was_broken_off_is_refused(store, monkeypatch):
    """Else values and stamps of what follows would not belong together."""
    real = JournalWriter.append

    def full_once(self, payload, num_rows):
        if self.name == "force" and len(self.index) == 1 and not failed:
            failed.append(self.name)
            raise StorageFullError("no space left")
        real(self, payload, num_rows)

    def fill(writer):
        record(writer, 0, 9)
        with pytest.raises(StorageFullError):
            record(writer, 9)
        with pytest.raises(StorageError, match=r"force: .*interrupted.*leave the writer"):
            record(writer, 10)

    failed = []
    monkeypatch.setattr(JournalWriter, "append", full_once)
    break_off(store, fill, FORCE)
    assert kept_numbers(store) == list(range(9))


def test_whole_storage_chunks_need_no_space_to_be_kept(store, monkeypatch):
    """Samples 4 and 9 complete storage chunks; then the disk is full and a block breaks off."""

    def full(*_):
        raise StorageFullError("no space left")

    def fill(writer):
        record(writer, 0, 10)
        monkeypatch.setattr(JournalWriter, "append", full)
        monkeypatch.setattr(ShardWriter, "append", _fail_at_the_stamps)
        record(writer, 10)

    break_off(store, fill, FORCE)
    assert kept_numbers(store) == list(range(10))


def test_a_take_with_a_block_broken_off_is_not_committed_as_if_whole(store, monkeypatch):
    monkeypatch.setattr(ShardWriter, "append", _fail_at_the_stamps)
    writer = store.writer(kind="recording", attributes=take(FORCE))
    with pytest.raises(RuntimeError, match="stamps"):
        record(writer, 0, 9)
    with pytest.raises(StorageError, match="interrupted"):
        writer.__exit__(None, None, None)
    # Of the values a storage chunk is there, of the stamps none.
    assert store.list(kind="recording") == []


def _fail_at_the_stamps(self, rows):
    if rows.dtype == np.int64:
        raise RuntimeError("stamps")
    real_append(self, rows)


def test_a_take_whose_id_was_taken_meanwhile_is_kept_under_another(store):
    late = store.writer(kind="recording", attributes=take(FORCE))
    record(late, 0, 17)
    with store.writer(kind="recording", attributes=take(FORCE)) as first:
        record(first, 0, 4)
    with pytest.raises(ConflictError, match="exists already") as caught:
        late.__exit__(None, None, None)
    assert "'take-1-recovered-1'" in " ".join(caught.value.__notes__)
    assert kept_numbers(store, "take-1-recovered-1", broken_off=False) == list(range(17))
    assert store.recording("take-1").num_samples("force") == 4


@pytest.mark.parametrize("how", ["commits", "was killed"])
def test_an_id_that_is_taken_at_the_last_moment_costs_nothing(store, monkeypatch, how):
    """Another writer commits between the look at the id and the move into its place."""
    late, first = (store.writer(kind="recording", attributes=take(FORCE)) for _ in range(2))
    record(late, 0, 17)
    record(first, 0, 4)
    forget = staged_group.forget_journal

    def commit_first(*arguments):
        monkeypatch.setattr(staged_group, "forget_journal", forget)
        first.__exit__(None, None, None)
        forget(*arguments)

    if how == "was killed":
        _die_before_its_move(late, monkeypatch)
    monkeypatch.setattr(staged_group, "forget_journal", commit_first)
    end = store.recover if how == "was killed" else lambda: late.__exit__(None, None, None)
    with pytest.raises(ConflictError, match="exists already"):
        end()
    store.sweep()
    store.recover()
    assert kept_numbers(store, "take-1-recovered-1", broken_off=False) == list(range(17))
    assert store.recording("take-1").num_samples("force") == 4
    assert stages(store) == []


def _die_before_its_move(writer, monkeypatch):
    """As a kill would, once the commit record is written."""
    with monkeypatch.context() as patch:
        patch.setattr(staged_group, "publish_stage", lambda *_: None)
        writer._commit()
    os.close(writer._lock)


def test_the_attributes_of_a_whole_take_are_those_of_its_end(store, monkeypatch):
    """Its writer died with the commit record on the disk, and its id was taken."""
    late = store.writer(kind="recording", attributes=take(FORCE))
    record(late, 0, 17)
    late.set_attributes(take(FORCE, success=True))
    first = store.writer(kind="recording", attributes=take(FORCE))
    _die_before_its_move(late, monkeypatch)
    with first:
        record(first, 0, 4)
    (group,) = store.recover()
    assert (group.item_id, group.num_samples) == ("take-1-recovered-1", {"force": 17})
    assert store.recording("take-1-recovered-1").attributes.success is True


@pytest.mark.parametrize("file", ["zarr.json", "commit.json"])
def test_a_recovery_that_dies_while_it_changes_the_id_is_repeated(store, monkeypatch, file):
    """Even where the first id is free again by then."""
    real = staged_group.replace_file

    def die(path, data):
        if path.name == file:
            raise KeyboardInterrupt
        real(path, data)

    late, first = (store.writer(kind="recording", attributes=take(FORCE)) for _ in range(2))
    record(late, 0, 17)
    _die_before_its_move(late, monkeypatch)
    with first:
        record(first, 0, 4)
    with monkeypatch.context() as patch:
        patch.setattr(staged_group, "replace_file", die)
        with pytest.raises(KeyboardInterrupt):
            store.recover()
    store.delete("take-1", kind="recording")
    (group,) = store.recover()
    reader = store.recording(group.item_id)
    reader.verify()
    assert reader.read("force").t_host_ns.tolist() == list(range(17))


@pytest.mark.parametrize("call", range(1, 9))
def test_ctrl_c_while_a_log_is_closed_is_no_error_of_the_disk(store, monkeypatch, call):
    """Four arrays of two files each, as the take is finished."""
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
        patch.setattr("dextouch.episodes.journal.os", fake)
        with pytest.raises(KeyboardInterrupt):
            writer.__exit__(None, None, None)
    assert kept_numbers(store) == list(range(17))
    # The lock is free.
    assert stages(store) == []
    # Its number may be that of another file by now.
    with contextlib.suppress(OSError):
        assert not os.path.samestat(os.fstat(writer._lock), locked)


def test_what_is_known_at_the_end_is_kept_too(store):
    def fill(writer):
        record(writer, 0, 7)
        writer.set_attributes(take(FORCE, success=False))

    break_off(store, fill, FORCE)
    assert store.recording("take-1").attributes.success is False


def test_a_take_without_a_sample_leaves_nothing(store):
    told = break_off(store, lambda _: None, FORCE)
    assert told == ""
    assert store.list(kind="recording") == []
    assert stages(store) == []


@pytest.mark.parametrize("error", [None, RuntimeError("the glove came off")])
def test_a_discarded_take_leaves_nothing(store, error):
    writer = store.writer(kind="recording", attributes=take(FORCE))
    record(writer, 0, 17)
    writer.discard()
    with pytest.raises(InvalidInputError, match="discarded"):
        record(writer, 17)
    writer.__exit__(type(error) if error else None, error, None)
    assert store.list(kind="recording") == []
    assert stages(store) == []


def test_what_its_caller_can_repeat_leaves_nothing(store):
    told = break_off(store, record_17, FORCE, options=WriteOptions(recoverable=False))
    assert told == ""
    assert store.list(kind="recording") == []
    assert stages(store) == []


def test_a_second_interrupt_leaves_the_rest_to_recover(store, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.writer.recover_stage", interrupted)
        break_off(store, record_17, FORCE, error=KeyboardInterrupt)
    assert store.sweep() == 0
    EpisodeStore(store.root).recover()
    assert kept_numbers(store) == list(range(17))
