"""Pages in a real Chromium, served by real servers on loopback; failing tests leave screenshots.

The browser is Debian's `chromium`, or the program that DEXTOUCH_CHROMIUM names. Every wait of a
page ends after 30 s, so that a loaded machine is slow and a broken page is still an error.
"""

import asyncio
import os
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Error, expect, sync_playwright

from services.acquisition.app import create_app as create_station
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.pipelines.servers import bind, serve_all
from tests.programs import needed_program

PATIENCE_S = 30
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
expect.set_options(timeout=1000 * PATIENCE_S)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "call" and report.failed:
        for path, page in item.funcargs.get("open_pages", {}).items():
            try:
                page.screenshot(path=path)
                report.sections.append(("page", f"{page.url}, see {path}"))
            except Error as error:
                report.sections.append(("page", f"no screenshot: {error}"))
    return report


@pytest.fixture(scope="module")
def chromium():
    """One browser a module: playwright's loop must be gone before other modules run theirs."""
    named = os.environ.get("DEXTOUCH_CHROMIUM")
    program = named or needed_program("chromium", package="chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=program, args=list(FLAGS), timeout=1000 * PATIENCE_S
        )
        yield browser
        browser.close()


@pytest.fixture
def open_pages():
    """The test's pages by where their screenshots go if it fails."""
    return {}


@pytest.fixture
def open_page(chromium, open_pages, tmp_path):
    """Make a page in a profile of its own; arguments as those of `browser.new_context`."""
    contexts = []

    def make(**options):
        context = chromium.new_context(**options)
        context.set_default_timeout(1000 * PATIENCE_S)
        contexts.append(context)
        page = context.new_page()
        open_pages[tmp_path / f"page_{len(open_pages)}.png"] = page
        return page

    yield make
    for context in contexts:
        context.close()


@pytest.fixture
def page(open_page):
    """A page in a fresh profile."""
    return open_page()


@contextmanager
def _served(make_app):
    place = bind("tested", host="127.0.0.1", port=0)
    stop, ready, failures = asyncio.Event(), threading.Event(), []
    loop = asyncio.new_event_loop()

    async def serve():
        await serve_all([(place, make_app(place.url))], stop=stop, on_ready=ready.set, grace_s=1)

    def run():
        try:
            with asyncio.Runner(loop_factory=lambda: loop) as runner:
                runner.run(serve())
        except BaseException as error:  # noqa: BLE001 - told to the test
            failures.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=run, name="served", daemon=True)
    thread.start()
    assert ready.wait(PATIENCE_S), "the server did not start"
    try:
        assert not failures, failures
        yield place.url
    finally:
        if not failures:
            loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE_S)
    assert not thread.is_alive(), "the server did not stop"
    assert not failures, failures


@pytest.fixture
def serve():
    """Serve an application until the test ends; gives its address.

    Takes the application, or a function that makes it from its own address.
    """
    with ExitStack() as held:

        def start(app):
            make_app = app if not hasattr(app, "router") else lambda _: app
            return held.enter_context(_served(make_app))

        yield start


@pytest.fixture
def serve_station(serve, monkeypatch):
    """Serve a station with two mock trackers; all ten streams would take a small machine whole."""
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name in {"head", "wrist_left"}]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)

    def start(spool, **settings):
        return serve(create_station(AcquisitionSettings(spool=spool, mock=True, **settings)))

    return start


class StationProcess:
    """A station with mock devices that a test can stop; `url` is its address."""

    def __init__(self, spool, name, streams):
        child = Path(__file__).with_name("station_child.py")
        self._process = subprocess.Popen(
            [sys.executable, child, spool, name, *streams],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.url = self._process.stdout.readline().strip()
        assert self.url, f"station {name} did not start"

    def stop(self):
        """Stop it in the middle of whatever it does: it accepts connections and never answers."""
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self):
        self._process.send_signal(signal.SIGCONT)

    def end(self):
        self._process.kill()
        self._process.wait(PATIENCE_S)
        self._process.stdout.close()


@pytest.fixture
def station_process(tmp_path):
    """Start a station in a process of its own: its name and the streams of its mock devices."""
    started = []

    def start(name, *streams):
        started.append(StationProcess(tmp_path / f"spool_{name}", name, streams))
        return started[-1]

    yield start
    for one in started:
        one.end()
