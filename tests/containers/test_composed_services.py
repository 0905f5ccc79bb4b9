"""Services of the compose file from their images: a take becomes an episode, then a rollout."""

import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from dextouch.clients import EpisodeStoreClient, RolloutClient
from dextouch.schemas import Observation
from services.dashboard.pages import SCREENS
from tests.system.compose_processes import record_take, wait_for

pytestmark = pytest.mark.containers
TAKE_S = 4.0
UPLOAD_TIMEOUT_S = 60.0
ALIGNMENT_TIMEOUT_S = 300.0
CAMERA = "camera_head"
TMP = "/tmp"  # noqa: S108 - of the container


@pytest.fixture(scope="module")
def take(composed, ask):
    """One take of the mock station, uploaded to the store."""
    recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)

    def stored():
        found = ask("GET", "episode_store", "/v1/recordings")["recordings"]
        return [item for item in found if item["recording_id"] == recording_id]

    wait_for("upload", UPLOAD_TIMEOUT_S, stored, composed.logs)
    assert stored()[0]["num_samples"] == num_samples
    return recording_id


@pytest.fixture(scope="module")
def episode_id(composed, ask, take):
    """The episode of the take, which was aligned without a request for it."""

    def jobs():
        found = ask("GET", "alignment", "/v1/alignments")["alignments"]
        return [job for job in found if job["recording_id"] == take]

    def ended():
        return {job["state"] for job in jobs()} and {j["state"] for j in jobs()} <= {
            "done",
            "failed",
        }

    wait_for("alignment", ALIGNMENT_TIMEOUT_S, ended, composed.logs)
    done = [job for job in jobs() if job["state"] == "done"]
    if not done:
        # A busy machine starves mocks, which play in real time, so that streams have gaps.
        assert "gap" in str(jobs()), jobs()
        body = {"recording_id": take, "options": {"max_gap_ms": 1000}}
        done = [ask("POST", "alignment", "/v1/alignments", params={"wait": True}, json=body)]
    assert done[0]["state"] == "done"
    return done[0]["report"]["episode_id"]


def test_nothing_but_volumes_and_tmp_can_be_written(composed, engine):
    code = "import os, sys; print([p for p in sys.argv[1:] if os.access(p, os.W_OK)])"
    places = ("/", "/data", "/opt/code", TMP, "/data/store", "/data/spool", "/data/studies")
    for name, writable in (
        ("episode_store", [TMP, "/data/store"]),
        ("alignment", [TMP, "/data/store"]),
        ("acquisition", [TMP, "/data/spool"]),
        ("studies", [TMP]),
        ("twin", [TMP]),
        ("world_model", [TMP]),
        ("dashboard", [TMP]),
    ):
        done = engine.podman("exec", name, "python", "-c", code, *places)
        assert done.stdout.strip() == str(writable), name
        status = engine.podman("exec", name, "cat", "/proc/1/status").stdout
        assert re.search(r"^Uid:\t10001\t10001\t10001\t10001$", status, re.M), name
        for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb"):
            assert re.search(rf"^Cap{kind}:\t0{{16}}$", status, re.M), name
        assert re.search(r"^NoNewPrivs:\t1$", status, re.M), name
        assert not engine.podman("diff", name).stdout.strip().replace("C /etc", ""), name


def test_services_of_others_have_no_privileges(composed, engine):
    for name in ("redis", "gateway"):
        status = Path(f"/proc/{composed.pid(name)}/status").read_text()
        assert not re.search(r"^Uid:\t0\t", status, re.M), name
        for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb"):
            assert re.search(rf"^Cap{kind}:\t0{{16}}$", status, re.M), name
        assert re.search(r"^NoNewPrivs:\t1$", status, re.M), name


def test_a_take_becomes_an_episode(ask, episode_id, take):
    detail = ask("GET", "episode_store", f"/v1/episodes/{episode_id}")
    # 15 steps a second of the longest part without gaps, which are many where the machine is busy.
    assert 1 < detail["num_steps"] <= 15 * (TAKE_S + 1.0)
    lineage = [(entry["kind"], entry["id"]) for entry in detail["attributes"]["lineage"]]
    assert ("recording", take) in lineage


@pytest.fixture
def roll_out(composed, key, episode_id):
    """Continue the start of the episode in the served world model for 8 steps; its description."""

    def roll_out():
        with EpisodeStoreClient(composed.url("episode_store"), api_key=key) as store:
            window = store.window(episode_id, 0, 1, cameras=(CAMERA,))
        first = Observation(
            first_step=0,
            images={CAMERA: window.images[CAMERA]},
            tactile_kpa=window.tactile_kpa,
            action_reached=window.actions,
            reached_is_measured=True,
        )
        asked = {"task": "stand_bottle", "instruction": "stand the bottle up", "seed": 1}
        # Through the gateway, which finds the container by its name.
        with RolloutClient(composed.url("gateway", 8085), api_key=key) as client:
            (world,) = client.worlds()
            start = (first, window.anchor, window.K_head)
            with client.start(world=world.name, init=start, **asked) as rollout:
                seen = rollout.step(np.repeat(window.actions, 8, axis=0))
        assert len(seen) == 8
        assert np.isfinite(seen.tactile_kpa).all()
        assert seen.images[CAMERA].shape[0] == 8
        return world

    return roll_out


def test_the_world_model_goes_on_from_the_start_of_the_episode(roll_out):
    roll_out()


def test_a_rollout_in_the_twin_goes_on(composed, key):
    asked = {"task": "stand_bottle", "instruction": "stand the bottle up", "seed": 20_000}
    with (
        RolloutClient(composed.url("gateway", 8084), api_key=key) as client,
        client.start(world="twin", **asked) as rollout,
    ):
        seen = rollout.step(np.repeat(rollout.observation.action_reached[-1:], 8, axis=0))
    assert len(seen) == 8
    assert np.isfinite(seen.tactile_kpa).all()


def test_an_operator_signs_in(composed, key, take, open_page):
    page = open_page()
    page.goto(composed.url("dashboard"))
    page.get_by_label("Key").fill(key)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("heading", name="Recorder")).to_be_visible()
    expect(page.locator("#link")).to_have_text("live")
    failures = []
    page.on("pageerror", lambda error: failures.append(error))  # noqa: PLW0108 - not a builtin
    page.on("response", lambda answer: failures.append(answer) if answer.status >= 500 else None)
    for screen in [screen for screen in SCREENS if not screen.within]:
        page.goto(composed.url("dashboard") + screen.path)
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        # Pages that ask again and again are never idle: what they need at first is asked by then.
        page.wait_for_timeout(2000)
        assert not failures, f"{screen.path}: {failures}"


def test_a_job_writes_into_the_store(composed, ask):
    def num_episodes():
        return len(ask("GET", "episode_store", "/v1/episodes")["episodes"])

    before = num_episodes()
    words = ("dextouch", "twin", "record", "--task", "stand_bottle", "--seeds", "0:1")
    done = composed.run_once("twin_episodes", *words, "--store", "/data/store")
    assert done.returncode == 0, done.stdout + done.stderr
    wait_for("episode", 60, lambda: num_episodes() == before + 1, composed.logs)


def test_what_the_training_job_writes_is_served(composed, engine, roll_out):
    words = ("dextouch", "twin", "record", "--task", "stand_bottle", "--seeds", "1:5")
    done = composed.run_once("twin_episodes", *words, "--store", "/data/store")
    assert done.returncode == 0, done.stdout + done.stderr
    words = composed.services["training"]["command"]
    path = words[words.index("--output") + 1]
    # The command of the job, but short: the way of the file is tested, not what was learned.
    done = composed.run_once("training", *words, "--max-steps", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    composed.down("world_model")
    composed.up("world_model", environment={"DEXTOUCH_WORLD_MODEL_CHECKPOINT": path})
    try:
        digest = engine.podman("exec", "world_model", "sha256sum", path).stdout.split()[0]
        assert roll_out().digest == digest
    finally:
        composed.down("world_model")
        composed.up("world_model")


def test_keys_are_required(composed, engine):
    code = (
        "import sys, urllib.request, urllib.error\n"
        "try: urllib.request.urlopen(sys.argv[1])\n"
        "except urllib.error.HTTPError as error: print(error.code, error.headers['content-type'])"
    )
    for name, path in (
        ("acquisition", "/v1/recorder"),
        ("episode_store", "/v1/recordings"),
        ("alignment", "/v1/alignments"),
        ("twin", "/v1/worlds"),
        ("world_model", "/v1/worlds"),
    ):
        # Across the compose network.
        words = ("exec", "dashboard", "python", "-c", code, f"http://{name}:8000{path}")
        assert engine.podman(*words).stdout == "401 application/problem+json\n", name
