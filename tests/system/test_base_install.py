"""The base dependencies alone, in an empty environment, are enough to drive a rollout."""

import json
import os
import subprocess
import venv
from pathlib import Path

import pytest

from dextouch.worlds import WorldServiceSettings, create_world_app
from tests.unit.worlds.fakes import SumWorld
from tests.unit.worlds.running import served

ROOT = Path(__file__).parents[2]
DRIVER = """
import importlib.util, json, sys
import numpy as np
from dextouch.clients import RolloutClient
from dextouch.errors import NonFiniteError
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES

actions = np.zeros((4, 67))
for part in POSE_SLICES:
    actions[:, part] = IDENTITY_POSE_9D
asked = dict(world="sum", task="stand_bottle", seed=3, instruction="stand the bottle")
with RolloutClient(sys.argv[1]) as client, client.start(**asked) as rollout:
    first = float(rollout.observation.tactile_kpa[0, 0, 0])
    seen = [rollout.step(actions).first_step for _ in range(3)]
    try:
        rollout.step(np.full((4, 67), np.nan))
    except NonFiniteError:
        refused = True
heavy = ["fastapi", "torch", "cv2", "zarr", "httpx", "redis", "pydantic_settings", "structlog"]
found = [name for name in heavy if importlib.util.find_spec(name)]
print(json.dumps({"first": first, "seen": seen, "refused": refused, "heavy": found}))
"""


@pytest.mark.slow
@pytest.mark.system
def test_a_policy_needs_only_the_base_dependencies(tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = str(tmp_path / "venv" / "bin" / "python")
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run(
        [*install, "-c", str(ROOT / "constraints.txt"), str(ROOT)], check=True, timeout=600
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with served(create_world_app({"sum": SumWorld()}, WorldServiceSettings())) as url:
        done = subprocess.run(
            [python, "-c", DRIVER, url],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
            cwd=tmp_path,
            env=environment,
        )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {
        "first": 3.0,
        "seen": [1, 5, 9],
        "refused": True,
        "heavy": [],
    }
