"""A catalog of thousands of episodes is listed from memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def measured(folder, count):
    command = [sys.executable, "-m", "tests.integration.store_large_catalog", folder, str(count)]
    paths = [str(ROOT), *(path for path in sys.path if path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    out = subprocess.check_output(command, cwd=ROOT, env=environment)
    return json.loads(out.splitlines()[-1])


def test_many_are_counted(tmp_path):
    assert measured(tmp_path / "store", 40)["num"] == 40


@pytest.mark.slow
def test_five_thousand_are_listed_at_once(tmp_path):
    report = measured(tmp_path / "store", 5000)
    print(json.dumps(report))  # noqa: T201
    assert report["num"] == 5000
    assert report["settled_list_ms"] < 50
    assert report["settled_filtered_ms"] < 50
    assert report["settled_hours_ms"] < 50
