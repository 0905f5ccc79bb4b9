"""Running bridges, the stations that read them, and libraries compiled from C."""

import ctypes
import shutil
import subprocess
import threading
import time
from pathlib import Path

import httpx
import pytest

from dextouch.streams import unpack
from services.acquisition.app import create_app
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.sdk_bridges import bridge as bridge_module
from services.acquisition.settings import AcquisitionSettings

HERE = Path(__file__).parent
LIMIT_S = 20.0


class RunningBridge:
    """A bridge in a thread, and what it said."""

    def __init__(self, source, address=("127.0.0.1", 0)):
        self.source, self.said, self.error = source, [], None
        self._stop = threading.Event()
        self._summary = None
        self._thread = threading.Thread(target=self._run, args=(address,))
        self._thread.start()

    def _run(self, address):
        try:
            self._summary = bridge_module.run_bridge(
                self.source, address, stop=self._stop, say=self.said.append
            )
        except Exception as error:  # noqa: BLE001 - shown by the test's thread
            self.error = error

    def until_said(self, words):
        """The line with these words."""
        end_s = time.monotonic() + LIMIT_S
        while time.monotonic() < end_s:
            for line in self.said:
                if words in line:
                    return line
            assert self.error is None, self.error
            time.sleep(0.005)
        raise AssertionError(f"{words!r} is not in {self.said}")

    @property
    def port(self):
        return int(self.until_said("serving").rpartition(":")[2])

    def end(self):
        """Stop it, and return its summary."""
        self._stop.set()
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error
        return self._summary


@pytest.fixture(autouse=True)
def _long_silence(monkeypatch):
    # Longer than the real limits of 200 ms, so that a busy machine is not taken for a dead bridge,
    # nor its samples for old ones.
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.SILENCE_NS", 10**10)
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.MAX_AGE_NS", 10**10)


@pytest.fixture
def serve(monkeypatch):
    """Serves sources until the test ends."""
    monkeypatch.setattr(bridge_module, "RETRY_S", 0.02)
    bridges = []

    def serve(source, *address):
        bridges.append(RunningBridge(source, *address))
        return bridges[-1]

    yield serve
    for bridge in bridges:
        if bridge.error is None:
            bridge.end()


@pytest.fixture
def connect():
    """Opens the driver that a station makes of settings."""
    drivers = []

    def connect(**settings):
        devices = AcquisitionSettings(devices=({"link": "bridge", **settings},)).devices
        (driver,) = build_drivers(devices, StationClock())
        drivers.append(driver)
        driver.open()
        return driver

    yield connect
    for driver in drivers:
        driver.close()


@pytest.fixture
def read():
    """So many samples of a driver's stream."""

    def read(driver, count=1, *, after=None):
        samples, end_s = [], time.monotonic() + LIMIT_S
        while len(samples) < count:
            assert time.monotonic() < end_s, f"{len(samples)} of {count} samples"
            if after is not None:
                after()
            samples += driver.read().get(driver.descriptors[0].name, [])
        return samples

    return read


@pytest.fixture
def until():
    """Repeats an action until a condition holds."""

    def until(condition, action):
        end_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end_s, "it never came to this"
            action()

    return until


@pytest.fixture
def live_poses(tmp_path):
    """What `GET /v1/live/poses` of a station with these devices says once all streams are there."""

    async def live_poses(*devices, streams):
        settings = AcquisitionSettings(
            devices=tuple({"link": "bridge", **device} for device in devices),
            spool=tmp_path / "spool",
        )
        app = create_app(settings)
        transport = httpx.ASGITransport(app)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
        ):
            end_s = time.monotonic() + LIMIT_S
            while time.monotonic() < end_s:
                content = (await client.get("/v1/live/poses")).content
                _, arrays = unpack(content, max_bytes=100_000)
                if set(streams) <= set(arrays):
                    return arrays
                time.sleep(0.01)  # noqa: ASYNC251 - the threads of the station go on
        raise AssertionError(f"got {sorted(arrays)}, expected {sorted(streams)}")

    return live_poses


@pytest.fixture(scope="session")
def compiled(tmp_path_factory):
    """Compiles a C file of this folder to a shared library, and loads it."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: cc is not installed")
    libraries = {}

    def compiled(name):
        if name not in libraries:
            path = tmp_path_factory.mktemp("c") / f"lib{name}.so"
            source = HERE / f"{name}.c"
            subprocess.run(
                [compiler, "-shared", "-fPIC", "-Wall", "-Werror", "-o", path, source], check=True
            )
            libraries[name] = path
        return libraries[name], ctypes.CDLL(libraries[name])

    return compiled
