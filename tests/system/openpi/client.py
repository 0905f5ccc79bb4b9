"""Drives a rollout with openpi's own client; runs in an environment without dextouch."""

import json
import sys

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def main() -> None:
    """Hold the start of one rollout for two chunks, and print what came back."""
    client = WebsocketClientPolicy(sys.argv[1])
    (world,) = [one for one in client.get_server_metadata()["worlds"] if one["name"] == "twin"]
    start = {"world": "twin", "task": world["tasks"][0], "seed": 31000, "instruction": ""}
    seen = client.infer({"start": start, "return": {"cameras": ["camera_head"]}})
    for _ in range(2):
        seen = client.infer({"actions": np.tile(seen["action_reached"][-1], (16, 1))})
    shapes = {name: list(value.shape) for name, value in seen.items() if hasattr(value, "shape")}
    client.infer({"end": True})
    sys.stdout.write(json.dumps({"last_step": seen["rollout"]["last_step"], "shapes": shapes}))


if __name__ == "__main__":
    main()
