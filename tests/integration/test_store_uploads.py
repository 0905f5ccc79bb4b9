"""Station and store together: a store that is busy or full is left alone until it said."""

import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import LimitExceededError, StorageFullError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor
from services.acquisition.uploader import Uploader

GLOVE = StreamDescriptor(
    name="glove_left",
    kind="tactile",
    shape=(360,),
    dtype="uint16",
    unit="counts",
    nominal_rate_hz=60,
)


class FullStore(EpisodeStoreClient):
    """A store without room for anything."""

    def __init__(self, error):
        self.error, self.asked = error, []

    def create(self, attributes):
        self.asked.append(attributes.recording_id)
        raise self.error

    def send_batch(self, recording_id, descriptor, batch, *, number):
        raise NotImplementedError

    def finish(self, recording_id, num_batches, *, success=None, ledger=(), content=None):
        raise NotImplementedError


@pytest.fixture
def spool_root(tmp_path):
    for name in ("take-1", "take-2"):
        attributes = RecordingAttributes(
            recording_id=name,
            task="stand_bottle",
            instruction="",
            domain="human",
            station="bench",
            streams=(GLOVE,),
        )
        k = np.arange(3)
        with SpoolWriter(tmp_path / name, attributes, sync=False) as writer:
            writer.append("glove_left", SampleBatch(k, k, k, np.ones((3, 360), dtype="<u2")))
    return tmp_path


@pytest.mark.parametrize("kind", [LimitExceededError, StorageFullError])
def test_a_store_that_says_when_is_left_alone_until_then(spool_root, kind, monkeypatch):
    store = FullStore(kind("busy", retry_after_s=30))
    uploader = Uploader(spool_root, store, period_s=2.0)
    waits = []

    def wait(seconds):
        waits.append(seconds)
        uploader._stopping.set()

    monkeypatch.setattr(uploader._stopping, "wait", wait)
    uploader._run()
    # The second take is not even offered, and both are still here.
    assert store.asked == ["take-1"]
    assert waits == [30.0]
    assert [status.uploaded for status in uploader.status()] == [False, False]


def test_other_refusals_stop_one_take_only(spool_root, monkeypatch):
    store = FullStore(StorageFullError("no room for this one"))
    uploader = Uploader(spool_root, store, period_s=2.0)
    assert uploader.upload_all() == []
    assert store.asked == ["take-1", "take-2"]
    assert uploader._retry_after_s == 0.0
