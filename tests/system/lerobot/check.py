"""Checks LeRobot's policies: `make check-lerobot-policy`.

The server of a checkpoint gives the actions of LeRobot's own control loop, to each of two clients
at the same time, and `dextouch evaluate` scores it on the twin.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from dextouch.clients import OpenPiPolicy, PolicyStart
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Observation
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli import main
from services.pipelines.servers import served
from services.twin.settings import TwinSettings
from services.twin.world import twin_worlds

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
CHUNK_STEPS = 4


def compare(url: str, folder: Path) -> float:
    """Largest difference to LeRobot's own loop, of two rollouts that alternate."""
    expected = np.load(folder / "expected.npz")
    pose = np.eye(4)
    start = PolicyStart("x", "stand the bottle", 0, AnchorPoses(pose, pose, pose), np.eye(3))
    policies = [OpenPiPolicy(url, chunk_steps=CHUNK_STEPS) for _ in range(2)]
    worst = 0.0
    for _ in range(2):
        for policy in policies:
            policy.reset(start)
        for number, state in enumerate(expected["states"]):
            observation = Observation(
                first_step=0,
                images={"camera_head": expected["images"][number][None]},
                tactile_kpa=np.zeros((1, 2, 320), np.float32),
                action_reached=state[None].astype(np.float64),
                reached_is_measured=True,
            )
            rows = expected["actions"][number * CHUNK_STEPS :][:CHUNK_STEPS]
            for policy in policies:
                worst = max(worst, float(np.abs(policy.act(observation) - rows).max()))
        # The last chunk leaves nothing planned; half a plan must be forgotten, too.
        policies[0].act(observation)
    for policy in policies:
        policy.close()
    return worst


def check(python: str) -> None:
    """Run all with the interpreter of LeRobot's environment."""
    app = create_world_app(twin_worlds(TwinSettings()), WorldServiceSettings())
    environment = os.environ | {"PYTHONPATH": str(ROOT / "shared"), "HF_HUB_OFFLINE": "1"}
    with served({"twin": app}) as urls, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([python, str(HERE / "reference.py"), name], check=True, env=environment)
        words = ["-m", "dextouch.clients.lerobot_policy", name, "--chunk-steps", str(CHUNK_STEPS)]
        with subprocess.Popen(
            [python, *words], stdout=subprocess.PIPE, text=True, env=environment
        ) as server:
            assert server.stdout is not None
            url = next(line.strip() for line in server.stdout if line.startswith("ws://"))
            worst = compare(url, folder)
            report = folder / "report.json"
            words = ["evaluate", "--seeds", "31000:31002", "--tasks", "stand_bottle"]
            words += ["--real.url", urls["twin"], "--real.world", "twin", "--json", str(report)]
            words += ["--policy", "act=dextouch.clients:OpenPiPolicy", "--builtin", "[]"]
            given = {"act": {"url": url, "chunk_steps": CHUNK_STEPS}}
            words += ["--policy-arguments", json.dumps(given), "--num-steps", "16"]
            status = main.main(words)
            server.terminate()
        rollouts = json.loads(report.read_text())["rollouts"]
    assert status == 0
    assert worst < 1e-6, worst
    assert [(r["policy"], r["success"]) for r in rollouts] == [("act", False)] * 2, rollouts
    sys.stdout.write(
        f"a served LeRobot policy acts as in LeRobot's own loop (largest difference {worst:.1g}) "
        f"and finished {len(rollouts)} rollouts in the twin\n"
    )


if __name__ == "__main__":
    check(sys.argv[1])
