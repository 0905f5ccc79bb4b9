"""Built images and running services, made once for all tests; skipped where nothing can run them.

DEXTOUCH_CONTAINERS names a folder in which images are kept for the next run (not removed at the
end). Without it, everything is made in a temporary folder.
"""

import os
import signal
import time

import httpx
import pytest

from tests.browser.conftest import chromium, open_page, open_pages  # noqa: F401 - fixtures
from tests.containers import images
from tests.containers.composed import Composed
from tests.containers.disks import Disk
from tests.containers.engine import ROOT, engine_in, missing
from tests.system.compose_processes import keys_of, wait_for

ARRIVAL_TIMEOUT_S = 300.0
_FIGURES = []


def pytest_terminal_summary(terminalreporter):
    """Print what was measured."""
    if _FIGURES:
        terminalreporter.section("measured")
        for line in _FIGURES:
            terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def note():
    """Add a line to the measurements at the end of the run."""
    return _FIGURES.append


@pytest.fixture(scope="session")
def engine():
    """An engine that shares nothing with others of this user."""
    if reason := missing():
        pytest.skip(reason)
    # So that containers end with this process, however it is ended.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with engine_in(os.environ.get("DEXTOUCH_CONTAINERS")) as engine:
        yield engine


@pytest.fixture(scope="session")
def built(engine, note):
    """Both images of the Dockerfile; seconds that each took."""
    note(f"base images: {images.make_bases(engine)}")
    times_s = {target: images.build(engine, target) for target in ("light", "model")}
    for target, time_s in times_s.items():
        size = engine.inspect(f"localhost/dextouch:{target}", ".Size")
        note(f"image {target}: {size / 1e6:.0f} MB, built in {time_s:.0f} s")
    return times_s


@pytest.fixture(scope="session")
def keys():
    """The keys of `.env`."""
    return keys_of(ROOT / "docker-compose.yml")


@pytest.fixture(scope="session")
def key(keys):
    """The administrator's key."""
    return keys["DEXTOUCH_KEY"]


@pytest.fixture(scope="session")
def composed(engine, built, keys, note):
    """All lasting services of the compose file, healthy."""
    composed = Composed(engine, dict(keys))
    try:
        composed.up_all()
        for name, time_s in composed.started_s.items():
            note(f"{name}: healthy after {time_s:.1f} s")
        yield composed
    finally:
        composed.down()


@pytest.fixture(scope="session")
def disks(composed, engine):
    """Small disks below the spool and the store, by the name of the volume."""
    sizes = {"spool": 2 << 30, "store": 4 << 30}
    disks = {name: Disk(engine, name, size) for name, size in sizes.items()}
    volumes = {f"/data/{name}": disk.mounted for name, disk in disks.items()}
    users = ("episode_store", "acquisition", "alignment")
    try:
        composed.down(*users)
        for name in users:
            composed.up(name, volumes=volumes)
        yield disks
    finally:
        composed.down(*users)
        for disk in disks.values():
            disk.close()


@pytest.fixture(scope="session")
def client(key):
    """HTTP with the key."""
    headers = {"authorization": f"Bearer {key}"}
    with httpx.Client(headers=headers, timeout=120, trust_env=False) as client:
        yield client


@pytest.fixture(scope="session")
def ask(composed, client):
    """Ask a service with the key; all logs are part of a failure's message."""

    def ask(method, service, path, **more):
        answer = client.request(method, composed.url(service) + path, **more)
        assert answer.is_success, f"{answer.status_code} {answer.text}\n{composed.logs()}"
        return answer.json()

    return ask


@pytest.fixture
def arrived(composed, ask):
    """Wait until the store has exactly the samples of a take that the station counted."""

    def arrived(recording_id, num_samples, *, limit_s=ARRIVAL_TIMEOUT_S):
        def stored():
            try:
                found = ask("GET", "episode_store", "/v1/recordings")["recordings"]
            except httpx.TransportError:
                return False
            return [item for item in found if item["recording_id"] == recording_id]

        wait_for("upload", limit_s, stored, composed.logs)
        (found,) = stored()
        assert found["num_samples"] == num_samples

    return arrived


@pytest.fixture
def uploading(composed, ask):
    """Wait until a part of a take is in the store."""

    def uploading(recording_id):
        def begun():
            open_ones = ask("GET", "episode_store", "/v1/uploads")["uploads"]
            return [item for item in open_ones if item["recording_id"] == recording_id]

        deadline_s = time.monotonic() + ARRIVAL_TIMEOUT_S
        while not begun():
            assert time.monotonic() < deadline_s, composed.logs()

    return uploading
