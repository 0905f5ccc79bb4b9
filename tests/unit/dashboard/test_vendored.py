"""Vendored files of the pages are those of their packages, with their licences."""

import hashlib
import json
from pathlib import Path

import pytest

from dextouch.serving import api_page
from services.dashboard.app import STATIC


@pytest.mark.parametrize("folder", [STATIC, api_page.FOLDER])
def test_vendored_files_have_their_recorded_hashes(folder):
    vendor = folder / "vendor"
    packages = json.loads((vendor / "vendored.json").read_text())
    recorded = {name: sha for one in packages for name, sha in one["sha256"].items()}
    found = {
        str(path.relative_to(vendor)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in vendor.rglob("*")
        if path.is_file() and path.name != "vendored.json"
    }
    assert found == recorded
    for one in packages:
        licences = [name for name in one["files"] if Path(name).name == "LICENSE"]
        assert licences, one["package"]
