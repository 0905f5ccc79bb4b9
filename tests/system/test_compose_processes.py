"""docker-compose.yml as plain processes: a recording goes in, an episode and a rollout come out."""

from pathlib import Path

import httpx
import numpy as np
import pytest

from dextouch.clients import RolloutClient
from dextouch.hands.actions import ACTION_DIM
from tests.programs import needed_program
from tests.system.compose_processes import ComposeProcesses, keys_of, record_take, wait_for

ROOT = Path(__file__).parents[2]
KEYS = keys_of(ROOT / "docker-compose.yml")
KEY = KEYS["DEXTOUCH_KEY"]
TAKE_S = 4.0
UPLOAD_TIMEOUT_S = 30.0
ALIGNMENT_TIMEOUT_S = 300.0
STOP_LIMIT_S = 10.0
PRETRAINED = ROOT / "services/world_model/pretrained"
# A working tree in which the model has not been trained yet has nothing to serve there.
WITHOUT = () if list(PRETRAINED.glob("*.safetensors")) else ("world_model",)
# It finds its workers by the names of a compose network; test_worker_kills.py runs it here.
OTHERWISE_TESTED = ("gateway",)

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def composed(tmp_path_factory):
    """All lasting services of the compose file, healthy."""
    needed_program("redis-server", package="redis-server")
    processes = ComposeProcesses(
        ROOT / "docker-compose.yml",
        tmp_path_factory.mktemp("compose"),
        KEYS,
        WITHOUT + OTHERWISE_TESTED,
    )
    try:
        processes.start()
        yield processes
    finally:
        processes.stop()


@pytest.fixture(scope="module")
def ask(composed):
    """Ask a service; the logs of all are part of a failure's message."""
    headers = {"authorization": f"Bearer {KEY}"}
    with httpx.Client(headers=headers, timeout=60, trust_env=False) as client:

        def ask(method, service, path, **more):
            answer = client.request(method, composed.running[service].url + path, **more)
            assert answer.is_success, f"{answer.status_code} {answer.text}\n{composed.logs()}"
            return answer.json()

        yield ask


@pytest.fixture(scope="module")
def recording_id(composed, ask):
    """One take of the mock station, uploaded to the store."""
    recording_id, _ = record_take(ask, TAKE_S, composed.logs)

    def stored():
        recordings = ask("GET", "episode_store", "/v1/recordings")["recordings"]
        return recording_id in [item["recording_id"] for item in recordings]

    wait_for("upload", UPLOAD_TIMEOUT_S, stored, composed.logs)
    return recording_id


def test_the_recording_is_aligned_unasked(composed, ask, recording_id):
    def ended():
        jobs = ask("GET", "alignment", "/v1/alignments")["alignments"]
        # With ordinary options, so that on a busy machine it may well end as failed.
        states = {job["state"] for job in jobs if job["recording_id"] == recording_id}
        return states and states <= {"done", "failed"}

    wait_for("alignment", ALIGNMENT_TIMEOUT_S, ended, composed.logs)


def test_a_recording_becomes_an_episode(ask, recording_id):
    # Mocks play in real time: a busy machine starves them, and their small rings overflow.
    body = {"recording_id": recording_id, "options": {"max_gap_ms": 1000}}
    job = ask("POST", "alignment", "/v1/alignments", params={"wait": True}, json=body)
    assert job["state"] == "done"
    episode_id = job["report"]["episode_id"]
    detail = ask("GET", "episode_store", f"/v1/episodes/{episode_id}")
    attributes = detail["attributes"]
    assert (attributes["origin"], attributes["task"]) == ("recorded", "stand_bottle")
    # 15 steps a second of what was recorded, less the edges that not every stream covers.
    assert detail["num_steps"] >= 15 * (TAKE_S - 1.0)
    lineage = [(entry["kind"], entry["id"]) for entry in attributes["lineage"]]
    assert ("recording", recording_id) in lineage
    streams = {stream["name"] for stream in attributes["streams"]}
    assert {"tactile_left", "tactile_right", "wrist_left", "head", "action"} <= streams


@pytest.mark.parametrize("service", ["twin"])
def test_a_rollout_goes_on(composed, ask, service):
    names = [world["name"] for world in ask("GET", service, "/v1/worlds")["worlds"]]
    with RolloutClient(composed.running[service].url, api_key=KEY) as client:
        rollout = client.start(
            world=names[0], task="stand_bottle", seed=20_000, instruction="stand the bottle up"
        )
        hold = np.repeat(rollout.observation.action_reached[-1:], 8, axis=0)
        assert hold.shape == (8, ACTION_DIM)
        observation = rollout.step(hold)
        rollout.close()
    assert len(observation) == 8
    assert np.isfinite(observation.tactile_kpa).all()


def test_the_dashboard_shows_it(composed, recording_id):
    url = composed.running["dashboard"].url
    with httpx.Client(base_url=url, timeout=30, trust_env=False) as browser:
        assert browser.get("/v1/overview").status_code == 401
        assert browser.post("/sign_in", data={"key": KEY}).status_code == 303
        overview = browser.get("/v1/overview").json()
    levels = {service["name"]: service["level"] for service in overview["services"]}
    services = {"acquisition", "episode_store", "alignment", "twin", "world_model", "studies"}
    assert set(levels) == services
    assert {name for name, level in levels.items() if level != "OK"} == set(WITHOUT)
    assert len(overview["station"]["streams"]) >= 10
    assert recording_id in [take["name"] for take in overview["takes"]]


def test_keys_are_asked_for(composed):
    for service, path in (
        ("acquisition", "/v1/recorder"),
        ("episode_store", "/v1/recordings"),
        ("alignment", "/v1/alignments"),
        ("twin", "/v1/worlds"),
        ("world_model", "/v1/worlds"),
    ):
        if service in WITHOUT:
            continue
        answer = httpx.get(composed.running[service].url + path, trust_env=False)
        assert answer.status_code == 401, service
        assert answer.headers["content-type"] == "application/problem+json"


def test_the_key_of_a_service_opens_only_what_it_needs(composed):
    """As a station, or who reads its environment: no other service, and nothing of the store."""
    for variable, service, path, status in (
        ("DEXTOUCH_STATION_KEY", "episode_store", "/v1/recordings", 403),
        ("DEXTOUCH_STATION_KEY", "episode_store", "/v1/enrolments", 403),
        ("DEXTOUCH_STATION_KEY", "alignment", "/v1/alignments", 401),
        ("DEXTOUCH_STATION_KEY", "acquisition", "/v1/recorder", 401),
        ("DEXTOUCH_EVALUATION_KEY", "twin", "/v1/worlds", 200),
        ("DEXTOUCH_EVALUATION_KEY", "twin", "/v1/watch", 403),
        ("DEXTOUCH_EVALUATION_KEY", "episode_store", "/v1/recordings", 401),
        ("DEXTOUCH_DASHBOARD_KEY", "episode_store", "/v1/recordings", 200),
    ):
        headers = {"authorization": f"Bearer {KEYS[variable]}"}
        url = composed.running[service].url + path
        answer = httpx.get(url, headers=headers, trust_env=False)
        assert answer.status_code == status, (variable, service, path)
    with httpx.Client(base_url=composed.running["dashboard"].url, trust_env=False) as browser:
        for variable in KEYS.keys() - {"DEXTOUCH_KEY"}:
            assert browser.post("/sign_in", data={"key": KEYS[variable]}).status_code == 401


# Last: it ends the services.
def test_all_end_in_time(composed):
    composed.stop()
    slow = {
        name: running.exit_s
        for name, running in composed.running.items()
        if running.exit_s is None or running.exit_s > STOP_LIMIT_S
    }
    assert not slow, composed.logs()
