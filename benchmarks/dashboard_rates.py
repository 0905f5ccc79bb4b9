"""How often a second the dashboard updates pages of live stations; run it as `python -m`.

Each station is a process with mock devices, and the dashboard another one; this process reads what
a browser would be sent. One station has two gloves and five trackers, each of several two gloves.
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import httpx
import websockets

from services.acquisition.app import create_app
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.pipelines.servers import bind, run_on_event_loop, serve_all

WARM_UP_S = 6.0
GLOVES = ("tactile_left", "tactile_right")
TRACKERS = ("keypoints_left", "keypoints_right", "wrist_left", "wrist_right", "head")
NAMES = {1: "taxels", 2: "poses", 3: "tile taxels"}


def serve_child(kind: str, *arguments: str) -> None:
    """Serve a station or the dashboard, after writing its address to the standard output."""
    place = bind(kind, host="127.0.0.1", port=0)
    if kind == "dashboard":
        app = create_dashboard(DashboardSettings(stations=json.loads(arguments[0])))
    else:
        streams = [s for s in pattern.pattern_streams() if s.descriptor.name in arguments[1:]]
        pattern.pattern_streams = lambda *_, **__: streams
        app = create_app(AcquisitionSettings(spool=Path(arguments[0]), mock=True))

    def tell() -> None:
        os.write(1, f"{place.url}\n".encode())

    serving = serve_all([(place, app)], stop=asyncio.Event(), on_ready=tell, grace_s=1)
    run_on_event_loop(serving)


async def count_updates(
    url: str, topics: list[str], seconds: float
) -> tuple[Counter[str], Counter[str]]:
    """Messages by what they are and which hand, station or topic: all, and those that differ.

    A text that says the same again, as of a station at rest, is no change but an update.
    """
    updates: Counter[str] = Counter()
    changes: Counter[str] = Counter()
    newest: dict[str, str | bytes] = {}
    address = url.replace("http", "ws", 1) + "/v1/live"
    async with websockets.connect(address, origin=websockets.Origin(url)) as socket:
        await socket.send(json.dumps({"view": topics}))
        stop_s = time.monotonic() + seconds
        while time.monotonic() < stop_s:
            message = await asyncio.wait_for(socket.recv(), seconds)
            if isinstance(message, str):
                name = json.loads(message)["topic"]
            else:
                name = f"{NAMES[message[0]]} {message[1]}"
            updates[name] += 1
            changes[name] += newest.get(name) != message
            newest[name] = message
    return updates, changes


def main() -> None:
    """Start stations and dashboard, and print updates a second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stations", type=int, default=1, help="number of mock stations")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the measurement")
    options = parser.parse_args()
    streams = GLOVES if options.stations > 1 else (*GLOVES, *TRACKERS)
    topics = ["fleet"] if options.stations > 1 else ["taxels", "poses"]
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "benchmarks.dashboard_rates", "--serve", *arguments]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))  # noqa: S603 - ourselves
        return processes[-1]

    def address(process: subprocess.Popen[str]) -> str:
        return process.stdout.readline().strip() if process.stdout else ""

    with tempfile.TemporaryDirectory() as folder:
        try:
            names = [f"desk_{number}" for number in range(options.stations)]
            started = [start("station", f"{folder}/{name}", *streams) for name in names]
            urls = {name: address(one) for name, one in zip(names, started, strict=True)}
            dashboard = address(start("dashboard", json.dumps(urls)))
            httpx.get(f"{dashboard}/healthz").raise_for_status()
            time.sleep(WARM_UP_S)
            updates, changes = asyncio.run(count_updates(dashboard, topics, options.seconds))
            for name, count in sorted(updates.items()):
                changed = changes[name] / options.seconds
                print(
                    f"{name:15} {count / options.seconds:5.1f} updates/s  {changed:5.1f} changes/s"
                )
            print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
        finally:
            for process in processes:
                process.kill()
                process.wait()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve_child(*sys.argv[2:])
    else:
        main()
