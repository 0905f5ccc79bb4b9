"""Enrolment of stations: tokens work once and briefly, keys last until they are revoked."""

import hashlib
import json
import stat
import threading
from collections import Counter

import pytest
from httpx import ASGITransport, AsyncClient
from pydantic import SecretStr
from structlog.testing import capture_logs

from dextouch.errors import AccessDeniedError, ConflictError, NotFoundError, StorageError
from dextouch.serving import AccessControl
from dextouch.serving.keys import ApiKey
from services.episode_store.app import create_app
from services.episode_store.keys import Enrolments

ADMIN = ApiKey(name="admin", key=SecretStr("key-of-an-administrator"), scopes=("enrol",))
READER = ApiKey(name="reader", key=SecretStr("key-of-some-reader"), scopes=("store_read",))
AS_ADMIN = {"authorization": "Bearer key-of-an-administrator"}
MINUTES_15_S = 900


class Clock:
    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "keys" / "enrolments.json"


@pytest.fixture
def make(path, clock):
    """A service's enrolments and access control, as after a restart."""

    def start(keys=(ADMIN,)):
        enrolments, access = Enrolments(path, clock_s=clock), AccessControl(keys)
        enrolments.connect(access)
        return enrolments, access

    return start


def allows(access, key, scope="store_write"):
    try:
        return access.check(f"Bearer {key}", scope)
    except AccessDeniedError as error:
        return error.details["reason"]


def reason_of(enrolments, token):
    with pytest.raises(AccessDeniedError) as refused:
        enrolments.exchange(token, client="10.0.0.7")
    return refused.value.details["reason"]


def test_a_token_becomes_a_key_once(make):
    enrolments, access = make()
    token = enrolments.issue("desk_3", by="admin").token
    # 256 bits need 43 characters of base 64.
    assert len(token) == 43
    assert allows(access, token) == "unknown_key"
    got = enrolments.exchange(token, client="10.0.0.7")
    assert got.station == "desk_3"
    assert len(got.key) == 43
    assert got.key != token
    assert allows(access, got.key) == "desk_3"
    for scope in ("store_read", "store_expire", "store_delete", "enrol", "station"):
        assert allows(access, got.key, scope) == "missing_scope"
    assert reason_of(enrolments, token) == "used_token"
    assert reason_of(enrolments, token[:-1]) == "unknown_token"
    assert reason_of(enrolments, "") == "unknown_token"


def test_tokens_expire_after_fifteen_minutes(make, clock):
    enrolments, _ = make()
    early, late = enrolments.issue("a", by="admin"), enrolments.issue("b", by="admin")
    assert (early.expires_at - enrolments.listing().enrolments[-1].requested_at).seconds == 900
    clock.now_s += MINUTES_15_S - 1
    enrolments.exchange(early.token, client="")
    clock.now_s += 1
    assert reason_of(enrolments, late.token) == "expired_token"
    states = {one.station: one.state for one in enrolments.listing().enrolments}
    assert states == {"a": "enrolled", "b": "expired"}


def test_keys_survive_a_restart_and_tokens_do_not(make):
    enrolments, _ = make()
    key = enrolments.exchange(enrolments.issue("desk_3", by="admin").token, client="").key
    token = enrolments.issue("desk_4", by="admin").token
    again, access = make()
    assert allows(access, key) == "desk_3"
    assert reason_of(again, token) == "unknown_token"
    again.revoke("desk_3", by="admin")
    assert allows(access, key) == "unknown_key"
    _, access = make()
    assert allows(access, key) == "unknown_key"


def test_the_file_holds_no_secret_and_is_the_owners(make, path):
    enrolments, _ = make()
    token = enrolments.issue("desk_3", by="admin").token
    assert not path.exists()
    key = enrolments.exchange(token, client="10.0.0.7").key
    text = path.read_text()
    assert key not in text
    assert token not in text
    (kept,) = json.loads(text)["enrolments"]
    assert kept["key_sha256"] == hashlib.sha256(key.encode()).hexdigest()
    assert kept["enrolled_from"] == "10.0.0.7"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_station_that_is_enrolled_is_revoked_first(make):
    enrolments, access = make()
    first = enrolments.exchange(enrolments.issue("desk_3", by="admin").token, client="").key
    with pytest.raises(ConflictError, match="revoke it"):
        enrolments.issue("desk_3", by="admin")
    enrolments.revoke("desk_3", by="kim")
    second = enrolments.exchange(enrolments.issue("desk_3", by="admin").token, client="").key
    assert allows(access, first) == "unknown_key"
    assert allows(access, second) == "desk_3"
    newest, oldest = enrolments.listing().enrolments
    assert (newest.state, oldest.state, oldest.revoked_by) == ("enrolled", "revoked", "kim")


def test_the_keys_of_all_enrolled_stations_are_accepted(make):
    enrolments, access = make()
    stations = ["desk_1", "desk_2", "desk_3"]
    tokens = [enrolments.issue(station, by="admin").token for station in stations]
    keys = [enrolments.exchange(token, client="").key for token in tokens]
    _, restarted = make()
    for service in (access, restarted):
        assert [allows(service, key) for key in keys] == stations


def test_a_second_token_replaces_the_first(make):
    enrolments, _ = make()
    first, second = (enrolments.issue("desk_3", by="admin").token for _ in range(2))
    assert reason_of(enrolments, first) == "unknown_token"
    enrolments.exchange(second, client="")


def test_an_unused_token_is_revoked(make):
    enrolments, _ = make()
    token = enrolments.issue("desk_3", by="admin").token
    enrolments.revoke("desk_3", by="admin")
    assert reason_of(enrolments, token) == "unknown_token"
    with pytest.raises(NotFoundError, match="no enrolled key"):
        enrolments.revoke("desk_3", by="admin")


def test_keys_of_the_settings_stay_as_they_are(make):
    enrolments, access = make()
    with pytest.raises(ConflictError, match="key of this name"):
        enrolments.issue("admin", by="admin")
    with pytest.raises(NotFoundError, match="api_keys"):
        enrolments.revoke("admin", by="admin")
    enrolments.exchange(enrolments.issue("desk_3", by="admin").token, client="")
    assert allows(access, "key-of-an-administrator", "enrol") == "admin"


def test_a_store_without_keys_enrols_nobody_and_stays_open(make):
    enrolments, access = make(keys=())
    assert not enrolments.listing().needs_key
    with pytest.raises(ConflictError, match="no api_keys"):
        enrolments.issue("desk_3", by="loopback")
    assert not access.has_keys


def test_enrolled_keys_alone_close_no_service(make):
    enrolments, _ = make()
    enrolments.exchange(enrolments.issue("desk_3", by="admin").token, client="")
    _, access = make(keys=())
    assert not access.has_keys
    assert access.check(None, "store_write") == "loopback"


def test_of_many_stations_with_one_token_one_gets_a_key(make):
    enrolments, _ = make()
    token = enrolments.issue("desk_3", by="admin").token
    results = Counter()
    barrier = threading.Barrier(8)

    def use():
        barrier.wait()
        try:
            enrolments.exchange(token, client="")
            results["key"] += 1
        except AccessDeniedError as error:
            results[error.details["reason"]] += 1

    threads = [threading.Thread(target=use) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == {"key": 1, "used_token": 7}


def test_a_full_disk_keeps_the_token_and_refuses_revoked_keys(make, path):
    enrolments, access = make()
    token = enrolments.issue("desk_3", by="admin").token
    path.parent.write_text("in the way")
    with pytest.raises(StorageError):
        enrolments.exchange(token, client="")
    path.parent.unlink()
    key = enrolments.exchange(token, client="").key
    hidden = path.parent.with_name("hidden")
    path.parent.rename(hidden)
    path.parent.write_text("in the way")
    with pytest.raises(StorageError):
        enrolments.revoke("desk_3", by="admin")
    assert allows(access, key) == "unknown_key"
    path.parent.unlink()
    hidden.rename(path.parent)
    # A repetition saves what could not be saved.
    enrolments.revoke("desk_3", by="admin")
    _, access = make()
    assert allows(access, key) == "unknown_key"


@pytest.mark.parametrize("text", ["", "{", '{"enrolments": [{"station": "x"}]}', "[]"])
def test_a_damaged_file_is_refused(path, text):
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(StorageError, match=r"enrolments\.json: no valid list"):
        Enrolments(path)


@pytest.fixture
async def http(settings):
    app = create_app(settings.model_copy(update={"api_keys": (ADMIN, READER)}))
    transport = ASGITransport(app, client=("10.0.0.7", 4000))
    async with AsyncClient(transport=transport, base_url="http://store.lab:8081") as client:
        yield client


async def test_routes(http):
    issued = await http.post("/v1/enrolments", json={"station": "desk_3"}, headers=AS_ADMIN)
    assert issued.status_code == 201, issued.text
    assert issued.headers["cache-control"] == "no-store"
    token = issued.json()["token"]
    with capture_logs() as logs:
        got = await http.post("/v1/enrolments/exchange", json={"token": token})
        again = await http.post("/v1/enrolments/exchange", json={"token": token})
    assert got.status_code == 201
    assert got.headers["cache-control"] == "no-store"
    assert (again.status_code, again.json()["details"]["reason"]) == (403, "used_token")
    assert "ask an administrator" in again.json()["detail"]
    as_station = {"authorization": f"Bearer {got.json()['key']}"}
    assert (await http.post("/v1/recordings", json={}, headers=as_station)).status_code == 422
    assert (await http.get("/v1/recordings", headers=as_station)).status_code == 403
    listed = await http.get("/v1/enrolments", headers=AS_ADMIN)
    (one,) = listed.json()["enrolments"]
    assert (one["state"], one["requested_by"], one["enrolled_from"]) == (
        "enrolled", "admin", "10.0.0.7",
    )  # fmt: skip
    revoked = await http.post("/v1/enrolments/desk_3/revoke", headers=AS_ADMIN)
    assert revoked.json()["enrolments"][0]["state"] == "revoked"
    assert (await http.post("/v1/recordings", json={}, headers=as_station)).status_code == 401
    assert [event["event"] for event in logs] == ["enrol_station", "request_refused"]
    secrets = (token, got.json()["key"])
    assert not [one for one in secrets if one in f"{logs}{listed.text}{again.text}{revoked.text}"]


@pytest.mark.parametrize("name", ["", "Desk 3", "../x", "x" * 33, "<img>", None])
async def test_names_are_those_of_keys(http, name):
    refused = await http.post("/v1/enrolments", json={"station": name}, headers=AS_ADMIN)
    assert refused.status_code == 422


async def test_guessing_is_slowed_down(http):
    guess = {"token": "g" * 43}
    statuses = [
        (await http.post("/v1/enrolments/exchange", json=guess)).status_code for _ in range(11)
    ]
    assert statuses == [403] * 10 + [429]
    refused = await http.post("/v1/enrolments/exchange", json=guess)
    # One in six seconds of ten in a minute, rounded up.
    assert 0 < int(refused.headers["retry-after"]) <= 7
    assert refused.json()["details"]["reason"] == "too_many_wrong_keys"


async def test_a_valid_token_is_accepted_from_where_others_guess(http):
    issued = await http.post("/v1/enrolments", json={"station": "desk_3"}, headers=AS_ADMIN)
    for number in range(30):
        guess = {"token": f"{number:043}"}
        last = await http.post("/v1/enrolments/exchange", json=guess)
    assert last.status_code == 429
    token = {"token": issued.json()["token"]}
    assert (await http.post("/v1/enrolments/exchange", json=token)).status_code == 201
    # It is known, though of no more use: no guess.
    assert (await http.post("/v1/enrolments/exchange", json=token)).status_code == 403


async def test_long_and_odd_tokens_are_refused_without_repeating_them(http):
    for token in ("x" * 300, "x" * 2000, 7, None, ["x" * 43]):
        refused = await http.post("/v1/enrolments/exchange", json={"token": token})
        assert refused.status_code in {413, 422}
        assert "xxxx" not in refused.text


async def test_a_token_that_no_encoding_can_hold_is_an_unknown_one(http):
    guess = {"content": r'{"token": "\ud800"}', "headers": {"content-type": "application/json"}}
    refused = await http.post("/v1/enrolments/exchange", **guess)
    assert refused.json()["details"]["reason"] == "unknown_token"


def test_a_renewed_key_is_valid_beside_the_former_one_until_that_is_revoked(make):
    enrolments, access = make()
    with pytest.raises(ConflictError, match="renew"):
        make((ADMIN, ApiKey(**ADMIN.model_dump() | {"name": "desk-7"})))[0].issue(
            "desk-7", by="admin", renew=True
        )
    first = enrolments.exchange(enrolments.issue("desk-7", by="admin").token, client="a").key
    with pytest.raises(ConflictError, match="renew or revoke it"):
        enrolments.issue("desk-7", by="admin")
    with pytest.raises(NotFoundError, match="no former enrolled key"):
        enrolments.revoke("desk-7", by="admin", former=True)
    token = enrolments.issue("desk-7", by="admin", renew=True).token
    second = enrolments.exchange(token, client="a").key
    for _ in range(2):
        assert [allows(access, key) for key in (first, second)] == ["desk-7", "desk-7"]
        enrolments, access = make()
    enrolments.revoke("desk-7", by="admin", former=True)
    for _ in range(2):
        assert [allows(access, key) for key in (first, second)] == ["unknown_key", "desk-7"]
        enrolments, access = make()
    enrolments.revoke("desk-7", by="admin")
    assert allows(access, second) == "unknown_key"
