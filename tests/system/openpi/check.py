"""Checks openpi both ways: `make check-openpi`.

openpi's own client drives a rollout of the twin, and `dextouch evaluate` scores a policy that is
served with openpi's own packing. It must score as the bundled policy that holds still.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli import main
from services.pipelines.servers import served
from services.twin.settings import TwinSettings
from services.twin.world import twin_worlds

HERE = Path(__file__).parent
SHAPES = {
    "image/camera_head": [16, 64, 64, 3],
    "tactile_kpa": [16, 2, 320],
    "action_reached": [16, 67],
}


def check(python: str) -> None:
    """Run both directions with the interpreter of openpi's environment."""
    app = create_world_app(twin_worlds(TwinSettings()), WorldServiceSettings())
    with served({"twin": app}) as urls, tempfile.TemporaryDirectory() as folder:
        url = urls["twin"].replace("http", "ws") + "/v1/openpi"
        driven = subprocess.run(
            [python, str(HERE / "client.py"), url], check=True, stdout=subprocess.PIPE, text=True
        )
        seen = json.loads(driven.stdout)
        assert seen["last_step"] == 32, seen
        for name, shape in SHAPES.items():
            got = seen["shapes"][name]
            assert got[:1] + got[-1:] == shape[:1] + shape[-1:], (name, got)
        with subprocess.Popen(
            [python, str(HERE / "server.py")], stdout=subprocess.PIPE, text=True
        ) as server:
            assert server.stdout is not None
            address = f"ws://127.0.0.1:{int(server.stdout.readline())}"
            report = Path(folder) / "report.json"
            words = ["evaluate", "--seeds", "31000:31003", "--tasks", "stand_bottle"]
            words += ["--real.url", urls["twin"], "--real.world", "twin", "--json", str(report)]
            words += ["--policy", "pi=dextouch.clients:OpenPiPolicy", "--builtin", "hold"]
            words += ["--policy-arguments", json.dumps({"pi": {"url": address}})]
            status = main.main(words)
            server.terminate()
        rollouts = json.loads(report.read_text())["rollouts"]
    assert status == 0
    outcomes = {
        name: [(r["seed"], r["success"]) for r in rollouts if r["policy"] == name]
        for name in ("pi", "hold")
    }
    assert outcomes["pi"] == outcomes["hold"], outcomes
    sys.stdout.write(
        f"openpi's client drove {seen['last_step']} steps of the twin; a policy behind its "
        f"protocol finished {len(outcomes['pi'])} rollouts as the bundled one does\n"
    )


if __name__ == "__main__":
    check(sys.argv[1])
