"""`python -m services.acquisition.mock_bridge KIND PLACE`: a mock SDK process.

It plays the made-up pattern of one hand or tracker to every station that connects until it is
ended, and writes one line of JSON with its port to the standard output once it listens.
"""

import argparse
import contextlib
import itertools
import json
import socketserver
import sys
import time

import numpy as np

from dextouch.tactile.layout import Side
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import ROUND_S, pattern_streams
from services.acquisition.mocks.trackers_and_cameras import (
    BridgeFingerTrackerSource,
    BridgePoseSource,
    BridgeSource,
)

ROUND_NS = round(ROUND_S * 1e9)


def pattern_source(kind: str, place: str, *, seed: int) -> BridgeSource:
    """The pattern of `finger_tracker` `left`/`right`, or `pose_tracker` `wrist_left`/…/`head`."""
    streams = {stream.descriptor.name: stream for stream in pattern_streams()}
    rng = np.random.default_rng(seed)
    if kind == "finger_tracker":
        side: Side = "left" if place == "left" else "right"
        return BridgeFingerTrackerSource(streams[f"keypoints_{side}"], side=side, rng=rng)
    return BridgePoseSource(streams[place], faults=DeviceFaults(), rng=rng)


class BridgeServer(socketserver.ThreadingTCPServer):
    """Says hello to every connection, and then the same samples at the same times to all of them.

    The source samples too fast for a bridge to need signs of life.
    """

    allow_reuse_address = daemon_threads = True

    def __init__(self, source: BridgeSource, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), BridgeConnection)
        self.source = source
        self.start_ns = time.monotonic_ns()


class BridgeConnection(socketserver.StreamRequestHandler):
    """One station, until it goes."""

    disable_nagle_algorithm = True
    server: BridgeServer

    def handle(self) -> None:
        """Send hello and samples."""
        source, start_ns = self.server.source, self.server.start_ns
        with contextlib.suppress(OSError):  # the station has gone
            self.wfile.write(source.hello)
            first_lap = (time.monotonic_ns() - start_ns) // ROUND_NS
            for number in itertools.count(first_lap * len(source.t_ns)):
                lap, index = divmod(number, len(source.t_ns))
                t_ns = lap * ROUND_NS + int(source.t_ns[index])
                ahead_ns = start_ns + t_ns - time.monotonic_ns()
                if ahead_ns > 0:
                    time.sleep(ahead_ns * 1e-9)
                    self.wfile.write(b"".join(source.units(index, number, t_ns)))


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
    with BridgeServer(source, options.port) as server:
        sys.stdout.write(json.dumps({"port": server.server_address[1]}) + "\n")
        sys.stdout.flush()
        server.serve_forever()


if __name__ == "__main__":
    main()
