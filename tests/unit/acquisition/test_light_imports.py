"""A station's process starts light: nothing heavy is imported before it is needed."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "cv2", "zarr", "scipy", "mujoco", "serial", "hidraw")


@pytest.mark.long
@pytest.mark.parametrize(
    "module",
    [
        "services.acquisition",
        "services.acquisition.devices.tactile_glove",
        "services.acquisition.station",
        "services.acquisition.mock_station",
        "services.acquisition.app",
    ],
)
def test_nothing_heavy(module):
    code = f"import sys, {module}; print(*[m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
