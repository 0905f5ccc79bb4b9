"""The way of the last take in one line, from what station and alignment answer."""

import httpx
import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse

from services.dashboard.station_view import last_take
from services.dashboard.upstream import Upstream

SESSION = {"started_at": "2026-11-24T08:00:00Z", "last_saved": "take-7"}
STORED = {"recording_id": "take-7", "uploaded": True, "stored_as": "take-7-abc"}
JOB = {"alignment_id": "take-7-abc-0", "recording_id": "take-7-abc", "options": {}, "progress": 0.4}
REPORT = {
    "episode_id": "take-7-abc-0",
    "num_steps": 81,
    "duration_s": 5.4,
    "refused_parts": [],
    "streams": {},
}
PROBLEM = {"type": "urn:dextouch:error:InvalidInputError", "title": "InvalidInput", "status": 422}


@pytest.fixture
def facts():
    return {"session": SESSION, "upload": STORED, "jobs": [], "asked": []}


@pytest.fixture
def service(facts):
    app = FastAPI()
    app.get("/v1/recorder")(lambda: {"state": "idle", "actions": [], "session": facts["session"]})

    @app.get("/v1/uploads/{recording_id}")
    def upload(recording_id: str):
        if facts["upload"] is None:
            gone = PROBLEM | {"type": "urn:dextouch:error:NotFoundError", "status": 404}
            return JSONResponse(gone | {"detail": f"{recording_id} is gone"}, 404)
        return facts["upload"]

    @app.get("/v1/alignments")
    def alignments(recording_id: str):
        facts["asked"].append(recording_id)
        return {"alignments": facts["jobs"], "num_matching": len(facts["jobs"])}

    client = httpx.AsyncClient(transport=httpx.ASGITransport(app=app), base_url="http://fake")
    return Upstream("fake", client)


GAP = {"start_s": 1.0, "stop_s": 1.5, "reason": "gap", "stream": "head"}
FROZEN, SHORTER = GAP | {"reason": "frozen"}, GAP | {"reason": "shorter", "stream": None}


async def stage(service, alignment="same"):
    view = await last_take(service, service if alignment == "same" else alignment)
    return view.stage, view.level, view.reason


async def test_nothing_was_saved(service, facts):
    facts["session"] = {"started_at": "2026-11-24T08:00:00Z"}
    assert await last_take(service, service) is None


@pytest.mark.parametrize(
    ("upload", "expected"),
    [
        ({"uploaded": False}, ("uploading", "OK", "")),
        ({"uploaded": False, "error": "store: no answer"}, ("saved", "WARN", "store: no answer")),
        (
            {"uploaded": False, "refused": True, "error": "unknown task"},
            ("refused", "ERROR", "unknown task"),
        ),
    ],
)
async def test_on_the_way_to_the_store(service, facts, upload, expected):
    facts["upload"] = {"recording_id": "take-7"} | upload
    assert await stage(service) == expected
    assert facts["asked"] == []


@pytest.mark.parametrize(
    ("job", "expected"),
    [
        ({"state": "waiting"}, ("aligning", "OK", "waits for its turn")),
        ({"state": "running"}, ("aligning", "OK", "40%")),
        ({"state": "done", "report": REPORT}, ("aligned", "OK", "5.4 s, 81 steps")),
        (
            {"state": "done", "report": REPORT | {"refused_parts": [GAP, SHORTER]}},
            ("aligned", "WARN", "5.4 s, 81 steps; stretches left out: 2 (dextouch align report)"),
        ),
        (
            {"state": "done", "report": REPORT | {"refused_parts": [FROZEN, SHORTER, FROZEN]}},
            (
                "aligned",
                "WARN",
                "5.4 s, 81 steps; stretches left out: 3 (head frozen, dextouch align report)",
            ),
        ),
        (
            {"state": "failed", "problem": PROBLEM | {"detail": "K_head is missing"}},
            ("failed", "ERROR", "K_head is missing"),
        ),
        ({"state": "cancelled"}, ("failed", "ERROR", "alignment was cancelled")),
    ],
)
async def test_in_alignment(service, facts, job, expected):
    facts["jobs"] = [JOB | {"state": "failed"}, JOB | job]
    assert await stage(service) == expected
    # Asked by the id that the take has in the store.
    assert facts["asked"] == ["take-7-abc"]


async def test_what_can_be_played_of_it(service, facts):
    async def player():
        return (await last_take(service, service)).player

    assert await player() == "recording/take-7-abc"
    facts["jobs"] = [JOB | {"state": "done", "report": REPORT}]
    assert await player() == "episode/take-7-abc-0"
    facts["jobs"] = [JOB | {"state": "failed", "problem": PROBLEM | {"detail": "no K"}}]
    assert await player() == "recording/take-7-abc"
    facts["upload"] = STORED | {"uploaded": False}
    assert await player() == ""


async def test_stored_and_no_further(service, facts):
    assert await stage(service) == ("stored", "OK", "not aligned yet")
    assert await stage(service, alignment=None) == ("stored", "OK", "")
    # A station that keeps no uploaded takes has none to show.
    facts["upload"] = None
    await stage(service)
    assert facts["asked"][-1] == "take-7"


@pytest.mark.parametrize(
    ("job", "expected"),
    [
        ({"state": "done", "report": REPORT}, ("aligned", "WARN", "5.4 s, 81 steps")),
        ({"state": "failed", "problem": PROBLEM | {"detail": "no K"}}, ("failed", "ERROR", "no K")),
    ],
)
async def test_an_incomplete_take_is_never_shown_as_in_order(service, facts, job, expected):
    facts["session"] = SESSION | {"last_incomplete": "camera_head: 2.1 s without a sample"}
    facts["jobs"] = [JOB | job]
    expected_stage, level, reason = expected
    said = f"incomplete: camera_head: 2.1 s without a sample · {reason}"
    assert await stage(service) == (expected_stage, level, said)
