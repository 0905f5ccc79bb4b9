"""`python -m services.acquisition.mock_bridge KIND PLACE`: a mock SDK process.

It plays the made-up pattern of one hand or tracker over a bridge until it is ended, and writes one
line of JSON with its port to the standard output once it listens.
"""

import argparse
import itertools
import json
import sys

import numpy as np

from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.finger_tracker.mock import BridgeFingerTrackerSource
from services.acquisition.devices.pose_tracker.mock import BridgePoseSource
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import ROUND_S, pattern_streams
from services.acquisition.mocks.replay import MockDevice, MockPlace
from services.acquisition.mocks.sdk_link import BridgeServer, BridgeSource, signs_of_life


def pattern_source(kind: str, place: str, *, seed: int) -> BridgeSource:
    """The pattern of `finger_tracker` `left`/`right`, or `pose_tracker` `wrist_left`/…/`head`."""
    streams = {stream.descriptor.name: stream for stream in pattern_streams()}
    rng = np.random.default_rng(seed)
    if kind == "finger_tracker":
        side: Side = "left" if place == "left" else "right"
        return BridgeFingerTrackerSource(streams[f"keypoints_{side}"], side=side, rng=rng)
    return BridgePoseSource(streams[place], faults=DeviceFaults(), rng=rng)


def main() -> None:
    """Serve until ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("finger_tracker", "pose_tracker"))
    parser.add_argument("place", choices=("left", "right", "wrist_left", "wrist_right", "head"))
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    is_hand = options.place in {"left", "right"}
    if is_hand != (options.kind == "finger_tracker"):
        parser.error(f"a {options.kind} cannot sit at {options.place!r}")
    source = pattern_source(options.kind, options.place, seed=options.seed)
    server, clock = BridgeServer(source.hello, port=options.port), StationClock()
    place = MockPlace("bridge", pattern_streams()[0], DeviceFaults(), options.seed, clock)
    device = MockDevice(place, source, server)
    server.plug()
    signs_of_life(device, source.magic, clock).start()
    sys.stdout.write(json.dumps({"port": server.port}) + "\n")
    sys.stdout.flush()
    start_ns, waiter = clock.now_ns(), clock.waiter(drives_time=True)
    for lap in itertools.count():
        offset_ns = round(lap * ROUND_S * 1e9)
        device.play(clock, waiter, start_host_ns=start_ns, offset_ns=offset_ns)


if __name__ == "__main__":
    main()
