"""The service of studies: figures against scipy and plain loops, progress, keys, unknown names."""

import fcntl
import json
import os
import shutil

import httpx
import pytest

from services.cli.main import main
from services.evaluation.settings import StudyServiceSettings
from services.evaluation.studies import app
from services.evaluation.studies.app import create_app
from services.evaluation.studies.results import StudyResults
from tests.unit.evaluation.study_rows import (
    DEFINITION,
    ROWS,
    UNRELIABLE,
    WORLDS,
    counted,
    disagreements,
    interval,
    kendall,
    lines,
    mmrv,
    pearson,
    write_study,
)

KEYS = (
    {"name": "desk", "key": "a-key-of-some-length", "scopes": ("study_read",)},
    {"name": "other", "key": "another-key-of-length", "scopes": ("store_read",)},
)


def client(root, **settings):
    app = create_app(StudyServiceSettings(studies=root, **settings))
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1")


@pytest.fixture
def root(tmp_path):
    write_study(tmp_path / "touch")
    return tmp_path


async def read(root, path):
    async with client(root) as opened:
        answer = await opened.get(path)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def test_studies_that_are_gone_are_told(root):
    app = create_app(StudyServiceSettings(studies=root))
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as opened:
        assert (await opened.get("/v1/studies")).status_code == 200
        shutil.rmtree(root)
        answer = await opened.get("/v1/studies")
    assert answer.status_code == 503
    assert f"folder of studies {root}: is gone" in answer.json()["detail"]
    assert not root.exists()


@pytest.mark.long
async def test_rates_and_intervals_are_those_of_the_rows(root):
    found = await read(root, "/v1/studies/touch")
    rates = {(one["task"], one["policy"], one["world"]): one for one in found["rates"]}
    assert len(rates) == 2 * 3 * 3
    for place, one in rates.items():
        successes, trials = counted(*place)
        assert one["rate"] == pytest.approx(successes / trials)
        assert one["interval"] == pytest.approx(interval(*place), abs=1e-9)
        letters = ROWS[place[0]][place[1]][place[2]]
        assert (one["num_failed"], one["num_missing"]) == (letters.count("X"), letters.count("."))
        assert one["num_unreliable"] == letters.count("D")
        assert one["num_finished"] == trials + letters.count("D")
        assert one["is_comparable"]
        assert one["reasons"] == [UNRELIABLE] * ("D" in letters)


@pytest.mark.long
async def test_agreement_is_that_of_scipy_and_two_loops(root):
    found = await read(root, "/v1/studies/touch")
    agreement = {(one["task"], one["world"]): one for one in found["agreement"]}
    for task in ROWS:
        for world in WORLDS[1:]:
            one = agreement[task, world]
            assert one["figures"]["pearson"] == pytest.approx(pearson(task, world))
            assert one["figures"]["kendall"] == pytest.approx(kendall(task, world))
            assert one["figures"]["mmrv"] == pytest.approx(mmrv(task, world))
            low, high = one["intervals"]["mmrv"]
            assert 0 <= low <= high <= 1
            assert one["comments"]
    assert ("", "model") in agreement
    assert set(found["meanings"]) >= {"rate", "pearson", "mmrv", "unreliable"}


@pytest.mark.long
async def test_two_policies_are_no_correlation_in_a_task_nor_over_all(tmp_path, monkeypatch):
    for task, policies in ROWS.items():
        monkeypatch.setitem(ROWS, task, {name: policies[name] for name in ("careful", "clumsy")})
    policies = {name: {"script": "hold"} for name in ("careful", "clumsy")}
    monkeypatch.setitem(DEFINITION, "policies", policies)
    write_study(tmp_path / "touch")
    found = await read(tmp_path, "/v1/studies/touch")
    assert [one["task"] for one in found["agreement"]].count("") == 2
    for one in found["agreement"]:
        assert (one["figures"]["pearson"], one["figures"]["spearman"]) == (None, None)
        assert (one["intervals"]["pearson"], one["chance"], one["is_vague"]) == (None, None, False)
        assert one["undefined"] == "undefined (2 policies)"
        assert one["figures"]["mean_absolute_error"] is not None
        assert not any("Pearson's r is" in text for text in one["comments"])


@pytest.mark.long
async def test_disagreements_come_first_and_the_doubted_ones_last(root):
    listed = await read(root, "/v1/studies/touch/rollouts?limit=500")
    rows = listed["rollouts"]
    first = [one["disagrees"] for one in rows]
    assert first == sorted(first, reverse=True)
    unlike = [one for one in rows if one["disagrees"]]
    places = {(one["world"], one["task"], one["policy"], one["seed"]) for one in unlike}
    assert places == set(disagreements())
    assert len(unlike) == len(places)
    unreliable = [one["unreliable"] is not None for one in unlike]
    assert unreliable == sorted(unreliable)
    summary = await read(root, "/v1/studies/touch")
    assert summary["num_disagreements"] == len(places)
    assert all(one["episode_id"].startswith("rollout-") for one in unlike)
    (failed,) = [one for one in rows if one["error"]]
    assert failed["error"] == "UnavailableError: no answer"
    assert failed["episode_id"] is None


async def test_the_rollouts_of_one_cell_are_listed(root):
    path = "/v1/studies/touch/rollouts?world=model&task=stand_bottle&policy=careful"
    listed = await read(root, path)
    assert listed["num_matching"] == 8
    assert listed["rollouts"][0]["seed"] == 506
    page = await read(root, f"{path}&limit=2&offset=6")
    assert page["rollouts"] == listed["rollouts"][6:]
    only = await read(root, f"{path}&disagreements=true")
    assert [one["seed"] for one in only["rollouts"]] == [506]


async def test_progress_while_a_study_runs(tmp_path):
    path = write_study(tmp_path / "touch", unfinished=("blurred",))
    with path.open("rb") as running:
        fcntl.flock(running, fcntl.LOCK_EX)
        (one,) = (await read(tmp_path, "/v1/studies"))["studies"]
    total = 2 * 3 * 3 * 8
    assert (one["num_rollouts"], one["num_done"], one["num_failed"]) == (total, total * 2 // 3, 1)
    assert one["is_running"]
    assert (one["title"], one["worlds"]) == ("touch and sight", ["model", "blurred"])
    found = await read(tmp_path, "/v1/studies/touch")
    assert not found["summary"]["is_running"]
    blurred = [rate for rate in found["rates"] if rate["world"] == "blurred"]
    assert {(rate["rate"], rate["num_missing"]) for rate in blurred} == {(None, 8)}


async def test_new_rows_are_read_and_a_look_does_not_stop_a_study(root):
    async with client(root) as opened:
        before = (await opened.get("/v1/studies")).json()["studies"][0]["num_done"]
        path = root / "touch" / "results.jsonl"
        text = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(text[:-3]))
        os.utime(path, ns=(1, 1))
        results = StudyResults.read(root / "touch")
        with results.locked():
            assert StudyResults.is_running(root / "touch")
        assert not StudyResults.is_running(root / "touch")
    after = (await read(root, "/v1/studies"))["studies"][0]["num_done"]
    assert after == before - 3


async def test_a_running_study_is_read_again_only_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "MAX_READING_SHARE", 1e-6)
    path = write_study(tmp_path / "touch", unfinished=("blurred",))
    async with client(tmp_path) as opened:

        async def num_done():
            return (await opened.get("/v1/studies")).json()["studies"][0]["num_done"]

        assert await num_done() == 96
        path.write_text("".join(line + "\n" for line in lines()), encoding="utf-8")
        with path.open("rb") as running:
            fcntl.flock(running, fcntl.LOCK_EX)
            assert await num_done() == 96
        # Once it has ended, at once.
        assert await num_done() == 143


async def test_a_new_run_in_place_of_a_finished_one_is_read_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "MAX_READING_SHARE", 1e-6)
    write_study(tmp_path / "touch")
    async with client(tmp_path) as opened:
        assert (await opened.get("/v1/studies")).json()["studies"][0]["num_done"] == 143
        shutil.rmtree(tmp_path / "touch")
        path = write_study(tmp_path / "touch", unfinished=WORLDS)
        with path.open("rb") as running:
            fcntl.flock(running, fcntl.LOCK_EX)
            (one,) = (await opened.get("/v1/studies")).json()["studies"]
    assert (one["num_done"], one["is_running"]) == (0, True)


async def test_a_study_of_another_version_is_told(root, capsys):
    path = root / "touch" / "results.jsonl"
    header, *rows = path.read_text().splitlines(keepends=True)
    changed = json.loads(header) | {"definition": DEFINITION | {"shuffled": True}}
    path.write_text("".join([json.dumps(changed) + "\n", *rows]))
    expected = "the definition is not one of this version (shuffled: "
    (one,) = (await read(root, "/v1/studies"))["studies"]
    assert expected in one["problem"]
    assert main(["study", "report", str(root / "touch")]) == 3
    assert expected in capsys.readouterr().err


async def test_damaged_studies_are_listed_with_the_reason(root):
    (root / "torn").mkdir()
    (root / "torn" / "results.jsonl").write_bytes(b"[]\n")
    (root / "empty").mkdir()
    listed = {one["name"]: one for one in (await read(root, "/v1/studies"))["studies"]}
    assert set(listed) == {"touch", "torn"}
    assert "line 1" in listed["torn"]["problem"]
    async with client(root) as opened:
        answer = await opened.get("/v1/studies/torn")
    assert answer.status_code == 422 or answer.status_code >= 500
    assert "line 1" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/v1/studies/none", 404),
        ("/v1/studies/..%2Ftouch", 404),
        ("/v1/studies/%2e%2e", 404),
        ("/v1/studies/none/rollouts", 404),
        ("/v1/studies/touch/rollouts?limit=501", 422),
        ("/v1/studies/touch/rollouts?offset=-1", 422),
        ("/v1/studies/touch/rollouts?wolrd=model", 422),
    ],
)
async def test_unknown_names_and_limits(root, path, status):
    async with client(root) as opened:
        answer = await opened.get(path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.long
async def test_reading_needs_its_scope(root):
    async with client(root, api_keys=KEYS) as opened:
        for path in ("/v1/studies", "/v1/studies/touch", "/v1/studies/touch/rollouts"):
            for key, status in ((None, 401), (KEYS[1]["key"], 403), (KEYS[0]["key"], 200)):
                headers = {"authorization": f"Bearer {key}"} if key else {}
                assert (await opened.get(path, headers=headers)).status_code == status
