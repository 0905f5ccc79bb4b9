"""Built images and running services, made once for all tests; skipped where nothing can run them.

DEXTOUCH_CONTAINERS names a folder in which images are kept for the next run (not removed at the
end). Without it, everything is made in a temporary folder.
"""

import os
import secrets
import signal

import httpx
import pytest

from tests.browser.conftest import chromium, open_page, open_pages  # noqa: F401 - fixtures
from tests.containers import images
from tests.containers.composed import Composed
from tests.containers.engine import engine_in, missing

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
def key():
    """The key of `.env`."""
    return secrets.token_hex(32)


@pytest.fixture(scope="session")
def composed(engine, built, key, note):
    """All lasting services of the compose file, healthy."""
    composed = Composed(engine, {"DEXTOUCH_KEY": key})
    try:
        composed.up_all()
        for name, time_s in composed.started_s.items():
            note(f"{name}: healthy after {time_s:.1f} s")
        yield composed
    finally:
        composed.down()


@pytest.fixture(scope="session")
def ask(composed, key):
    """Ask a service with the key; all logs are part of a failure's message."""
    headers = {"authorization": f"Bearer {key}"}
    with httpx.Client(headers=headers, timeout=60, trust_env=False) as client:

        def ask(method, service, path, **more):
            answer = client.request(method, composed.url(service) + path, **more)
            assert answer.is_success, f"{answer.status_code} {answer.text}\n{composed.logs()}"
            return answer.json()

        yield ask
