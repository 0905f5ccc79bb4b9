"""The audit log: every change is one durable line, whatever names it holds and however it ends."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from datetime import UTC, datetime

import httpx
import pytest
from dashboard_fakes import broken_upstream

from dextouch.errors import InvalidInputError
from services.dashboard.app import create_app
from services.dashboard.audit import (
    ACTIONS,
    ALL_ACTIONS,
    NUM_FILES,
    AuditEntry,
    AuditLog,
    RotatedLines,
)
from services.dashboard.pages import page_router
from services.dashboard.routes import FORWARDED
from services.dashboard.settings import DashboardSettings

KEY = "a-key-of-some-length"
OPERATOR = {"name": "desk-3", "key": KEY, "scopes": ("operate",)}
BIDI = "take\u202e7"
CHILD = """
import sys
from datetime import UTC, datetime
from pathlib import Path
from services.dashboard.audit import AuditEntry, AuditLog
log = AuditLog(Path(sys.argv[1]), max_bytes=2**20)
number = 0
while True:
    number += 1
    now = datetime.now(UTC)
    log.write(AuditEntry(at=now, person="p", action="delete", target=str(number), status=200))
    print(number, flush=True)
"""


def entry(number=0, person="desk-3", **more):
    at = datetime.fromtimestamp(1_700_000_000 + number, UTC)
    fields = {"action": "delete", "target": f"take-{number}", "status": 200} | more
    return AuditEntry(at=at, person=person, **fields)


def kept_lines(folder):
    return [line for path in sorted(folder.iterdir()) for line in path.read_bytes().splitlines()]


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data" / "audit"


@pytest.fixture
def connect(make_app):
    def make(**settings):
        transport = httpx.ASGITransport(make_app(**settings), raise_app_exceptions=False)
        return httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1")

    return make


async def newest(client, **query):
    answer = await client.get("/v1/audit", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def test_changes_are_kept_with_person_action_target_and_result(connect, folder):
    items = [{"kind": "recording", "id": "take-1"}, {"kind": "episode", "id": "take-2"}]
    async with connect(api_keys=(OPERATOR,), audit_folder=folder, station="desk") as client:
        await client.post("/sign_in", data={"key": "another-key-of-length"})
        await client.post("/sign_in", data={"key": KEY})
        await client.post("/v1/recorder/record", json={})
        await client.post("/v1/recorder/arm", json={"task": "fold", "instruction": "private"})
        await client.post("/v1/recorder/record", json={"recording_id": "take-9"})
        await client.post("/v1/episode_store/trash", json={"items": items})
        body = {"items": items[:1], "verdict": "rejected", "reason": "private"}
        await client.post("/v1/episode_store/catalog/reviews", json=body)
        await client.get("/v1/overview")
        page = await newest(client)
        await client.post("/sign_out", headers={"content-length": "0"})
    rows = [(e["person"], e["action"], e["target"], e["status"]) for e in page["entries"]]
    # The fake station refuses to record before it is armed, and the fake store knows no trash.
    assert rows[::-1] == [
        ("not signed in", "sign in", "", 401),
        ("desk-3", "sign in", "", 303),
        ("desk-3", "recorder: record", "desk", 409),
        ("desk-3", "recorder: arm", "desk, fold", 200),
        ("desk-3", "recorder: record", "desk, take-9", 200),
        ("desk-3", "delete", "take-1, take-2", 503),
        ("desk-3", "review", "rejected, take-1", 503),
    ]
    assert page["folder"] == str(folder)
    # The sign-out came after the page was read.
    lines = kept_lines(folder)
    assert len(lines) == len(rows) + 1
    text = b"\n".join(lines)
    for secret in (KEY, "another-key", "private"):
        assert secret.encode() not in text


async def test_open_access_is_named_and_an_unset_folder_said(connect):
    async with connect() as client:
        await client.post("/v1/recorder/arm", json={})
        page = await newest(client)
    assert [e["person"] for e in page["entries"]] == ["open access"]
    assert page["folder"] is None


async def test_filters_and_limit(connect):
    async with connect() as client:
        for action in ("arm", "record", "arm", "stop", "arm"):
            await client.post(f"/v1/recorder/{action}", json={})
        arms = await newest(client, action="recorder: arm", limit=2)
        nobody = await newest(client, person="somebody")
        refused = await client.get("/v1/audit?limit=0")
    assert [e["action"] for e in arms["entries"]] == ["recorder: arm"] * 2
    assert arms["has_more"]
    assert nobody["entries"] == []
    assert nobody["people"] == ["open access"]
    assert refused.status_code == 422


async def test_requests_that_are_refused_early_are_kept(connect, folder):
    async with connect(api_keys=(OPERATOR,), audit_folder=folder) as client:
        evil = {"origin": "http://evil.example"}
        assert (await client.post("/sign_in", data={"key": KEY}, headers=evil)).status_code == 403
        assert (await client.post("/v1/recorder/stop", json={})).status_code == 401
        assert (await client.get("/v1/audit")).status_code == 401
        assert (await client.post("/no/such/page")).status_code in {401, 404}
    rows = [json.loads(line) for line in kept_lines(folder)]
    assert [(r["action"], r["status"]) for r in rows] == [("sign in", 403), ("recorder: stop", 401)]


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["a\nb", "<img src=x>", BIDI, "\x00\x1b[31m", "é\ud83d\ude00" * 500]
)
async def test_hostile_names_stay_one_line_of_text(connect, folder, name):
    async with connect(audit_folder=folder) as client:
        body = json.dumps({"items": [{"id": name}, {"id": 3}, 7], "verdict": ["x"]})
        headers = {"content-type": "application/json"}
        await client.post("/v1/episode_store/trash", content=body, headers=headers)
        target = (await newest(client))["entries"][0]["target"]
    (line,) = kept_lines(folder)
    assert line.isascii()
    assert target.isprintable()
    assert len(target) <= 128
    if name.isprintable() and len(name) <= 128:
        assert target == name


async def test_a_key_in_a_wrong_place_is_hidden(connect, folder):
    async with connect(api_keys=(OPERATOR,), audit_folder=folder) as client:
        await client.post("/sign_in", data={"key": KEY})
        await client.post(f"/v1/recorder/{KEY}", json={"recording_id": KEY})
        await client.post(f"/v1/uploads/{KEY}/retry?station={KEY}")
    assert KEY.encode() not in b"".join(kept_lines(folder))


async def test_bodies_that_are_no_json_and_long_lists(connect, folder):
    ids = [f"recording-{number:04}" for number in range(1000)]
    async with connect(audit_folder=folder) as client:
        headers = {"content-type": "application/json"}
        for content in (b"{", b"[" * 60_000, b"[1]", b"\xff"):
            await client.post("/v1/alignment/alignments", content=content, headers=headers)
        await client.post("/v1/alignment/alignments", json={"recording_ids": ids})
        targets = [e["target"] for e in (await newest(client))["entries"]]
    assert targets[1:] == [""] * 4
    shown = targets[0].split(", ")
    assert shown[:-1] == ids[: len(shown) - 1]
    assert shown[-1] == f"and {1000 - len(shown) + 1} more"


async def test_a_route_that_fails_is_kept(upstreams, folder, monkeypatch):
    app = create_app(DashboardSettings(audit_folder=folder), upstreams)

    async def fail(*_, **__):
        raise RuntimeError

    monkeypatch.setattr(type(upstreams["acquisition"]), "read", fail)
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        assert (await client.post("/v1/recorder/arm", json={})).status_code == 500
    (line,) = kept_lines(folder)
    assert json.loads(line)["status"] == 500


async def test_tokens_that_stations_used_are_entries(make_app, services, folder):
    """Only the store sees them; the dashboard adds them when the log is read."""
    asked_at = "2026-05-01T12:00:00Z"
    one = {"station": "desk_9", "state": "enrolled", "requested_at": asked_at}
    one |= {"requested_by": "internal", "expires_at": "2026-05-01T12:15:00Z"}
    used = one | {"enrolled_at": "2026-05-01T12:07:00Z", "enrolled_from": "10.0.0.9"}
    waiting = one | {"station": "desk_8", "state": "waiting"}
    services.enrolments = [waiting, used]
    transport = httpx.ASGITransport(make_app(audit_folder=folder), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        await client.post("/v1/episode_store/enrolments", json={"station": "desk_9"})
        await client.post("/v1/episode_store/enrolments/desk_9/revoke", json={})
        page = await newest(client)
        only = await newest(client, action="use enrolment token")
        services.enrolments = ["damaged"]
        without = await newest(client)
    rows = [(e["action"], e["target"], e["person"]) for e in page["entries"]]
    assert rows == [
        ("revoke station", "desk_9", "open access"),
        ("enrol station", "desk_9", "open access"),
        ("use enrolment token", "desk_9", "station desk_9"),
    ]
    (entry_of_use,) = only["entries"]
    assert (entry_of_use["at"], entry_of_use["client"]) == ("2026-05-01T12:07:00Z", "10.0.0.9")
    assert page["no_used_tokens"] == ""
    assert "/v1/enrolments" in without["no_used_tokens"]
    assert len(without["entries"]) == 2


def is_unsafe(route):
    return bool(route.methods - {"GET", "HEAD", "OPTIONS"})


def test_every_route_that_changes_something_has_an_action(make_app):
    app = make_app()
    settings, sessions = app.state.settings, app.state.sessions
    found = {route.path for route in page_router(settings, sessions).routes if is_unsafe(route)}
    found |= {f"/v1/{one.service}{one.path}" for one in FORWARDED if one.method != "GET"}
    documented = app.openapi()["paths"].items()
    found |= {path for path, methods in documented if methods.keys() - {"get", "head"}}
    assert "/v1/recorder/{action}" in found
    assert found == set(ACTIONS)
    assert "recorder: discard" in ALL_ACTIONS
    assert "recorder" not in ALL_ACTIONS


def test_a_torn_line_is_skipped_and_counted(folder):
    AuditLog(folder, max_bytes=2**20).write(entry(1))
    (path,) = folder.iterdir()
    with path.open("ab") as file:
        file.write(b'{"at": "2026-01-01T00:00')
    log = AuditLog(folder, max_bytes=2**20)
    log.write(entry(2))
    page = log.newest(10)
    assert [e.target for e in page.entries] == ["take-2", "take-1"]
    assert page.num_damaged == 1


@pytest.mark.long
def test_what_was_told_survives_a_kill(folder):
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(folder)], stdout=subprocess.PIPE, text=True, cwd="."
    )
    told = [int(child.stdout.readline()) for _ in range(20)]
    child.send_signal(signal.SIGKILL)
    told += [int(line) for line in child.stdout.read().splitlines()]
    child.wait(30)
    child.stdout.close()
    log = AuditLog(folder, max_bytes=2**20)
    log.write(entry(7, person="after"))
    page = log.newest(1000)
    kept = [int(e.target) for e in page.entries if e.person == "p"][::-1]
    # Of the last one it may be that only its end was not told.
    assert kept in (told, [*told, told[-1] + 1])
    assert "after" in page.people


def test_old_files_make_room_for_new_ones(folder):
    lines = RotatedLines(folder, "audit", max_bytes=NUM_FILES * 1000, sync=False)
    folder.mkdir(parents=True)
    for number in range(1000):
        lines.append(f"{number:03}".encode().rjust(99))
        sizes = [path.stat().st_size for path in folder.iterdir()]
        assert len(sizes) <= NUM_FILES
        assert sum(sizes) <= NUM_FILES * 1000
    kept = [int(line) for line in lines.newest_first()]
    # Ten lines of 100 bytes in each file.
    assert kept == list(range(999, 999 - 80, -1))


@pytest.mark.long
def test_people_who_cannot_sign_in_do_not_displace_the_others(folder):
    log = AuditLog(folder, max_bytes=2**20)
    log.write(entry(0))
    for number in range(1, 8000):
        log.write(entry(number, person="not signed in", action="sign in", target=""))
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 2**20
    assert [e.target for e in log.newest(1, person="desk-3").entries] == ["take-0"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_refused_at_the_start(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InvalidInputError, match="audit_folder"):
        AuditLog(tmp_path, max_bytes=2**20)


def test_a_folder_that_cannot_be_made_is_refused_at_the_start(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match=r"audit_folder .*cannot be created"):
        AuditLog(tmp_path / "file" / "audit", max_bytes=2**20)


def test_a_full_disk_loses_nothing_silently(folder, monkeypatch):
    log = AuditLog(folder, max_bytes=2**20)
    log.write(entry(1))

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("services.dashboard.audit.os.writev", full)
        log.write(entry(2))
    log.write(entry(3))
    page = log.newest(10)
    assert [e.target for e in page.entries] == ["take-3", "take-2", "take-1"]
    assert page.num_lost == 1


async def test_the_entry_is_written_before_the_answer(upstreams, folder):
    app = create_app(DashboardSettings(audit_folder=folder), upstreams)
    seen = []
    scope = {"type": "http", "method": "POST", "path": "/v1/recorder/arm", "scheme": "http"}
    scope |= {"raw_path": b"/v1/recorder/arm", "query_string": b"", "root_path": ""}
    headers = [(b"host", b"127.0.0.1"), (b"content-type", b"application/json")]
    scope |= {"headers": headers, "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80)}

    async def receive():
        return {"type": "http.request", "body": b"{}", "more_body": False}

    async def send(message):
        if message["type"] == "http.response.start":
            seen.extend(kept_lines(folder))

    await asyncio.wait_for(app(scope, receive, send), 30)
    assert len(seen) == 1


async def test_an_unreachable_service_is_a_result(folder):
    app = create_app(
        DashboardSettings(audit_folder=folder), {"acquisition": broken_upstream("acquisition")}
    )
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        await client.post("/v1/recorder/arm", json={})
    assert json.loads(kept_lines(folder)[0])["status"] == 503
