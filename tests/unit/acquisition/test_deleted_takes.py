"""Takes that the store reports as deleted leave the spool, running ones once they are saved."""

from datetime import UTC, datetime

import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import (
    AccessDeniedError,
    ConflictError,
    NotFoundError,
    UnavailableError,
)
from dextouch.schemas import (
    CheckedTakes,
    PendingDeletion,
    RecorderSession,
    RecordingAttributes,
    SavedTakes,
)
from dextouch.streams import SampleBatch, StreamDescriptor
from services.acquisition import retention
from services.acquisition.recorder import SessionCount
from services.acquisition.retention import DeletedTakes, OperatorNames
from services.acquisition.uploader import Uploader, ids_in_store, second_id

HEAD = StreamDescriptor(
    name="head", kind="pose", shape=(7,), dtype="float64", unit="p", nominal_rate_hz=100
)


def spool(root, name, *, operator="gone", close=True):
    attributes = RecordingAttributes(
        recording_id=name, task="t", instruction="i", domain="human", station="desk",
        operator=operator, started_at=datetime(2026, 5, 4, tzinfo=UTC), streams=(HEAD,),
    )  # fmt: skip
    writer = SpoolWriter(root / name, attributes)
    k = np.arange(3, dtype=np.int64)
    writer.append("head", SampleBatch(k, k, k, np.zeros((3, 7))))
    if close:
        writer.close()
    return writer


class Store(EpisodeStoreClient):
    """A store that has deleted one operator."""

    def __init__(self):
        self.revision, self.checked, self.confirmed = "1", [], []

    def deletions_revision(self):
        return self.revision

    def check_takes(self, spooled):
        self.checked.append(spooled)
        found = tuple(
            PendingDeletion(recording_id=one.recording_id, deletion="d")
            for one in spooled.takes
            if one.operator == "gone"
        )
        names = tuple(name for name in spooled.operators if name == "gone")
        return CheckedTakes(revision=self.revision, takes=found, operators=names)

    def confirm_removal(self, removed):
        self.confirmed.append((removed.station, [one.recording_id for one in removed.held]))


@pytest.fixture
def forgotten():
    return []


@pytest.fixture
def deleted(tmp_path, forgotten):
    names = OperatorNames(lambda: ("gone", "other"), forgotten.append)
    return DeletedTakes(tmp_path, "desk", stored_as=ids_in_store, operators=names)


def test_the_spool_is_asked_about_once_for_every_deletion(tmp_path, deleted, forgotten):
    for name, operator in (("a", "gone"), ("b", "other"), ("c", "gone")):
        spool(tmp_path, name, operator=operator)
    store = Store()
    assert deleted.remove(store) == ["a", "c"]
    assert store.confirmed == [("desk", [])]
    assert forgotten == ["gone"]
    assert deleted.remove(store) == []
    assert len(store.checked) == 1
    store.revision = "2"
    assert deleted.remove(store) == []
    assert len(store.checked) == 2
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {".removed", "b"}
    assert list((tmp_path / ".removed").iterdir()) == []


def test_a_large_spool_is_asked_about_in_parts(tmp_path, deleted, monkeypatch):
    monkeypatch.setattr(retention.schemas, "MAX_CHECKED_TAKES", 2)
    for number in range(5):
        spool(tmp_path, f"take-{number}")
    store = Store()
    assert len(deleted.remove(store)) == 5
    assert [len(one.takes) for one in store.checked] == [2, 2, 1]
    assert store.confirmed == [("desk", [])]


def test_a_take_that_is_being_recorded_is_held_until_it_is_saved(tmp_path, deleted):
    writer = spool(tmp_path, "a", close=False)
    store = Store()
    assert deleted.remove(store) == []
    assert store.confirmed == [("desk", ["a"])]
    writer.close()
    assert deleted.remove(store) == ["a"]
    assert store.confirmed[-1] == ("desk", [])


def test_takes_are_named_as_the_store_has_them(tmp_path, deleted):
    about = spool(tmp_path, "a").attributes
    spool(tmp_path, "b")
    (tmp_path / "b" / "uploaded.json").write_text(
        '{"recording_id": "b-0123456789ab", "state": "finished"}'
    )
    spool(tmp_path, "c")
    (tmp_path / "c" / "recording.json").write_text("{")
    store = Store()
    deleted.remove(store)
    asked = {one.recording_id: (one.stored_as, one.is_damaged) for one in store.checked[0].takes}
    assert asked == {
        "a": (("a", second_id(about)), False),
        "b": (("b-0123456789ab",), False),
        "c": (("c",), True),
    }


@pytest.mark.parametrize(
    "error", [UnavailableError("no answer"), NotFoundError("an older store"), ConflictError("x")]
)
def test_a_store_that_cannot_say_is_asked_again(tmp_path, deleted, error):
    spool(tmp_path, "a")
    store = Store()

    def fail(_):
        raise error

    confirm, store.confirm_removal = store.confirm_removal, fail
    if isinstance(error, NotFoundError):
        store.deletions_revision = lambda: fail(None)
    deleted.remove(store)
    store.confirm_removal, store.deletions_revision = confirm, lambda: "1"
    deleted.remove(store)
    assert store.confirmed == [("desk", [])]
    assert not (tmp_path / "a").exists()


def test_a_take_that_the_store_refuses_as_deleted_is_removed_at_once(tmp_path, deleted):
    spool(tmp_path, "a")
    spool(tmp_path, "b")

    class Refusing(Store):
        def create(self, attributes):
            reason = {"a": "take_deleted", "b": "operator_deleted"}[attributes.recording_id]
            raise ConflictError(f"{attributes.recording_id}: deleted", reason=reason)

    uploader = Uploader(tmp_path, Refusing(), period_s=1.0, deleted=deleted)
    for _ in range(3):
        uploader.upload_all()
    assert not (tmp_path / "a").exists()
    # A person has to judge the other one.
    assert list(uploader.refused) == ["b"]


def test_the_session_forgets_an_operator(tmp_path):
    saved = tuple(
        SavedTakes(task=task, operator=operator, num_saved=1)
        for task, operator in (("t", "gone"), ("u", "gone"), ("t", "other"), ("t", None))
    )
    session = RecorderSession(started_at=datetime(2026, 5, 4, tzinfo=UTC), saved=saved)
    (tmp_path / "session.json").write_text(session.model_dump_json())
    count = SessionCount(tmp_path)
    assert count.operators() == ("gone", "other")
    count.forget("gone")
    assert [one.operator for one in SessionCount(tmp_path).now.saved] == ["other", None]
    assert "gone" not in (tmp_path / "session.json").read_text()


def test_nothing_is_confirmed_while_a_take_cannot_be_asked_about(tmp_path, deleted):
    spool(tmp_path, "a")
    spool(tmp_path, "damaged", operator="gone")
    path = tmp_path / "damaged" / "recording.json"
    path.write_bytes(path.read_bytes().replace(b"gone", b"gome"))
    spool(tmp_path, "log-alone", operator="gone")
    (tmp_path / "log-alone" / "recording.json").unlink()
    store = Store()
    # What can be found goes all the same.
    assert deleted.remove(store) == ["a"]
    assert store.confirmed == []


def test_nothing_is_confirmed_while_takes_of_an_earlier_name_are_there(tmp_path, forgotten):
    spool(tmp_path, "a")

    class Bound(Store):
        def check_takes(self, spooled):
            if spooled.station != "new":
                raise AccessDeniedError("of another station", reason="other_station")
            return super().check_takes(spooled)

    names = OperatorNames(lambda: (), forgotten.append)
    renamed = DeletedTakes(tmp_path, "new", stored_as=ids_in_store, operators=names)
    store = Bound()
    assert renamed.remove(store) == []
    assert store.confirmed == []
