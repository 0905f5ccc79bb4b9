"""`dextouch up`: all services answer in one process, know each other, and stop together."""

import asyncio
import json
import os
import subprocess
import sys
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import pytest

from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    StorageError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.serving import ServiceSettings, create_service_app
from services.alignment.retargeting import hand_retargeter
from services.cli import up
from services.cli.up import held_data_folder
from services.pipelines.servers import bind

# Of a machine that is busy with other things; the solver may be compiled first.
START_LIMIT_S = 900
PRETRAINED = Path(up.__file__).parents[1] / "world_model/pretrained"
# A working tree in which the model has not been trained yet has nothing to serve there.
WITHOUT = () if list(PRETRAINED.glob("*.safetensors")) else ("world_model",)


@pytest.fixture(scope="module")
def solver():
    """Compiled here: a worker of the service does it too, but after everybody else's work."""
    hand_retargeter.warm_up()


async def written(path, running):
    """The addresses, once they are there; what ended the services, if they never are."""
    while not path.is_file() or not path.read_text().endswith("\n"):
        assert not running.done(), running.result()
        await asyncio.sleep(0.05)
    return json.loads(path.read_text())


async def seen_whole(client, dashboard_url, expected):
    """Until the dashboard has heard of every service and of the station."""
    while True:
        overview = (await client.get(dashboard_url + "/v1/overview")).json()
        levels = {service["name"]: service["level"] for service in overview["services"]}
        if levels == dict.fromkeys(expected, "OK") and overview["station"]["reachable"]:
            return
        # A busy machine may keep the dashboard waiting longer than it waits for a service.
        await asyncio.sleep(0.2)


async def test_all_services_in_one_process(solver, tmp_path, capsys):
    settings = up.UpSettings(data=tmp_path / "data", json=tmp_path / "urls.json", without=WITHOUT)
    stop = asyncio.Event()
    running = asyncio.create_task(up.run(settings, stop))
    urls = await asyncio.wait_for(written(tmp_path / "urls.json", running), START_LIMIT_S)
    expected = set(up.BUILDERS) - set(WITHOUT)
    assert set(urls) == expected
    async with httpx.AsyncClient(trust_env=False, timeout=60) as client:
        await asyncio.wait_for(
            seen_whole(client, urls["dashboard"], expected - {"dashboard"}), START_LIMIT_S
        )
        worlds = (await client.get(urls["twin"] + "/v1/worlds")).json()["worlds"]
        audit = (await client.get(urls["dashboard"] + "/v1/audit")).json()
    assert worlds[0]["kind"] == "twin"
    assert audit["folder"] == str(tmp_path / "data" / "audit")
    stop.set()
    assert await running == 0
    assert urls["dashboard"] in capsys.readouterr().out


async def answered(client, method, url, **more):
    answer = await client.request(method, url, **more)
    assert answer.is_success, answer.text
    return answer.json()


async def save_a_take(client, station_url, num_seconds):
    """As an operator does it; the id of the take."""
    prompt = {"task": "stand_bottle", "instruction": "stand the bottle up"}
    recorder = f"{station_url}/v1/recorder"
    await answered(client, "POST", f"{recorder}/arm", json=prompt)
    started = await answered(client, "POST", f"{recorder}/record")
    while (await answered(client, "GET", recorder))["duration_s"] < num_seconds:  # noqa: ASYNC110
        await asyncio.sleep(0.2)
    await answered(client, "POST", f"{recorder}/stop")
    await answered(client, "POST", f"{recorder}/save", json={"accept_incomplete": True})
    return started["recording_id"]


async def test_a_saved_take_becomes_an_episode_by_itself(solver, tmp_path, monkeypatch):
    # Mocks play in real time: on a busy machine they have gaps that ordinary limits refuse.
    monkeypatch.setenv("DEXTOUCH_ALIGNMENT_OPTIONS__MAX_GAP_MS", "10000")
    settings = up.UpSettings(
        data=tmp_path / "data", json=tmp_path / "urls.json", without=("twin", "world_model")
    )
    stop = asyncio.Event()
    running = asyncio.create_task(up.run(settings, stop))
    urls = await asyncio.wait_for(written(tmp_path / "urls.json", running), START_LIMIT_S)
    async with httpx.AsyncClient(trust_env=False, timeout=60) as client:
        recording_id = await save_a_take(client, urls["acquisition"], 4.0)
        jobs = []
        while not jobs or jobs[0]["state"] in {"waiting", "running"}:
            await asyncio.sleep(0.2)
            listed = await answered(client, "GET", f"{urls['alignment']}/v1/alignments")
            jobs = listed["alignments"]
        listed = await answered(client, "GET", f"{urls['episode_store']}/v1/episodes")
    stop.set()
    assert await running == 0
    assert [(job["recording_id"], job["state"]) for job in jobs] == [(recording_id, "done")]
    episodes = [episode["episode_id"] for episode in listed["episodes"]]
    assert episodes == [jobs[0]["alignment_id"]]


async def test_a_taken_port_is_a_clear_refusal(tmp_path):
    place = bind("other", host="127.0.0.1", port=0)
    port = place.socket.getsockname()[1]
    settings = up.UpSettings(data=tmp_path, dashboard_port=port)
    with pytest.raises(ConflictError, match="--dashboard-port"):
        await up.run(settings, asyncio.Event())
    place.socket.close()


def test_a_default_port_that_is_taken_gives_way(capsys):
    place = bind("other", host="127.0.0.1", port=0)
    port = place.socket.getsockname()[1]
    settings = up.UpSettings.model_construct(_fields_set=set(), dashboard_port=port)
    other = up._bind("dashboard", settings)
    assert other.socket.getsockname()[1] not in {0, port}
    assert f"dashboard: port {port} is taken" in capsys.readouterr().err
    for bound in (place, other):
        bound.socket.close()


async def test_a_port_that_was_asked_for_is_not_taken_by_another_services_default(
    tmp_path, monkeypatch, capsys
):
    place = bind("other", host="127.0.0.1", port=0)
    port = place.socket.getsockname()[1]
    place.socket.close()
    served = []

    async def serve_all(placed, *, stop, on_ready):
        served.extend(place.url for place, _ in placed)

    monkeypatch.setattr(up, "serve_all", serve_all)
    # The twin is bound before the dashboard; its default is the port that the dashboard is given.
    settings = up.UpSettings.model_construct(
        _fields_set={"dashboard_port"},
        **{**up.UpSettings(data=tmp_path).model_dump(), "twin_port": port, "dashboard_port": port},
    )
    await up.run(settings, asyncio.Event())
    assert served[-1].endswith(f":{port}")
    assert f"twin: port {port} is taken" in capsys.readouterr().err


def test_ports_are_those_of_the_compose_file():
    compose = (Path(__file__).parents[2] / "docker-compose.yml").read_text()
    for name in up.BUILDERS:
        port = up.UpSettings.model_fields[f"{name}_port"].default
        assert f"${{DEXTOUCH_{name.upper()}_PORT:-{port}}}:" in compose


def test_wrong_flags_are_named():
    with pytest.raises(InvalidInputError, match="twin_port"):
        up.main(["--twin-port", "70000"])


async def test_what_cannot_be_left_out_is_named(tmp_path):
    settings = up.UpSettings(data=tmp_path, without=("dashboard",))
    with pytest.raises(UnknownNameError, match="valid: alignment, studies, twin, world_model"):
        await up.run(settings, asyncio.Event())


async def test_without_worlds(tmp_path):
    settings = up.UpSettings(
        data=tmp_path / "data", json=tmp_path / "urls.json", without=("twin", "world_model")
    )
    stop = asyncio.Event()
    running = asyncio.create_task(up.run(settings, stop))
    urls = await asyncio.wait_for(written(tmp_path / "urls.json", running), START_LIMIT_S)
    assert set(urls) == {"episode_store", "alignment", "acquisition", "studies", "dashboard"}
    stop.set()
    assert await running == 0


def test_each_service_reads_its_own_variables_too(tmp_path, monkeypatch):
    camera = {"kind": "camera", "stream": "camera_wrist_left", "port": 9200}
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_DEVICES", json.dumps([camera]))
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_FLUSH_PERIOD_S", "0.25")
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_STATION", "bench 3")
    station = up._station(up.UpSettings(data=tmp_path, mock=False))
    assert (station.station, station.mock, station.flush_period_s) == ("bench 3", False, 0.25)
    assert [device.kind for device in station.devices] == ["camera"]
    named = up._station(up.UpSettings(data=tmp_path, mock=False, station="bench 4"))
    assert named.station == "bench 4"


def test_a_wrong_variable_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXTOUCH_ALIGNMENT_PORT", "far")
    with pytest.raises(
        InvalidInputError, match="settings of alignment: port: got 'far', expected a whole"
    ):
        up._build("alignment", up.UpSettings(data=tmp_path), {})


def test_a_station_without_devices_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="--no-mock and no devices, expected them in DEXT"):
        up._station(up.UpSettings(data=tmp_path, mock=False))


def other_up(folder, seconds=120):
    """Another `up` on the same folder, as a user starts it."""
    command = [sys.executable, "-m", "services.cli.main", "up", "--data", str(folder)]
    ports = [f"--{name.replace('_', '-')}-port=0" for name in up.BUILDERS]
    return subprocess.run(
        [*command, *ports], capture_output=True, text=True, timeout=seconds, check=False
    )


async def test_a_second_up_on_a_data_folder_says_who_has_it(tmp_path):
    with held_data_folder(tmp_path) as tell:
        tell("http://127.0.0.1:8080")
        done = await asyncio.to_thread(other_up, tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    (line,) = done.stderr.splitlines()
    assert f"{tmp_path} is in use by another `dextouch up`" in line
    assert f"process {os.getpid()}, dashboard at http://127.0.0.1:8080" in line
    assert "--data" in line
    # Released, as it is when the process ends.
    with held_data_folder(tmp_path):
        pass


def few(tmp_path, **changed):
    ports = {f"{name}_port": 0 for name in up.BUILDERS}
    without = ("twin", "world_model", "studies")
    given = {"data": tmp_path / "data", "json": tmp_path / "urls.json", "without": without}
    return up.UpSettings(**ports | given | changed)


async def test_up_holds_its_data_folder_and_goes_on_without_damaged_jobs(solver, tmp_path):
    jobs = tmp_path / "data/store/.alignments/jobs.sqlite3"
    jobs.parent.mkdir(parents=True)
    jobs.write_bytes(b"no database" * 1000)
    stop = asyncio.Event()
    running = asyncio.create_task(up.run(few(tmp_path), stop))
    urls = await asyncio.wait_for(written(tmp_path / "urls.json", running), START_LIMIT_S)
    with pytest.raises(ConflictError, match=f"process {os.getpid()}, .*{urls['dashboard']}"):
        await up.run(few(tmp_path), asyncio.Event())
    async with httpx.AsyncClient(trust_env=False, timeout=60) as client:
        assert (await client.get(f"{urls['episode_store']}/readyz")).status_code == 200
        ready = await client.get(f"{urls['alignment']}/readyz")
        assert ready.status_code == 503
        assert str(jobs) in ready.json()["waiting_for"][0]
        system = (await client.get(f"{urls['dashboard']}/v1/system")).text
        assert "jobs.sqlite3" in system
    assert jobs.read_bytes() == b"no database" * 1000
    stop.set()
    assert await running == 0


async def test_a_service_that_refuses_to_start_is_named_with_its_reason(tmp_path, monkeypatch):
    @asynccontextmanager
    async def refuse(_):
        raise StorageError("alignment jobs: damaged")
        yield

    def refusing(settings, urls):
        return create_service_app(
            name="alignment", settings=ServiceSettings(), routers=[], lifespan=refuse
        )

    monkeypatch.setattr(up, "BUILDERS", {**up.BUILDERS, "alignment": refusing})
    with pytest.raises(UnavailableError, match="alignment did not start: alignment jobs: damaged"):
        await up.run(few(tmp_path), asyncio.Event())
