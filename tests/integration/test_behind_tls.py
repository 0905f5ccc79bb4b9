"""The TLS examples of `deploy` before a store, a dashboard and two stations."""

import json
import ssl

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from services.acquisition.app import create_app as create_station
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.pipelines.servers import served
from tests.integration.test_station_enrolment import save_a_take, until, upload_of
from tests.integration.tls_proxies import KINDS, running_proxy, trusted_certificates
from tests.system.compose_processes import free_port

DESKS = ("desk-1", "desk-2")
KEYS = {name: f"key of {name}, 8d1f0c6b72" for name in ("operator", "dashboard", *DESKS)}
PROXY = {"trusted_proxies": ("127.0.0.1",)}
# Another address of this machine than the proxy's.
CLIENT = "127.0.0.2"


def key(name, *scopes, **fields):
    return {"name": name, "key": KEYS[name], "scopes": scopes, **fields}


@pytest.fixture(params=KINDS)
def lab(request, tmp_path, monkeypatch):
    """Two stations, a store and a dashboard behind a proxy; its port and that of http://."""
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "head"]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)
    folder, ports = tmp_path / "tls", (free_port(), free_port())
    trusted_certificates(folder, monkeypatch)
    port = ports[0]
    url = {name: f"https://{name}.lab:{port}" for name in ("dashboard", "store", *DESKS)}
    store = EpisodeStoreSettings(
        store_url=str(tmp_path / "store"),
        api_keys=(
            *(key(name, "store_write", station=name) for name in DESKS),
            key("dashboard", "store_read"),
        ),
        **PROXY,
    )
    dashboard = DashboardSettings(
        station="desk-1",
        acquisition_url=url["desk-1"],
        stations={"desk-2": url["desk-2"]},
        episode_store_url=url["store"],
        api_keys=(key("operator", "operate"),),
        upstream_key=KEYS["dashboard"],
        # So that a slow machine does not count as a silent one.
        upstream_timeout_s=30,
        live_timeout_s=10,
        audit_folder=tmp_path / "audit",
        allowed_hosts=("dashboard.lab",),
        **PROXY,
    )
    stations = {
        name: AcquisitionSettings(
            mock=True,
            station=name,
            spool=tmp_path / name,
            episode_store_url=url["store"],
            episode_store_key=KEYS[name],
            upload_period_s=0.1,
            enrolment=tmp_path / "none.json",
            api_keys=(key("dashboard", "station"), key("operator", "station")),
            **PROXY,
        )
        for name in DESKS
    }
    apps = {"dashboard": create_dashboard(dashboard), "store": create_store(store)}
    apps |= {name: create_station(settings) for name, settings in stations.items()}
    with served(apps) as urls:
        behind = {f"{name}.lab": address for name, address in urls.items()}
        with running_proxy(request.param, folder, behind, *ports):
            yield ports


def client_of(name, port, **options):
    transport = httpx.HTTPTransport(local_address=CLIENT, verify=ssl.create_default_context())
    url = f"https://{name}.lab:{port}"
    return httpx.Client(base_url=url, transport=transport, timeout=60, **options)


def test_a_lab_behind_tls(lab, tmp_path):
    port, http_port = lab
    answer = httpx.get(f"http://dashboard.lab:{http_port}/x?y=1")
    assert answer.status_code in {301, 308}
    assert answer.headers["location"].endswith("dashboard.lab/x?y=1") or port != 443
    assert answer.headers["location"].startswith("https://dashboard.lab")
    # Both stations upload through the proxy.
    takes = {}
    for name in DESKS:
        with client_of(name, port, headers={"authorization": f"Bearer {KEYS['operator']}"}) as desk:
            take = takes[name] = save_a_take(desk)
            until(lambda: upload_of(desk, take)["uploaded"], "not uploaded")  # noqa: B023 - at once
    with client_of(
        "store", port, headers={"authorization": f"Bearer {KEYS['dashboard']}"}
    ) as store:
        listed = store.get("/v1/recordings").json()["recordings"]
        assert {one["station"]: one["recording_id"] for one in listed} == takes
        # A batch may have 16 MiB, and the service decides about it, not the proxy.
        body = {
            "content": b"x" * (15 << 20),
            "headers": {"content-type": "application/octet-stream"},
        }
        path = "/v1/recordings/take/streams/s/batches/0"
        assert store.post(path, **body).json()["details"]["reason"] == "missing_scope"
    with client_of("dashboard", port) as browser:
        sign_in_and_look(browser, port)
    (line,) = (tmp_path / "audit").glob("audit*.jsonl")
    assert f'"client":"{CLIENT}"' in line.read_text()
    assert "198.51.100.9" not in line.read_text()


def sign_in_and_look(browser, port):
    origin = f"https://dashboard.lab:{port}"
    # What a client says of its own address is dropped.
    forged = {"x-forwarded-for": "198.51.100.9", "x-forwarded-proto": "http", "origin": origin}
    answer = browser.post("/sign_in", data={"key": KEYS["operator"]}, headers=forged)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    assert {"Secure", "HttpOnly"} <= {
        part.strip() for part in answer.headers["set-cookie"].split(";")
    }
    assert browser.get("/").status_code == 200
    cookie = answer.headers["set-cookie"].partition(";")[0]
    options = {"ssl": ssl.create_default_context(), "additional_headers": {"cookie": cookie}}
    address = origin.replace("https", "wss") + "/v1/live"
    with connect(address, origin=origin, **options) as live:
        live.send(json.dumps({"view": ["fleet"]}))
        until(lambda: shows_both(live.recv(60)), "the wall lacks a station")
    with pytest.raises(InvalidStatus, match="403"):
        connect(address, origin="https://evil.example", **options)


def shows_both(message):
    """Whether a message of the wall shows both stations as reachable."""
    if isinstance(message, bytes):
        return False
    tiles = json.loads(message)["data"]
    return {tile["name"] for tile in tiles if not tile["cause"].startswith("no answer")} == set(
        DESKS
    )
