"""A deleted operator is deleted at the stations, too: what they hold, send, and come with later."""

import json
import time
from datetime import UTC, datetime, timedelta

import httpx
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError
from dextouch.schemas import TakePrompt
from services.acquisition.app import create_app as create_station
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.settings import AcquisitionSettings
from services.cli.main import main
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.integration.recording_streams import human_streams
from tests.unit.worlds.running import served

STREAMS = [s for s in human_streams(0.7) if s.descriptor.name in {"head", "wrist_left"}]
GONE, OTHER = "op-secret", "op-other"
PATIENCE_S = 30.0


def until(holds, what):
    end_s = time.monotonic() + PATIENCE_S
    while not (value := holds()):
        assert time.monotonic() < end_s, what
        time.sleep(0.05)
    return value


def record(root, station, recording_id, operator=GONE):
    prompt = TakePrompt(task="stack_bowls", instruction="stack", operator=operator, consent=True)
    with MockStation(
        STREAMS, FaultScript(), 1, VirtualClock(), spool_root=root / station, name=station
    ) as mock:
        mock.run_take(prompt, recording_id=recording_id)
    return root / station / recording_id


@pytest.fixture
def root(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def store(root):
    settings = EpisodeStoreSettings(
        store_url=str(root), sync_uploads=False, commit_in_process=False
    )
    with served(create_store(settings)) as url:
        yield url


def station(tmp_path, name, url):
    settings = AcquisitionSettings(
        mock=True,
        station=name,
        spool=tmp_path / name,
        episode_store_url=url,
        upload_period_s=0.05,
        enrolment=tmp_path / "no-enrolment.json",
    )
    return served(create_station(settings))


def delete(root, *words, operator=GONE):
    receipt = root.parent / "receipt.json"
    words = ("--operator", operator, "--for-good", "--yes", "--receipt", str(receipt), *words)
    status = main(["store", "delete", "--store", str(root), *words])
    return status, json.loads(receipt.read_text()) if receipt.exists() else None


def outstanding(root, capsys):
    capsys.readouterr()
    words = ["--store", str(root), "--operator", GONE, "--json", "-"]
    assert main(["store", "deletions", *words]) == 0
    text = capsys.readouterr().out
    (found,) = json.loads(text[text.index("{") :])["deletions"]
    return {one["station"]: one["recordings"] for one in found["outstanding"]}


def names_of(folder, name):
    """Files below a folder that contain a name, in their path or their bytes."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return [path for path in files if name in str(path) or name.encode() in path.read_bytes()]


def test_stations_remove_the_takes_of_a_deleted_operator(tmp_path, root, store):
    mine, other = record(tmp_path, "desk_1", "take-1"), record(tmp_path, "desk_1", "take-2", OTHER)
    with EpisodeStoreClient(store) as client, station(tmp_path, "desk_1", store):
        until(lambda: client.recordings().num_matching == 2, "not uploaded")
        status, receipt = delete(root)
        assert status == 0
        assert [one["id"] for one in receipt["deleted"]] == ["take-1"]
        until(lambda: not mine.exists(), "the take is still in the spool")
        assert client.recordings().num_matching == 1
    assert other.exists()
    assert names_of(tmp_path / "desk_1", GONE) == []
    assert names_of(root, GONE) == []


def test_the_receipt_lists_what_is_outstanding_until_the_station_has_removed_it(
    tmp_path, root, store, capsys
):
    for name in ("desk_1", "desk_2"):
        record(tmp_path, name, "same-1")
    with EpisodeStoreClient(store) as client:
        for name, num_stored in (("desk_1", 1), ("desk_2", 2)):
            with station(tmp_path, name, store):
                count = num_stored
                until(lambda count=count: client.recordings().num_matching == count, "not uploaded")
        ids = {r.station: r.recording_id for r in client.recordings().recordings}
    # The second take is stored under a second id.
    assert ids["desk_2"] != "same-1"
    _, receipt = delete(root)
    assert receipt["remaining"] == []
    assert receipt["outstanding"] == [
        {"station": name, "recordings": [ids[name]], "has_answered": False}
        for name in ("desk_1", "desk_2")
    ]
    with station(tmp_path, "desk_2", store):
        until(lambda: set(outstanding(root, capsys)) == {"desk_1"}, "not confirmed")
    assert not (tmp_path / "desk_2" / "same-1").exists()
    assert (tmp_path / "desk_1" / "same-1").exists()
    with station(tmp_path, "desk_1", store):
        until(lambda: outstanding(root, capsys) == {}, "not confirmed")
    assert not (tmp_path / "desk_1" / "same-1").exists()
    assert '"take' not in (tmp_path / "desk_1" / "removals.jsonl").read_text()
    assert "same-1" in (tmp_path / "desk_1" / "removals.jsonl").read_text()


def test_takes_that_were_never_uploaded_do_not_bring_the_operator_back(tmp_path, root, store):
    record(tmp_path, "desk_1", "take-1")
    waiting = record(tmp_path, "desk_2", "take-9")
    with EpisodeStoreClient(store) as client:
        with station(tmp_path, "desk_1", store):
            until(lambda: client.recordings().num_matching == 1, "not uploaded")
        delete(root)
        with station(tmp_path, "desk_2", store):
            until(lambda: not waiting.exists(), "the take is still in the spool")
        assert client.recordings().num_matching == 0
    assert names_of(tmp_path / "desk_2", GONE) == []


def test_an_operator_whom_only_a_station_knows_is_deleted_when_asked(tmp_path, root, store, capsys):
    waiting = record(tmp_path, "desk_1", "take-1")
    status, _ = delete(root)
    assert status == 3
    assert "--unsent" in capsys.readouterr().err
    status, receipt = delete(root, "--unsent")
    assert (status, receipt["deleted"]) == (0, [])
    with station(tmp_path, "desk_1", store):
        until(lambda: not waiting.exists(), "the take is still in the spool")


def begin_upload(client, spool):
    """An upload of which everything but the end has come."""
    reader = SpoolReader(spool)
    client.create(reader.attributes)
    for name, descriptor in reader.streams.items():
        client.send_batch("take-1", descriptor, reader.read(name), number=0)
    return reader


def test_an_upload_under_way_is_refused_and_dropped(tmp_path, root, store):
    spool = record(tmp_path, "desk_1", "take-1")
    with EpisodeStoreClient(store) as client:
        reader = begin_upload(client, spool)
        delete(root)
        with pytest.raises(ConflictError, match="deleted permanently") as refused:
            client.create(reader.attributes)
        assert refused.value.details["reason"] == "take_deleted"
        until(lambda: not (root / ".uploads" / "take-1").exists(), "the upload is still there")
        status, receipt = delete(root, "--unsent")
        assert (status, receipt["remaining"]) == (0, [])
        assert client.recordings().num_matching == 0


def test_a_take_begun_after_the_deletion_waits_for_a_person(tmp_path, root, store):
    """A pseudonym that is used anew must not lose takes, nor return by itself."""
    record(tmp_path, "desk_1", "take-1")
    delete(root, "--unsent")
    spool = record(tmp_path, "desk_2", "take-2")
    later = datetime.now(UTC) + timedelta(seconds=5)
    writer = SpoolWriter.resume(spool)
    writer.set_attributes(writer.attributes.model_copy(update={"started_at": later}))
    writer.close()
    with station(tmp_path, "desk_2", store) as url, EpisodeStoreClient(store) as client:

        def refused():
            return httpx.get(f"{url}/v1/uploads/take-2").json()["refused"]

        until(refused, "not refused")
        assert spool.exists()
        assert main(["store", "deletions", "--store", str(root), "--readmit", GONE]) == 0
        httpx.post(f"{url}/v1/uploads/take-2/retry").raise_for_status()
        until(lambda: client.recordings().num_matching == 1, "not uploaded")


def test_a_stations_key_asks_about_its_own_takes_only(tmp_path, root):
    admin = {"name": "admin", "key": "key-of-an-administrator", "scopes": ["enrol", "store_write"]}
    settings = EpisodeStoreSettings(store_url=str(root), api_keys=[admin], commit_in_process=False)
    with served(create_store(settings)) as url:
        as_admin = {"authorization": f"Bearer {admin['key']}"}
        enrol = httpx.post(f"{url}/v1/enrolments", headers=as_admin, json={"station": "desk_1"})
        token = {"token": enrol.json()["token"]}
        key = httpx.post(f"{url}/v1/enrolments/exchange", json=token).json()["key"]
        as_station = {"authorization": f"Bearer {key}"}
        for path, more in (("check", {}), ("confirm", {"revision": "x"})):
            for name, status in (("desk_1", {200, 409}), ("desk_2", {403})):
                asked = httpx.post(
                    f"{url}/v1/deletions/{path}", headers=as_station, json={"station": name} | more
                )
                assert asked.status_code in status, (path, name, asked.text)
        assert httpx.get(f"{url}/v1/deletions", headers=as_station).status_code == 403
