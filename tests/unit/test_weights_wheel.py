"""The weights are a wheel of their own, which extras with networks require and errors name."""

import importlib.util
import tomllib
from pathlib import Path

import pytest

from dextouch.errors import NotFoundError
from services.networks import weight_files

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
hatch_build = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(hatch_build)
EXTRAS = {"store": ["zarr"], "model": ["torch", "safetensors>=0.8"], "all": ["safetensors>=0.8"]}


def test_extras_with_networks_require_the_weights_of_their_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert hatch_build.required_weights(ROOT, EXTRAS) == [
        f"dextouch-wm-weights=={version}; extra == 'model'",
        f"dextouch-wm-weights=={version}; extra == 'all'",
    ]


def test_a_build_without_weights_requires_none(tmp_path):
    # The image installs what is required before the code is there.
    (tmp_path / "services").mkdir()
    assert hatch_build.required_weights(tmp_path, EXTRAS) == []


def test_every_folder_of_weights_is_in_their_wheel():
    text = (ROOT / "weights/pyproject.toml").read_text()
    included = tomllib.loads(text)["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    folders = {path.parent for path in (ROOT / "services").rglob("*.safetensors")}
    assert {(ROOT / "weights" / folder).resolve() for folder in included} == folders
    for folder, installed in included.items():
        assert installed == folder.replace("../services", "dextouch_services")


def test_weights_that_are_not_installed_are_named_with_their_command(tmp_path, monkeypatch):
    installed = tmp_path / "dextouch_services"
    monkeypatch.setattr(weight_files, "_PACKAGE", installed)
    path = installed / "world_model/pretrained/state.safetensors"
    with pytest.raises(NotFoundError, match=r"weights are a package of their own: `.*\[model\]"):
        weight_files.read_history(path, weight_files.BaseModel, "key")
    with pytest.raises(NotFoundError, match="train one first"):
        weight_files.read_history(tmp_path / "mine.safetensors", weight_files.BaseModel, "key")
