"""Help of a command: it imports what its flags need, and none of the work."""

import os
import subprocess
import sys

import pytest

from services.cli.main import COMMANDS

# What takes long to import, or is needed only to do the work.
HEAVY = (
    *("torch", "numpy", "scipy", "mujoco", "zarr", "cv2", "av", "jaxtyping", "safetensors"),
    *("fastapi", "uvicorn", "redis", "structlog", "rich", "httpx", "prometheus_client"),
)
# Kinds of calibration boards are described by the module that uses them.
EXEMPT = {"station calibrate": {"numpy", "jaxtyping"}}
SHOW_HELP = """
import os, sys
from services.cli.main import main
try:
    main([*sys.argv[1:], "--help"])
except SystemExit as stop:
    assert not stop.code
spent = os.times()
print(spent.user + spent.system, *sys.modules, file=sys.stderr)
"""


def cpu_s_and_modules(code, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, check=True, env=os.environ | {"COLUMNS": "100"},
    )  # fmt: skip
    assert not arguments or "usage: dextouch" in done.stdout
    spent, *modules = done.stderr.splitlines()[-1].split()
    return float(spent), set(modules)


@pytest.fixture(scope="module")
def pydantic_s():
    """CPU time of starting Python with the library of settings, a third of what help may take."""
    code = "import os, sys, pydantic_settings; t = os.times(); print(t[0] + t[1], file=sys.stderr)"
    return min(cpu_s_and_modules(code)[0] for _ in range(3))


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.target])
def test_help_is_cheap(name, pydantic_s):
    # On an idle 3 GHz core the settings library takes 0.1 s, and help at most 0.3 s.
    limit_s = 3.0 * pydantic_s
    for _ in range(3):
        cpu_s, modules = cpu_s_and_modules(SHOW_HELP, *name.split())
        heavy = modules & set(HEAVY) - EXEMPT.get(name, set())
        assert not heavy, f"{name} --help imports {sorted(heavy)}"
        if cpu_s <= limit_s:
            return
    pytest.fail(f"{name} --help took {cpu_s:.2f} CPU s, expected at most {limit_s:.2f}")
