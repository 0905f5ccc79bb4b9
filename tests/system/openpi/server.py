"""A policy that holds still, served in openpi's protocol by openpi's own packing.

Runs in an environment without dextouch. openpi's server is not part of its client package; this one
follows its messages: metadata first, then one answer for each observation, errors as text.
"""

import sys
import traceback

import numpy as np
from openpi_client import msgpack_numpy
from websockets.sync.server import ServerConnection, serve

CHUNK_STEPS = 50


def infer(observation: dict) -> dict:
    """Hold the reached pose; the image and the prompt must be there."""
    assert observation["observation/image"].dtype == np.uint8
    assert observation["observation/image"].ndim == 3
    assert isinstance(observation["prompt"], str)
    state = observation["observation/state"].astype(np.float32)
    return {"actions": np.tile(state, (CHUNK_STEPS, 1)), "server_timing": {"infer_ms": 0.1}}


def handle(connection: ServerConnection) -> None:
    """Serve one client."""
    packer = msgpack_numpy.Packer()
    connection.send(packer.pack({"policy": "hold"}))
    for data in connection:
        try:
            connection.send(packer.pack(infer(msgpack_numpy.unpackb(data))))
        except Exception:
            connection.send(traceback.format_exc())
            raise


def main() -> None:
    """Serve on a free port, which is printed."""
    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        sys.stdout.write(f"{server.socket.getsockname()[1]}\n")
        sys.stdout.flush()
        server.serve_forever()


if __name__ == "__main__":
    main()
