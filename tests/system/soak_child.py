"""A whole station that records and uploads take after take on a simulated clock until killed."""

import json
import sys
import threading
from pathlib import Path

import numpy as np
import structlog

from dextouch.clients import EpisodeStoreClient
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.recorder import keep_for_life
from services.acquisition.settings import MockLinks
from services.acquisition.uploader import Uploader, recover_spool
from tests.integration.recording_streams import human_streams, robot_streams

CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
NAMES = (
    *(f"{kind}_{side}" for kind in ("glove", "finger_tracker") for side in ("left", "right")),
    *(f"pose_tracker_{stream}" for stream in ("head", "wrist_left", "wrist_right")),
    *CAMERAS,
    "robot_state",
)


PROMPT = TakePrompt(task="soak", instruction="soak")


def all_streams(seconds):
    """Everything that a station can have at once; trackers give the wrists, the robot the rest."""
    streams = [*robot_streams(seconds), *human_streams(seconds, CAMERAS)]
    return list({stream.descriptor.name: stream for stream in streams}.values())


def random_faults(seed, seconds, num_takes):
    """Ordinary faults everywhere, a bad one on a third of the devices, unplugging in each take."""
    rng = np.random.default_rng(seed)
    at = float(rng.uniform(0.2, 0.6)) * seconds
    bad = [
        {"drop_probability": 0.02},
        {"duplicate_probability": 0.02},
        {"reorder_probability": 0.02},
        {"half_packet_probability": 0.01},
        {"clock_step_at_s": at, "clock_step_s": 0.2},
        {"burst_ms": 40.0},
        {"first_sequence": 2**32 - 200},
        {"bit_error_rate": 1e-5, "byte_loss_rate": 1e-5},
    ]
    base = {"skew_ppm": 50.0, "path_delay_ms": 2.0, "jitter_ms": 0.8, "drop_probability": 0.002}
    devices = {}
    for name in NAMES:
        fault = bad[rng.integers(len(bad))] if rng.random() < 1 / 3 else {}
        unplugged_s, stalls_s = [], []
        for take in range(num_takes):
            start = (take + float(rng.uniform(0.2, 0.6))) * seconds
            if rng.random() < 0.1:
                unplugged_s.append((start, start + 0.3 * seconds))
            elif rng.random() < 0.1:
                stalls_s.append((start, start + 0.1 * seconds))
        timed = {"unplugged_s": tuple(unplugged_s), "stalls_s": tuple(stalls_s)}
        devices[name] = DeviceFaults.model_validate({**base, **fault, **timed})
    return FaultScript(devices=devices, others=DeviceFaults(**base))


def rss_bytes():
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def tell(**facts):
    """One line of JSON for the parent."""
    print(json.dumps(facts), flush=True)  # noqa: T201


def acknowledge(recorder, done):
    """Say again and again what the recorder has acknowledged of the running take."""
    while not done.wait(0.05):
        status = recorder.status()
        if status.state == "recording":
            tell(event="spooled", take=status.recording_id, counts=status.num_samples)


def record(mock, number):
    """One more take of a running station."""
    done = threading.Event()
    teller = threading.Thread(target=acknowledge, args=(mock.station.recorder, done))
    teller.start()
    try:
        take = mock.run_take(PROMPT, recording_id=f"take-{number:03d}")
    finally:
        done.set()
        teller.join()
    counts = {stream.stream: stream.num_samples for stream in take.check.streams}
    tell(event="saved", take=take.recording_id, counts=counts)


def upload(uploader):
    """Everything that is finished."""
    for _ in range(50):
        uploader.upload_all()
        if all(status.uploaded for status in uploader.status()):
            return


def main(spool, store_url, seed, first_take, end_take, seconds):
    """Record the takes from the first one on by one station."""
    # Facts go out alone, or a warning of another thread could end up inside of one.
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    root, seconds, number = Path(spool), float(seconds), int(first_take)
    recover_spool(root)
    num_takes = int(end_take) - number
    mock = MockStation(
        all_streams(seconds),
        random_faults(int(seed) * 1000 + number, seconds, num_takes),
        number,
        VirtualClock(),
        spool_root=root,
        links=MockLinks(wrists="trackers"),
    )
    with mock, EpisodeStoreClient(store_url) as client:
        uploader = Uploader(root, client, period_s=1.0)
        # As `dextouch station serve` does.
        keep_for_life()
        assert {pair.device.name for pair in mock.pairs} == set(NAMES)
        for _ in range(num_takes):
            record(mock, number)
            upload(uploader)
            tell(event="uploaded", rss_bytes=rss_bytes())
            number += 1
        upload(uploader)
    tell(event="done")


if __name__ == "__main__":
    main(*sys.argv[1:])
