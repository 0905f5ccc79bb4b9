"""Alignments over HTTP and from the shell: started once, told, refused with a reason."""

import json
import threading

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor
from services.alignment import job_table
from services.alignment.__main__ import main
from services.alignment.app import create_app
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentSettings

K_HEAD = ((60.0, 0.0, 32.0), (0.0, 60.0, 32.0), (0.0, 0.0, 1.0))
POSE = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])


def write_recording(store, recording_id, *, streams=("wrist_left", "wrist_right", "head")):
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task="stand-bottle",
        instruction="",
        domain="robot",
        station="test",
        calibration={"K_head": K_HEAD},
    )
    t_host_ns = np.arange(200, dtype=np.int64) * 10_000_000 + 10**12
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name in (*streams, "joints_measured"):
            row = POSE if name != "joints_measured" else np.full(40, 0.25)
            stream = StreamDescriptor(
                name=name,
                kind="pose" if len(row) == 7 else "robot_state",
                shape=row.shape,
                dtype="float64",
                unit="pose_m_wxyz" if len(row) == 7 else "rad",
                nominal_rate_hz=100,
            )
            writer.add_stream(stream)
            values = np.repeat(row[None], len(t_host_ns), axis=0)
            writer.append(name, values=values, t_host_ns=t_host_ns, t_device_ns=t_host_ns - 10**11)


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_recording(store, "take")
    write_recording(store, "headless", streams=("wrist_left", "wrist_right"))
    return store


@pytest.fixture
def client(store):
    app = create_app(AlignmentSettings(store_url=str(store.root)))
    transport = ASGITransport(app, raise_app_exceptions=False)
    return AsyncClient(transport=transport, base_url="http://alignment")


async def test_alignment_runs_once_and_is_told(client, store):
    started = await client.post("/v1/alignments", json={"recording_id": "take"})
    assert started.status_code == 202
    done = await client.post("/v1/alignments?wait=true", json={"recording_id": "take"})
    assert (done.status_code, done.json()["state"], done.json()["progress"]) == (200, "done", 1.0)
    alignment_id = started.json()["alignment_id"]
    again = await client.get(f"/v1/alignments/{alignment_id}")
    assert again.json() == done.json()
    assert len((await client.get("/v1/alignments")).json()["alignments"]) == 1
    assert store.list(kind="episode") == [alignment_id] == [again.json()["report"]["episode_id"]]
    assert again.json()["report"]["num_steps"] == store.open(alignment_id).num_steps


async def test_other_options_are_another_episode(client, store):
    for rate_hz in (15, 30):
        body = {"recording_id": "take", "options": {"model_rate_hz": rate_hz}}
        assert (await client.post("/v1/alignments?wait=true", json=body)).status_code == 200
    assert len(store.list(kind="episode")) == 2


@pytest.mark.parametrize(
    ("body", "status", "word"),
    [
        ({"recording_id": "nothing"}, 404, "nothing"),
        ({"recording_id": "headless"}, 422, "head"),
        ({"recording_id": "../etc"}, 422, "recording_id"),
        ({"recording_id": "take", "options": {"max_gap_ms": -1}}, 422, "max_gap_ms"),
        ({"recording_id": "take", "extra": 1}, 422, "extra"),
    ],
)
async def test_bad_requests_say_why(client, body, status, word):
    answer = await client.post("/v1/alignments", json=body)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert word in answer.json()["detail"]


async def test_failure_during_the_work_is_kept_and_raised(client):
    body = {"recording_id": "take", "options": {"min_num_steps": 500}}
    answer = await client.post("/v1/alignments?wait=true", json=body)
    assert answer.status_code == 422
    assert "without a gap" in answer.json()["detail"]
    jobs = (await client.get("/v1/alignments")).json()["alignments"]
    assert [job["state"] for job in jobs] == ["failed"]
    assert "without a gap" in jobs[0]["problem"]["detail"]


async def test_unknown_alignment_is_not_found(client):
    assert (await client.get("/v1/alignments/nothing")).status_code == 404


async def test_queue_is_bounded(store, monkeypatch):
    released = threading.Event()

    def held_back(*arguments):
        released.wait(10)
        return align_recording(*arguments)

    monkeypatch.setattr(job_table, "align_recording", held_back)
    app = create_app(AlignmentSettings(store_url=str(store.root), num_workers=1, max_waiting=1))
    bodies = [{"recording_id": "take", "options": {"min_num_steps": n}} for n in (17, 18, 19)]
    async with AsyncClient(transport=ASGITransport(app), base_url="http://alignment") as client:
        answers = [await client.post("/v1/alignments", json=body) for body in bodies]
        assert [answer.status_code for answer in answers] == [202, 202, 429]
        assert "retry-after" in answers[2].headers
        released.set()
        late = await client.post("/v1/alignments?wait=true", json=bodies[1])
        assert late.json()["state"] == "done"


def test_shell_aligns_and_writes_json(store, tmp_path, capsys):
    path = tmp_path / "reports.json"
    arguments = ["run", "take", "--store", str(store.root), "--json", str(path)]
    assert main(arguments) == 0
    assert "take aligned" in capsys.readouterr().out
    assert json.loads(path.read_text())[0]["created"] is True
    assert main(["run", "headless", "--store", str(store.root)]) == 3
    assert "head" in capsys.readouterr().err
