"""Station and store: a take leaves its spool when the store has proved that it has all of it."""

import numpy as np
import pytest
from pydantic import SecretStr

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.schemas import RecordingAttributes
from dextouch.serving.keys import ApiKey
from dextouch.streams import SampleBatch, StreamDescriptor
from services.acquisition.settings import Retention
from services.acquisition.uploader import UPLOADED_FILE, Uploader, second_id
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episode_store.conftest import InProcess

FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=100
)
WRIST = FORCE.model_copy(update={"name": "wrist"})
TAKE = RecordingAttributes(
    recording_id="take-1",
    task="stand_bottle",
    instruction="",
    domain="human",
    station="desk_3",
    streams=(FORCE, WRIST),
    trace_id="a" * 32,
)
NUM_SAMPLES = 400
RANDOM_TEXT = "Xk3vQ9wLr7ZpT2mB"


def samples(start, stop, *, offset=0.0):
    k = np.arange(start, stop)
    return SampleBatch(k * 10, k, k, np.stack([k + offset, -k], axis=1).astype("f4"))


@pytest.fixture
def spool(tmp_path):
    path = tmp_path / "spool" / "take-1"
    with SpoolWriter(path, TAKE, sync=False) as writer:
        writer.append("force", samples(0, NUM_SAMPLES))
        writer.append("wrist", samples(0, 50))
    return path


@pytest.fixture
def settings(tmp_path):
    return EpisodeStoreSettings(
        store_url=str(tmp_path / "store"), sync_uploads=False, commit_in_process=False
    )


@pytest.fixture
def client_of(settings):
    """A client with the key of this name, of a store with the keys `old` and `new`."""
    keys = tuple(
        ApiKey(name=n, key=SecretStr(f"{n}-{RANDOM_TEXT}"), scopes=("store_write",))
        for n in ("old", "new")
    )
    transport = InProcess(create_app(settings.model_copy(update={"api_keys": keys})))
    clients = {
        name: kind("http://localhost", f"{key}-{RANDOM_TEXT}", transport=transport)
        for name, key, kind in (
            ("old", "old", EpisodeStoreClient),
            ("new", "new", EpisodeStoreClient),
            ("silent", "new", SilentStore),
        )
    }
    yield clients.__getitem__
    for client in clients.values():
        client.close()


class SilentStore(EpisodeStoreClient):
    """A store of an earlier release: it says that it has finished, and not what."""

    def finish(self, recording_id, num_batches, *, success=None, ledger=(), content=None):
        return super().finish(recording_id, num_batches, success=success, ledger=ledger)


def send(client, *, force, wrist, finish=True):
    """What somebody else sends under the id of the take: batches as a station cuts them."""
    client.create(TAKE)
    counts = {"force": 0, "wrist": 0}
    for name, batch, descriptor in (("force", force, FORCE), ("wrist", wrist, WRIST)):
        for start in range(0, len(batch), 120):
            columns = (column[start : start + 120] for column in vars(batch).values())
            client.send_batch("take-1", descriptor, SampleBatch(*columns), number=counts[name])
            counts[name] += 1
    if finish:
        client.finish("take-1", counts)


class SweptUploader(Uploader):
    """Removes what was uploaded at once, as the thread of an uploader does after each look."""

    def upload_all(self):
        done = super().upload_all()
        self.retention.sweep()
        return done


def uploader_of(spool, client):
    limits = Retention(keep_uploaded_days=0)
    return SweptUploader(spool.parent, client, period_s=1.0, retention=limits)


WHOLE = {"force": samples(0, NUM_SAMPLES), "wrist": samples(0, 50)}


@pytest.mark.parametrize(
    ("other", "told"),
    [
        ({"force": samples(0, 1), "wrist": samples(0, 0)}, "force has 1 of 4 batches"),
        (WHOLE | {"wrist": samples(0, 0)}, "wrist has 0 of 1 batches"),
        (WHOLE | {"force": samples(0, 399)}, "force has 399 samples"),
        (WHOLE | {"force": samples(0, 400, offset=0.5)}, "force has 400 samples and sha256"),
        (WHOLE | {"wrist": samples(1, 51)}, "wrist has 50 samples and sha256"),
    ],
)
def test_a_take_stays_where_the_store_has_other_samples_of_its_id(
    spool, client_of, settings, other, told
):
    client = client_of("new")
    send(client, **other)
    uploader = uploader_of(spool, client)
    for _ in range(4):
        assert uploader.upload_all() == []
    assert told in uploader.status()[0].error
    assert uploader.status()[0].refused
    assert SpoolReader(spool).num_samples("force") == NUM_SAMPLES
    # Sent again once somebody has deleted the false recording.
    EpisodeStore(settings.store_url).delete("take-1", kind="recording")
    uploader.retry("take-1")
    assert uploader.upload_all() == ["take-1"]
    assert not spool.exists()
    stored = EpisodeStore(settings.store_url).recording("take-1").read("force").values
    np.testing.assert_array_equal(stored, samples(0, NUM_SAMPLES).values)


def test_a_foreign_batch_in_an_upload_is_never_committed(spool, client_of, settings):
    client = client_of("new")
    client.create(TAKE)
    client.send_batch("take-1", FORCE, samples(0, 120, offset=0.5), number=0)
    uploader = uploader_of(spool, client)
    assert uploader.upload_all() == []
    assert "the store has other samples: force has 400 samples" in uploader.status()[0].error
    assert spool.exists()
    assert not EpisodeStore(settings.store_url).exists("take-1", kind="recording")


def test_a_take_goes_when_the_store_had_all_of_it_before(spool, client_of):
    """The answer was lost, or a station of an earlier release sent it, which proves nothing."""
    client = client_of("new")
    send(client, **WHOLE)
    assert uploader_of(spool, client).upload_all() == ["take-1"]
    assert not spool.exists()


def test_a_take_stays_where_the_store_proves_nothing(spool, client_of):
    uploader = uploader_of(spool, client_of("silent"))
    for _ in range(4):
        assert uploader.upload_all() == []
    status = uploader.status()[0]
    assert "does not say what it has" in status.error
    # Not set aside: it goes when the store is upgraded.
    assert not status.refused
    assert not (spool / UPLOADED_FILE).exists()
    assert uploader_of(spool, client_of("new")).upload_all() == ["take-1"]


def test_without_content_a_finished_recording_must_have_the_batches(client_of):
    """As older stations finish: what can be compared is compared."""
    client = client_of("new")
    send(client, **WHOLE)
    counts = {"num_batches": {"force": 4, "wrist": 1}}
    answer = client._http.post("/v1/recordings/take-1/finish", json=counts).json()
    # Nothing that an older station would refuse.
    assert answer == {"recording_id": "take-1", "state": "finished", "next_batch": {}}
    for wrong in ({"force": 1, "wrist": 1}, {"force": 5, "wrist": 1}, {"force": 0, "wrist": 0}):
        with pytest.raises(ConflictError, match="batches"):
            client.finish("take-1", wrong)
    with pytest.raises(InvalidInputError, match="got streams"):
        client.finish("take-1", {"force": 4})


def test_a_take_half_uploaded_under_a_renamed_key_is_stored_whole_under_its_second_id(
    spool, client_of, settings
):
    send(client_of("old"), force=samples(0, 240), wrist=samples(0, 0), finish=False)
    assert uploader_of(spool, client_of("new")).upload_all() == ["take-1"]
    stored = EpisodeStore(settings.store_url).recording(second_id(TAKE))
    assert {name: stored.num_samples(name) for name in WHOLE} == {"force": 400, "wrist": 50}
    assert not spool.exists()
