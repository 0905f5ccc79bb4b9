"""A service whose bucket is away: it starts, and uploads what waits when the bucket is back."""

import time

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError

from dextouch.episodes import EpisodeStore
from dextouch.episodes.trash import put_into_trash
from dextouch.errors import StorageError, UnavailableError
from services.episode_store.app import PendingUploads, create_app, purge_old_trash
from services.episode_store.settings import EpisodeStoreSettings
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episode_store.episodes import write_episode
from tests.unit.episodes.conftest import episode_of

# Port 9 (discard) answers nobody on a loopback device.
AWAY = "s3://takes/unit?endpoint=http://127.0.0.1:9&allow_http=true&region=us-east-1&max_retries=0"


@pytest.fixture(scope="module")
def s3_server():
    with running_s3() as server:
        yield server


@pytest.fixture
def store(s3_server, tmp_path):
    url = s3_server.url(f"pending/{tmp_path.name}")
    return EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "work")})


def fail_to_upload(s3_server, store, made):
    """Write an episode whose upload is refused, so that it waits."""
    writer = store.writer(attributes=made.attributes)
    for descriptor in made.descriptors:
        writer.add_stream(descriptor)
        name = descriptor.name
        writer.append(name, values=made.values[name], t_ref_ns=made.stamps_ns[name])
    with s3_server.checking_credentials(), pytest.raises(StorageError, match="waits in"):
        writer.__exit__(None, None, None)


def wait_until(holds, deadline_s=20.0):
    end = time.monotonic() + deadline_s
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_service_starts_while_its_bucket_is_away(tmp_path, monkeypatch):
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(f"AWS_{name}".upper(), value)
    monkeypatch.chdir(tmp_path)
    app = create_app(EpisodeStoreSettings(store_url=f"{AWAY}&work_folder={tmp_path / 'work'}"))
    with TestClient(app, base_url="http://127.0.0.1") as client:
        assert client.get("/healthz").status_code == 200


def test_what_failed_is_uploaded_when_the_bucket_is_back(s3_server, store):
    made = episode_of()
    pending = PendingUploads(store, period_s=0.05)
    fail_to_upload(s3_server, store, made)
    with s3_server.checking_credentials():
        with pytest.raises(StorageError, match="refused"):
            pending.work()
        pending.start()
        time.sleep(0.2)
    try:
        wait_until(lambda: store.list() == [made.attributes.episode_id])
    finally:
        pending.stop()
    assert store.open(made.attributes.episode_id).verify()


def test_a_sweep_that_fails_is_not_tried_again_at_once(store, monkeypatch):
    """It lists the whole bucket."""
    pending, failure = PendingUploads(store), UnavailableError("list: no answer")
    monkeypatch.setattr(store, "sweep", lambda: (_ for _ in ()).throw(failure))
    with pytest.raises(UnavailableError):
        pending.work()
    pending.work()


def test_a_take_that_waits_is_no_conflict(s3_server, store):
    made = episode_of()
    fail_to_upload(s3_server, store, made)
    with pytest.raises(UnavailableError, match="waits in"):
        made.write(store)


@pytest.mark.parametrize(("keep_days", "left"), [(30.0, ["new"]), (None, ["old", "new"])])
def test_the_trash_is_emptied_after_some_days(tmp_path, keep_days, left):
    store = EpisodeStore(tmp_path)
    for name, age_days in (("old", 31), ("new", 29)):
        write_episode(store, name)
        deleted_ns = time.time_ns() - age_days * 86_400 * 10**9
        put_into_trash(tmp_path, "episode", name, now_ns=deleted_ns)
    purge_old_trash(store, keep_days)
    assert [entry.item_id for entry in store.trash_list()] == left


def test_days_without_end_are_left_out_instead(settings):
    with pytest.raises(ValidationError, match="finite number"):
        EpisodeStoreSettings(store_url=settings.store_url, keep_trash_days=float("inf"))
