"""What the images hold, and who runs in them."""

import json

import pytest

pytestmark = pytest.mark.containers
MB = 10**6
# With room for dependencies to grow; docs/images.md states what was measured.
LIGHT_BYTES, MODEL_BYTES, CODE_MB = 1250 * MB, 2300 * MB, 60
LOOK = """
import importlib.util, json, os, pathlib, sys
print(json.dumps({
    "uid": os.getuid(), "gid": os.getgid(), "home": os.path.expanduser("~"),
    "found": [n for n in sys.argv[1:] if importlib.util.find_spec(n)],
    "writable": [p for p in ("/", "/opt/code", "/opt/dextouch") if os.access(p, os.W_OK)],
}))
"""
SOLVER = """
import json
from dextouch_services.alignment.retargeting import warm_up
from dextouch_services.alignment.retargeting.solver.solve import retarget_samples
warm_up()
print(json.dumps({"is_loaded": bool(retarget_samples.stats.cache_hits)}))
"""
GUARDED = ("--read-only", "--read-only-tmpfs=false", "--cap-drop", "ALL", "--network", "none")
TMPFS = "--tmpfs=/tmp"


@pytest.fixture
def run(engine, built):
    """Run Python in an image as the compose file guards its services; the JSON that it prints."""

    def run(target, code, *arguments):
        words = ("run", "--rm", *GUARDED, TMPFS, f"localhost/dextouch:{target}")
        done = engine.podman(*words, "python", "-c", code, *arguments)
        return json.loads(done.stdout.splitlines()[-1])

    return run


def test_sizes(engine, built):
    sizes = {t: engine.inspect(f"localhost/dextouch:{t}", ".Size") for t in built}
    assert sizes["light"] < LIGHT_BYTES
    assert sizes["model"] < MODEL_BYTES


def test_images_share_all_layers_but_torch_and_the_code(engine, built):
    light, model = (engine.inspect(f"localhost/dextouch:{t}", ".RootFS.Layers") for t in built)
    # The code last: what a station fetches for a new version.
    assert model[: len(light) - 1] == light[:-1]
    shown = ("history", "--no-trunc", "--format", "{{.Size}} {{.CreatedBy}}", "dextouch:light")
    lines = engine.podman(*shown).stdout.splitlines()
    (code,) = [line for line in lines if line.rstrip().endswith(" in /opt/code")]
    size, unit, *_ = code.split()
    assert unit == "MB"
    assert 0 < float(size) < CODE_MB


@pytest.mark.parametrize("target", ["light", "model"])
def test_images_run_as_a_user_who_writes_nothing(run, target):
    seen = run(
        target,
        LOOK,
        "torch",
        "triton",
        "nvidia",
        "pip",
        "setuptools",
        "cv2",
        "mujoco",
        "scipy.tests",
    )
    assert (seen["uid"], seen["gid"], seen["home"]) == (10001, 10001, "/data")
    assert seen["writable"] == []
    torch = ["torch", "setuptools"] if target == "model" else []
    assert sorted(seen["found"]) == sorted(["cv2", "mujoco", *torch])


def test_the_compiled_solver_is_used_and_not_compiled_again(run):
    assert run("light", SOLVER) == {"is_loaded": True}
