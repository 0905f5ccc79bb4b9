"""The routes: what goes in comes out, filters filter, and every refusal is a problem+json."""

import json

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient
from pydantic import SecretStr

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeStore, decode_window, encode_window
from dextouch.errors import (
    AccessDeniedError,
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.geometry import transform
from dextouch.serving.keys import ApiKey
from services.cli.main import main
from services.episode_store import command_line
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
def http(settings):
    return AsyncClient(transport=ASGITransport(create_app(settings)), base_url="http://localhost")


def test_windows_and_samples_are_those_of_the_reader(start, store):
    reader = write_episode(store, "e-1")
    client = start()
    got, expected = client.window("e-1", 2, 5), reader.window(2, 5)
    np.testing.assert_array_equal(got.images["camera_head"], expected.images["camera_head"])
    for name in ("tactile_kpa", "tactile_valid", "actions", "t_ref_ns", "K_head"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    np.testing.assert_array_equal(got.anchor.as_tuple(), expected.anchor.as_tuple())
    np.testing.assert_allclose(
        got.anchor.T_world_wrist_left, transform(np.eye(3), np.array([0.02, 0, 0])), atol=1e-12
    )
    assert got.tactile_valid[:, 1].tolist() == [False] * 5
    assert client.window("e-1", 0, 1, cameras=()).images == {}
    samples = client.episode_samples("e-1", "tactile_left", start_ns=1, stop_ns=200_000_001)
    np.testing.assert_array_equal(samples.values, reader.read("tactile_left").values[1:4])
    detail = client.episode("e-1")
    assert detail.attributes == reader.attributes
    assert (detail.num_steps, detail.content_sha256) == (9, reader.content_sha256)


def test_the_catalog_filters_and_follows_the_store(start, store):
    client = start()
    assert client.episodes().num_matching == 0
    write_episode(store, "e-1")
    write_episode(store, "e-2", task="stack_bowls")
    write_episode(store, "e-3", domain="human", success=None)
    listed = client.episodes()
    assert [e.episode_id for e in listed.episodes] == ["e-1", "e-2", "e-3"]
    assert [e.episode_id for e in client.episodes(task="stack_bowls").episodes] == ["e-2"]
    assert [e.episode_id for e in client.episodes(domain="human").episodes] == ["e-3"]
    assert client.episodes(origin="imagined").num_matching == 0
    store.delete("e-2")
    write_episode(store, "e-1b")
    (store.root / "episodes" / "e-3" / "commit.json").write_bytes(b"{}")
    assert [e.episode_id for e in client.episodes().episodes] == ["e-1", "e-1b"]
    store.delete("e-1")
    write_episode(store, "e-1", task="stack_bowls")
    assert [e.episode_id for e in client.episodes(task="stack_bowls").episodes] == ["e-1"]


async def test_pages(http, store):
    for index in range(4):
        write_episode(store, f"e-{index}")
    body = (await http.get("/v1/episodes", params={"limit": 2, "offset": 1})).json()
    assert [e["episode_id"] for e in body["episodes"]] == ["e-1", "e-2"]
    assert body["num_matching"] == 4
    assert (await http.get("/v1/episodes", params={"success": False})).json()["num_matching"] == 0
    assert (await http.get("/v1/episodes", params={"limit": 0})).status_code == 422


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "path", "status", "words"),
    [
        ("GET", "/v1/episodes/none", 404, "none"),
        ("GET", "/v1/episodes/..%2Fx", 404, "x"),
        ("GET", "/v1/episodes/.x", 422, "episode id"),
        ("GET", "/v1/episodes?domain=cat", 422, "domain"),
        ("GET", "/v1/episodes/e-1/windows", 422, "start"),
        ("GET", "/v1/episodes/e-1/windows?start=5", 422, "within its 9 steps"),
        ("GET", "/v1/episodes/e-1/windows?start=0&num_steps=400", 413, "at most 321"),
        ("GET", "/v1/episodes/e-1/windows?start=0&num_steps=2&cameras=x", 422, "camera_head"),
        ("GET", "/v1/episodes/e-1/streams/x", 422, "tactile_left"),
        ("GET", "/v1/recordings/none", 404, "none"),
        ("GET", "/v1/recordings/none/attributes", 404, "none"),
        ("POST", "/v1/recordings", 422, "body"),
        ("POST", "/v1/recordings/none/streams/x/batches/0", 404, "none"),
        ("POST", "/v1/recordings/none/streams/x/batches/-1", 422, "number"),
        ("POST", "/v1/recordings/none/finish", 422, "body"),
    ],
)
async def test_refusals_are_problems(http, store, method, path, status, words):
    write_episode(store, "e-1")
    response = await http.request(method, path)
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert words in response.json()["detail"]


def test_damage_is_a_problem_too_and_does_not_leak(start, store):
    write_episode(store, "e-1")
    shard = store.root / "episodes" / "e-1" / "tactile_left" / "c" / "0" / "0"
    shard.write_bytes(shard.read_bytes()[:-9])
    with pytest.raises(CorruptDataError, match="tactile_left"):
        start().window("e-1", 0, 2)


def test_answers_are_bounded(start, store):
    write_episode(store, "e-1")
    client = start(max_answer_bytes=20_000)
    with pytest.raises(LimitExceededError, match="shorter time"):
        client.episode_samples("e-1", "camera_head", stop_ns=None)
    with pytest.raises(LimitExceededError, match="fewer steps"):
        client.window("e-1", 0, 9)
    assert len(client.window("e-1", 0, 6)) == 6
    assert len(client.episode_samples("e-1", "tactile_left")) == 9


def test_the_client_raises_the_services_errors(start, store):
    client = start()
    with pytest.raises(NotFoundError, match="nowhere"):
        client.episode("nowhere")
    write_episode(store, "e-1")
    with pytest.raises(UnknownNameError, match="tactile_left"):
        client.episode_samples("e-1", "tactile")


def test_a_recording_comes_back_through_the_client(start, attributes, batch_of):
    client = start()
    client.create(attributes)
    client.send_batch("take-1", attributes.streams[0], batch_of(0, 20), number=0)
    assert client.status("take-1").next_batch["glove_left"] == 1
    client.finish("take-1", {"glove_left": 1, "wrist_left": 0}, success=True)
    (summary,) = client.recordings().recordings
    assert summary.num_samples == {"glove_left": 20, "wrist_left": 0}
    assert client.recording_attributes("take-1").success is True
    got = client.recording_samples("take-1", "glove_left", start_ns=16_666_667)
    np.testing.assert_array_equal(got.values, batch_of(1, 19).values)


def test_keys_and_scopes(start, store, attributes):
    keys = (
        ApiKey(name="station", key=SecretStr("key-of-some-station"), scopes=("store_write",)),
        ApiKey(name="trainer", key=SecretStr("key-of-some-trainer"), scopes=("store_read",)),
    )
    station = start(api_keys=keys)
    with pytest.raises(AccessDeniedError, match="no key"):
        station.create(attributes)
    station._http.headers["authorization"] = "Bearer key-of-some-station"
    assert station.create(attributes).state == "open"
    with pytest.raises(AccessDeniedError, match="store_read"):
        station.episodes()
    station._http.headers["authorization"] = "Bearer key-of-some-trainer"
    assert station.episodes().num_matching == 0
    with pytest.raises(AccessDeniedError, match="store_write"):
        station.create(attributes)


def test_window_codec_refuses_what_is_no_window(store):
    data = encode_window(write_episode(store, "e-1").window(0, 2))
    assert len(decode_window(data, max_bytes=10**6)) == 2
    with pytest.raises(InvalidInputError, match="window"):
        decode_window(data.replace(b"actions", b"actionz"), max_bytes=10**6)
    with pytest.raises(InvalidInputError, match="action kind"):
        decode_window(data.replace(b"measured", b"meazured"), max_bytes=10**6)
    with pytest.raises(LimitExceededError):
        decode_window(data, max_bytes=1000)


def run(store, *words):
    return main(["store", words[0], "--store", str(store.root), *words[1:]])


@pytest.fixture
def _plain_logs(monkeypatch):
    """The command line sets up logging for its process, which here is that of all tests."""
    monkeypatch.setattr(command_line, "configure_logging", lambda **_: None)


@pytest.mark.usefixtures("_plain_logs")
def test_command_line(store, capsys, tmp_path):
    write_episode(store, "e-1")
    write_episode(store, "e-2", task="stack_bowls")
    report = tmp_path / "report.json"
    assert run(store, "list", "--task", "stack_bowls", "--json", str(report)) == 0
    assert capsys.readouterr().out.startswith(
        "e-2  episode  stack_bowls  robot  twin  9 steps  success"
    )
    assert json.loads(report.read_text())["num_matching"] == 1
    assert run(store, "show", "e-1", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["num_samples"]["camera_head"] == 9
    assert run(store, "verify") == 0
    shard = store.root / "episodes" / "e-2" / "action" / "c" / "0" / "0"
    shard.write_bytes(shard.read_bytes()[:100])
    assert run(store, "verify") == 1
    out = capsys.readouterr().out
    assert "e-1  whole" in out
    assert "e-2  DAMAGED" in out
    assert "'action'" in out
    assert run(store, "delete", "e-2") == 0
    assert store.list() == ["e-1"]
    assert run(store, "show", "e-2") == 3
    assert "not in the store" in capsys.readouterr().err
    assert run(store, "list", "--kind", "recording") == 0
    assert run(store, "list", "--kind", "recording", "--origin", "twin") == 3
    assert "--origin" in capsys.readouterr().err
    assert main(["store", "list", "--store", str(tmp_path / "nowhere")]) == 3
    assert "no such folder" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["store", "list", "--colour"])


def test_serve_refuses_bad_settings(capsys):
    assert main(["store", "serve", "--max-page", "0"]) == 3
    assert "max_page" in capsys.readouterr().err
    assert main(["store", "serve", "--host", "192.0.2.1"]) == 3
    assert "api_keys" in capsys.readouterr().err


def test_a_silent_store_is_unavailable():
    client = EpisodeStoreClient("http://127.0.0.1:9", timeout_s=1.0)
    with client, pytest.raises(UnavailableError, match="no answer"):
        client.recordings()


async def test_health(http):
    assert (await http.get("/healthz")).json()["service"] == "episode_store"
