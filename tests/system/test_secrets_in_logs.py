"""No key of the services stands in their logs, error replies or metrics, wherever it was sent.

The services run as users start them, with the most talkative log level. Requests hold keys in the
right place and in wrong ones; the outputs are then searched for every key.
"""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import product

import httpx
import pytest
from websockets.exceptions import InvalidHandshake
from websockets.sync.client import connect

from dextouch.episodes import EpisodeStore
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write

pytestmark = pytest.mark.system
START_LIMIT_S = 300
SCOPES = {
    "episode_store": ("store_read", "store_write", "store_expire", "store_delete", "enrol"),
    "alignment": ("align",),
    "acquisition": ("station",),
    "twin": ("rollout",),
    "dashboard": ("operate",),
    "rating": ("rate",),
    "studies": ("study_read",),
}
# Of the service, by its name; the same for all that must know it.
KEYS = {name: f"Ke9-of-{name}-3c5a7e" for name in SCOPES}
# With letters that are written differently in URLs and JSON.
KEYS["alignment"] = 'Ke9/of "alignment" \\ & others'
WRONG_KEY = "Wr0ng-7f3a-key-of-some-length"
IN_REDIS_URL = "Pa55-of-the-redis-server"
RUBRICS = '[reach]\n[[reach.criteria]]\nname = "a"\npoints = 2\ndescription = "b"\n'


def environment(folder):
    keys = {
        f"DEXTOUCH_{name.upper()}_API_KEYS": json.dumps(
            [{"name": "known", "key": KEYS[name], "scopes": scopes}]
        )
        for name, scopes in SCOPES.items()
    }
    return os.environ | keys | {
        "DEXTOUCH_ACQUISITION_EPISODE_STORE_KEY": KEYS["episode_store"],
        # A service that is refused by its upstreams, too.
        "DEXTOUCH_DASHBOARD_UPSTREAM_KEY": KEYS["acquisition"],
        "DEXTOUCH_TWIN_STATE_URL": f"redis://user:{IN_REDIS_URL}@127.0.0.1:1/0",
        "DEXTOUCH_RATING_LOG_LEVEL": "debug",
    }  # fmt: skip


@contextmanager
def running(arguments, log, folder):
    """A command of `dextouch` with its output in a file; it must end by itself on SIGTERM."""
    command = [sys.executable, "-m", "services.cli.main", *arguments]
    with (
        log.open("wb") as output,
        subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment(folder)
        ) as process,
    ):
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(60)
            finally:
                process.kill()


def until(found, process, log):
    end_s = time.monotonic() + START_LIMIT_S
    while (value := found()) is None:
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end_s, log.read_text()
        time.sleep(0.1)
    return value


def exchange(client, seen, method, url, **given):
    answer = client.request(method, url, **given)
    # A response names what it was asked for in no other place.
    seen.append((f"{method} {url}", answer.status_code, answer.text + str(answer.headers)))


def ask_everywhere(client, seen, key, operations):
    """Send a key in its place and in wrong ones, to all routes."""
    as_header = {"authorization": f"Bearer {key}"}
    wrong_places = [
        {"headers": {"authorization": f"Basic {key}"}},
        {"headers": {"authorization": key}},
        {"headers": {"x-api-key": key, "x-request-id": key, "user-agent": key}},
        {"headers": {"cookie": f"dextouch_session={key}"}},
        {"headers": as_header | {"content-type": key.encode()}, "content": b"{}"},
        {"headers": as_header | {"content-type": "application/json"}, "content": key.encode()},
        {"headers": {"host": key.encode()}},
        {"headers": {"origin": key.encode()}},
        {"params": {"key": key, "limit": key, "order": key, "rater": key}},
    ]
    fields = ("world", "recording_id", "task", "state", "ids", key, "items", "actions")
    bodies = [{"json": dict.fromkeys(fields, key), "headers": as_header}]
    for method, path in operations:
        url = path.replace("{", "").replace("}", "")
        exchange(client, seen, method, url, headers=as_header)
        has_body = method == "POST"
        for given in wrong_places + (bodies if has_body else []):
            exchange(client, seen, method, url, **given)
    for url in ("/", "/v1", "/v1/episodes", "/v1/rollouts", "/v1/live/cameras"):
        path = httpx.URL("http://x").copy_with(path=f"{url}/{key}").raw_path.decode()
        exchange(client, seen, "GET", path.replace("//", "/"), headers=as_header)
        exchange(client, seen, "GET", path.replace("//", "/"))


def operations_of(client):
    document = client.get("/openapi.json").json()
    return [
        (method.upper(), path)
        for path, methods in document["paths"].items()
        for method in methods
        if path != "/v1/alignments" or method != "post"
    ]


def enrolled(client):
    """Token and key of a station that is enrolled."""
    as_admin = {"authorization": f"Bearer {KEYS['episode_store']}"}
    asked = client.post("/v1/enrolments", json={"station": "desk_7"}, headers=as_admin)
    token = asked.json()["token"]
    got = client.post("/v1/enrolments/exchange", json={"token": token})
    return token, got.json()["key"]


def open_websockets(url, key):
    places = product(("/v1/live", "/v1/openpi"), ("", f"?key={key}"), ("Bearer", "Api-Key"))
    for path, query, kind in places:
        address = url.replace("http", "ws") + path + query.replace(" ", "%20")
        try:
            with connect(address, additional_headers={"authorization": f"{kind} {key}"}) as socket:
                socket.send("{}")
        except (InvalidHandshake, OSError):
            continue


def sign_in(client, seen, keys):
    for key in keys:
        exchange(client, seen, "POST", "/sign_in", data={"key": key, "wanted": "/"})


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """Logs, error replies and metrics of all services after good and bad requests."""
    folder = tmp_path_factory.mktemp("secrets")
    log, rating_log, addresses = folder / "up.log", folder / "rating.log", folder / "urls.json"
    item = toy.demonstration("reach", 1, name="dream-1")
    write(EpisodeStore(str(folder / "rated")), item, origin="imagined")
    (folder / "rubrics.toml").write_text(RUBRICS)
    up = ["up", "--data", str(folder / "data"), "--json", str(addresses), "--log-level", "debug"]
    up += ["--without", "world_model"]
    for name in ("dashboard", "episode-store", "alignment", "acquisition", "twin", "studies"):
        up += [f"--{name}-port", "0"]
    rating = ["rate", "serve", "--store-url", str(folder / "rated")]
    rating += ["--marks", str(folder / "marks.sqlite"), "--rubrics", str(folder / "rubrics.toml")]
    seen, metrics, enrolment = [], {}, ()
    with running(rating, rating_log, folder) as rater, running(up, log, folder) as services:

        def announced():
            text = addresses.read_text() if addresses.is_file() else ""
            return json.loads(text) if text.endswith("\n") else None

        def listening():
            lines = [one for one in rating_log.read_text().splitlines() if "running on" in one]
            return lines[0].split(" running on ")[1].split()[0] if lines else None

        urls = until(announced, services, log)
        urls["rating"] = until(listening, rater, rating_log)
        for name, url in urls.items():
            with httpx.Client(base_url=url, trust_env=False, timeout=60) as client:
                for key in (KEYS[name], WRONG_KEY):
                    ask_everywhere(client, seen, key, operations_of(client))
                    open_websockets(url, key)
                if name == "episode_store":
                    enrolment = enrolled(client)
                    for secret in enrolment:
                        ask_everywhere(client, [], secret, operations_of(client))
                if name == "dashboard":
                    sign_in(client, seen, (WRONG_KEY, KEYS["twin"], KEYS["dashboard"]))
                    for path in ("/v1/overview", "/v1/episode_store/episodes"):
                        exchange(client, seen, "GET", path)
                metrics[name] = client.get("/metrics").text
    logs = log.read_text() + rating_log.read_text()
    return {"logs": logs, "seen": seen, "metrics": metrics, "enrolment": enrolment}


def written(secret):
    """A secret as it is, and as it is written in JSON and URLs."""
    return {secret, json.dumps(secret)[1:-1], httpx.QueryParams({"k": secret}).__str__()[2:]}


ALL_SECRETS = {*KEYS.values(), IN_REDIS_URL}


def test_the_requests_were_answered_in_many_ways(outputs):
    statuses = {status for _, status, _ in outputs["seen"]}
    assert {200, 303, 401, 404, 415, 421, 422, 503} <= statuses
    assert 500 not in statuses, [one for one in outputs["seen"] if one[1] == 500][:3]
    assert set(outputs["metrics"]) == set(SCOPES)


def test_no_key_is_in_the_logs(outputs):
    lines = outputs["logs"].splitlines()
    assert any("websocket_refused" in line for line in lines)
    for secret in ALL_SECRETS | {WRONG_KEY, *outputs["enrolment"]}:
        for text in written(secret):
            assert not [line for line in lines if text in line], text


def test_no_key_of_a_service_is_in_a_reply(outputs):
    for asked, status, reply in outputs["seen"]:
        for secret in ALL_SECRETS:
            for text in written(secret):
                assert text not in reply, (asked, status, reply)


def test_no_key_is_in_the_metrics(outputs):
    for name, shown in outputs["metrics"].items():
        assert "dextouch_http_requests_total" in shown, name
        for secret in ALL_SECRETS | {WRONG_KEY, *outputs["enrolment"]}:
            for text in written(secret):
                assert text not in shown, name


@pytest.mark.parametrize(
    "given",
    [
        f"not JSON {WRONG_KEY}",
        json.dumps([{"name": "UPPER", "key": WRONG_KEY, "scopes": []}]),
        json.dumps([{"name": WRONG_KEY, "key": WRONG_KEY, "scopes": WRONG_KEY, "more": WRONG_KEY}]),
        json.dumps(WRONG_KEY),
    ],
)
def test_invalid_settings_do_not_show_keys(given, tmp_path):
    command = [sys.executable, "-m", "services.cli.main", "dashboard"]
    env = os.environ | {"DEXTOUCH_DASHBOARD_API_KEYS": given}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 3, done.stderr
    assert "api_keys" in done.stderr
    assert "Traceback" not in done.stderr
    assert WRONG_KEY not in done.stderr
