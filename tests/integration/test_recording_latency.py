"""From the write of a glove's packet into a pty to the spool and to the live view, in real time."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dextouch.schemas import TakePrompt
from services.acquisition.clock import StationClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.recorder import Take
from services.acquisition.station import LiveView
from tests.integration.recording_streams import human_streams

ROOT = Path(__file__).parents[2]
SECONDS = 10.0
PROMPT = TakePrompt(task="latency", instruction="latency")
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")


def measure(folder):
    """Delays of every packet of one glove of a whole station, printed as JSON (ms)."""
    streams = human_streams(SECONDS, CAMERAS)
    with MockStation(streams, FaultScript(), 1, StationClock(), spool_root=Path(folder)) as mock:
        sent_ns, spooled_ns, live_ns = {}, {}, {}
        device = next(p.device for p in mock.pairs if p.device.name == "glove_left")
        make_units = device.source.units

        def units(index, sequence, t_device_ns):
            made = make_units(index, sequence, t_device_ns)
            sent_ns[sequence] = time.monotonic_ns()
            return made

        def noting(accept, times_ns):
            def accept_and_note(receiver, readings):
                accept(receiver, readings)
                for sample in readings.get("tactile_left", ()):
                    times_ns[sample.sequence] = time.monotonic_ns()

            return accept_and_note

        device.source.units = units
        Take.accept = noting(Take.accept, spooled_ns)
        LiveView.accept = noting(LiveView.accept, live_ns)
        mock.run_take(PROMPT, recording_id="take")
    late_ms = {
        name: [(times_ns[s] - sent_ns[s]) / 1e6 for s in sent_ns]
        for name, times_ns in (("spool", spooled_ns), ("live", live_ns))
    }
    print(json.dumps(late_ms))  # noqa: T201


@pytest.mark.slow
def test_glove_packets_reach_spool_and_live_view_in_time(tmp_path):
    # In a process of its own, since the shape checks of tests cost more than what is measured.
    answer = subprocess.run(
        [sys.executable, __file__, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'shared'}"},
    )
    late_ms = json.loads(answer.stdout.splitlines()[-1])
    for name, values in late_ms.items():
        assert len(values) == round(60 * SECONDS)
        print(f"{name}: median {np.median(values):.2f}, p99 {np.percentile(values, 99):.2f} ms")  # noqa: T201
    assert np.percentile(late_ms["spool"], 99) <= 5.0
    assert np.percentile(late_ms["live"], 99) <= 100.0


if __name__ == "__main__":
    measure(sys.argv[1])
