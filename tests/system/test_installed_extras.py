"""The command of a missing extra, run in a shell, adds it, however the package was installed."""

import os
import subprocess
import venv

import pytest

from tests.system.wheel_environment import ROOT, build_wheels

pytestmark = [pytest.mark.slow, pytest.mark.system]

TELL = "from dextouch.installation import install_command; print(install_command('gym'))"
USE = "import gymnasium, dextouch.clients.gym_env"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The built wheel, below the folder of an index (PEP 503)."""
    folder = tmp_path_factory.mktemp("index") / "simple/dextouch-wm"
    build_wheels(folder)
    (wheel,) = folder.glob("dextouch_wm-*.whl")
    (folder / "index.html").write_text(f'<a href="{wheel.name}">{wheel.name}</a>')
    return wheel


@pytest.mark.parametrize("way", ["wheel", "lost wheel", "checkout", "folder", "index"])
def test_the_command_works(wheel, tmp_path, way):
    index = wheel.parents[1].as_uri()
    copy = tmp_path / wheel.name
    copy.write_bytes(wheel.read_bytes())
    words = {
        "wheel": [str(copy)],
        "lost wheel": [str(copy)],
        "checkout": ["-e", str(ROOT)],
        "folder": [str(ROOT)],
        "index": ["dextouch-wm"],
    }[way]
    venv.create(tmp_path / "venv", with_pip=True)
    binaries = tmp_path / "venv/bin"
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    kept |= {
        "PATH": f"{binaries}:{os.environ['PATH']}",
        "PIP_CONSTRAINT": str(ROOT / "constraints.txt"),
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        # Builds import hatch_build.py in the checkout.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    if way == "index":
        kept["PIP_EXTRA_INDEX_URL"] = index

    def run(*command):
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env=kept,
            text=True,
            capture_output=True,
            check=False,
            timeout=600,
        )
        return done.returncode, done.stdout.strip(), done.stderr[-3000:]

    python = str(binaries / "python")
    assert run(python, "-m", "pip", "install", *words)[0] == 0
    if way == "lost wheel":
        copy.unlink()
    assert run(python, "-c", USE)[0] == 1
    _, command, _ = run(python, "-c", TELL)
    assert ("-e" in command) == (way == "checkout")
    status, _, errors = run("sh", "-c", command)
    assert status == 0, f"{command}: {errors}"
    assert run(python, "-c", USE)[0] == 0
    # Nothing else was changed: it is still installed as it was.
    assert run(python, "-c", TELL)[1] == command
