"""Many stations at once against a store process: nothing lost or doubled, memory stays flat."""

import json
import os
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import psutil
import pytest
import zarr

from dextouch.episodes import EpisodeStore
from tests.system import store_load
from tests.system.compose_processes import free_port

ROOT = Path(__file__).resolve().parents[2]
LOAD = Path(store_load.__file__)
MIB = 2**20
MAX_GROWTH_MIB_PER_MINUTE = 5.0
pytestmark = pytest.mark.system


class Soak:
    """A store process and a load process; what was sampled of the first while the second ran."""

    def __init__(self, folder, **load):
        self.folder, self.load = folder, load
        self.store_folder, self.report_path = folder / "store", folder / "report.json"
        self.url = f"http://127.0.0.1:{free_port()}"
        self.samples = []
        self.report = {}
        self.stopped = threading.Event()

    def run(self):
        """Start both, sample once a second, stop both; the load's report."""
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)
        }
        flags = ["--store-url", str(self.store_folder), "--port", self.url.rsplit(":", 1)[1]]
        command = [
            sys.executable,
            "-m",
            "services.cli.main",
            "store",
            "serve",
            *flags,
            "--log-level",
            "warning",
        ]
        with (self.folder / "store.log").open("wb") as log:
            server = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=log, stderr=log)
            try:
                self._wait_ready(server)
                self._run_load(server, environment)
            finally:
                server.terminate()
                assert server.wait(timeout=30) in {0, -15}
        return self.report

    def _wait_ready(self, server):
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            assert server.poll() is None, (self.folder / "store.log").read_text()
            try:
                with urllib.request.urlopen(f"{self.url}/healthz", timeout=5):  # noqa: S310
                    return
            except OSError:
                self.stopped.wait(0.05)
        raise AssertionError("the store did not start")

    def _run_load(self, server, environment):
        flags = [word for key, value in self.load.items() for word in (f"--{key}", str(value))]
        command = [sys.executable, str(LOAD), "--url", self.url, "--report", str(self.report_path)]
        load = subprocess.Popen([*command, *flags], env=environment, cwd=ROOT)
        process = psutil.Process(server.pid)
        begin = time.monotonic()
        while True:
            try:
                load.wait(timeout=1)
            except subprocess.TimeoutExpired:
                self.samples.append((time.monotonic() - begin, process.memory_info().rss / MIB))
            else:
                break
        assert load.returncode == 0
        self.report = json.loads(self.report_path.read_text())
        self.report["wall_s"] = time.monotonic() - begin
        times = process.cpu_times()
        self.report["server_cpu_s"] = times.user + times.system
        self.report["commit_cpu_s"] = sum(
            sum(child.cpu_times()[:2]) for child in process.children(recursive=True)
        )

    def growth_mib_per_minute(self, warm_up_s):
        """Slope of the store's memory after the warm-up."""
        t_s, rss_mib = np.array([row for row in self.samples if row[0] >= warm_up_s]).T
        return float(np.polyfit(t_s / 60, rss_mib, 1)[0])

    def check_everything_came_once(self):
        """Every sample of every take: its sequence, its stamp, its value or its image."""
        store, pictures = EpisodeStore(self.store_folder), store_load.images()
        takes = self.report["takes"]
        assert store.list(kind="recording") == sorted(takes)
        assert list((self.store_folder / ".uploads").iterdir()) == []
        for name, counts in takes.items():
            reader = store.recording(name)
            group = zarr.open_group(self.store_folder / "recordings" / name, mode="r")
            for descriptor in store_load.streams():
                stream, count = descriptor.name, counts[descriptor.name]
                expected = np.arange(count)
                np.testing.assert_array_equal(group[f"{stream}_sequence"][:], expected)
                stamps = np.round(expected * 1e9 / descriptor.nominal_rate_hz).astype(np.int64)
                np.testing.assert_array_equal(group[f"{stream}_t_host_ns"][:], stamps)
                if descriptor.unit == "jpeg":
                    images = reader.encoded_images(stream, 0, count)
                    assert all(
                        image == pictures[index % store_load.NUM_IMAGES]
                        for index, image in enumerate(images)
                    )
                else:
                    values = group[stream][:].reshape(count, -1)
                    np.testing.assert_array_equal(values[:, 0], expected % 60_000)
                    assert (values == values[:, :1]).all()


@pytest.mark.slow
def test_two_stations_in_a_hurry(tmp_path):
    """A take of ten seconds from each of two stations, at four times their rate."""
    soak = Soak(tmp_path, stations=2, seconds=2, take_s=2.5, speed=4)
    report = soak.run()
    assert report["errors"] == []
    assert len(report["takes"]) == 2
    soak.check_everything_came_once()
    # Some hundred megabytes went through; they must not have stayed.
    assert max(rss for _, rss in soak.samples) < 400


@pytest.mark.slow
def test_eight_stations_for_five_minutes(tmp_path):
    """Full rate at real time; prints what docs/benchmarks.md tells."""
    soak = Soak(tmp_path, stations=8, seconds=300, take_s=10)
    report = soak.run()
    growth = soak.growth_mib_per_minute(warm_up_s=60)
    shown = {key: value for key, value in report.items() if key != "takes"}
    print(json.dumps(shown | {"growth_mib_per_minute": growth, "takes": len(report["takes"])}))  # noqa: T201
    assert report["errors"] == []
    try:
        soak.check_everything_came_once()
    finally:
        # Some ten gigabytes.
        shutil.rmtree(soak.store_folder)
    assert growth < MAX_GROWTH_MIB_PER_MINUTE
