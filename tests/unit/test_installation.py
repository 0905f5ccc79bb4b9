"""The command that adds an extra fits the way in which the package was installed (PEP 610)."""

import importlib.metadata
import json
import sys
from pathlib import Path

import pytest

from dextouch import installation

METADATA = """\
Metadata-Version: 2.4
Name: dextouch-wm
Version: 0.1.0
Requires-Dist: numpy>=2.2
Requires-Dist: av<20,>=15; extra == 'store'
Requires-Dist: uvloop>=0.22; (sys_platform != 'win32') and extra == 'serve'
Requires-Dist: zarr<4,>=3.1; extra == 'store'
Requires-Dist: torch<3,>=2.7; extra == 'model'
Requires-Dist: dextouch-wm-weights==0.1.0; extra == 'model'
"""
ROOT = Path(__file__).parents[2]


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Make an installation with these records; pip is that of this Python."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(
        installation.shutil, "which", lambda _: str(Path(sys.executable).with_name("pip"))
    )
    folder = tmp_path / "dextouch_wm-0.1.0.dist-info"

    def make(origin=None, *, installer="pip"):
        folder.mkdir()
        (folder / "METADATA").write_text(METADATA)
        (folder / "INSTALLER").write_text(f"{installer}\n")
        if origin is not None:
            (folder / "direct_url.json").write_text(json.dumps(origin))

    return make


# The records are examples of PEP 610 and of "Recording the Direct URL Origin of installed
# distributions" of the Python Packaging User Guide.
@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'dextouch-wm[store]'"),
        (
            {"url": "file:///home/ada/a%20b", "dir_info": {"editable": True}},
            "pip install -e '/home/ada/a b[store]'",
        ),
        ({"url": "file:///home/ada/touch", "dir_info": {}}, "pip install '/home/ada/touch[store]'"),
        (
            {"url": "https://example.org/d.whl", "archive_info": {"hash": "sha256=2dc6b5"}},
            "pip install 'dextouch-wm[store] @ https://example.org/d.whl'",
        ),
        (
            {
                "url": "https://example.org/d.git",
                "vcs_info": {"vcs": "git", "commit_id": "7921be15", "requested_revision": "main"},
            },
            "pip install 'dextouch-wm[store] @ git+https://example.org/d.git@7921be15'",
        ),
        # The wheel is gone: what the extra asks for, which needs no wheel.
        (
            {"url": "file:///tmp/gone.whl", "archive_info": {}},
            "pip install 'av<20,>=15' 'zarr<4,>=3.1'",
        ),
    ],
)
def test_each_way_of_installing_has_its_command(installed, origin, command):
    installed(origin)
    assert installation.install_command("store") == command


def test_wheels_of_a_folder_are_named(installed, tmp_path):
    wheel = tmp_path / "dist/dextouch_wm-0.1.0-py3-none-any.whl"
    wheel.parent.mkdir()
    wheel.touch()
    installed({"url": wheel.as_uri(), "archive_info": {}})
    place = wheel.as_uri()
    assert installation.install_command("store") == f"pip install 'dextouch-wm[store] @ {place}'"
    weights = place.replace("dextouch_wm-", "dextouch_wm_weights-")
    assert installation.install_command("model") == (
        f"pip install 'dextouch-wm-weights @ {weights}' 'dextouch-wm[model] @ {place}'"
    )


_WHEEL = "dextouch_wm-0.1.0-py3-none-any.whl"


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'dextouch-wm[model]'"),
        # An editable installation reads the weights of the checkout.
        (
            {"url": "file:///home/ada/touch", "dir_info": {"editable": True}},
            "pip install -e '/home/ada/touch[model]'",
        ),
        (
            {"url": "file:///home/ada/touch", "dir_info": {}},
            "pip install /home/ada/touch/weights '/home/ada/touch[model]'",
        ),
        (
            {"url": "https://example.org/d.git", "vcs_info": {"vcs": "git", "commit_id": "79be15"}},
            "pip install "
            "'dextouch-wm-weights @ git+https://example.org/d.git@79be15#subdirectory=weights' "
            "'dextouch-wm[model] @ git+https://example.org/d.git@79be15'",
        ),
        (
            {"url": f"https://example.org/a/{_WHEEL}?key=a/b", "archive_info": {}},
            "pip install 'dextouch-wm-weights @ "
            "https://example.org/a/dextouch_wm_weights-0.1.0-py3-none-any.whl' "
            f"'dextouch-wm[model] @ https://example.org/a/{_WHEEL}?key=a/b'",
        ),
        (
            {"url": "https://example.org/d.zip", "archive_info": {}},
            "pip install 'dextouch-wm-weights @ https://example.org/d.zip#subdirectory=weights' "
            "'dextouch-wm[model] @ https://example.org/d.zip'",
        ),
        # The wheel is gone; pip names the one of the weights, if that is gone as well.
        (
            {"url": f"file:///tmp/gone/{_WHEEL}", "archive_info": {}},
            "pip install 'dextouch-wm-weights @ "
            "file:///tmp/gone/dextouch_wm_weights-0.1.0-py3-none-any.whl' 'torch<3,>=2.7'",
        ),
    ],
)
def test_weights_come_from_where_the_package_came_from(installed, origin, command):
    installed(origin)
    assert installation.install_command("model") == command


def test_markers_other_than_the_extra_are_left_to_pip(installed):
    installed({"url": "file:///tmp/gone.whl", "archive_info": {}})
    assert installation.install_command("serve") == "pip install 'uvloop>=0.22'"


def test_uv_installs_what_uv_installed(installed, monkeypatch):
    installed(installer="uv")
    monkeypatch.setenv("VIRTUAL_ENV", sys.prefix)
    assert installation.install_command("s3") == "uv pip install 'dextouch-wm[s3]'"
    monkeypatch.delenv("VIRTUAL_ENV")
    command = installation.install_command("s3")
    assert command == f"uv pip install --python {sys.executable} 'dextouch-wm[s3]'"


def test_pip_of_another_environment_is_not_used(installed, monkeypatch):
    installed()
    monkeypatch.setattr(installation.shutil, "which", lambda _: "/usr/bin/pip")
    command = installation.install_command("s3")
    assert command == f"{sys.executable} -m pip install 'dextouch-wm[s3]'"


def test_a_checkout_on_the_path_is_installed_editable(monkeypatch):
    def distribution(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.distribution", distribution)
    assert installation.install_command("s3").endswith(f"install -e '{ROOT}[s3]'")
