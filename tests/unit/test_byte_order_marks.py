"""Text files as editors and spreadsheets of Windows write them: with a byte-order mark."""

import codecs
import json

import numpy as np
import pytest

from dextouch.bridges.lerobot import source
from dextouch.serving import configuration_file
from services.acquisition.devices import load_calibration
from services.alignment.station_calibration import record
from services.dashboard.pages import DEFAULT_TASKS, load_tasks
from services.dashboard.settings import DashboardSettings
from services.evaluation.rating.rubrics import BUNDLED, read_rubrics

POSES = "image,x_m,y_m,z_m,qw,qx,qy,qz\r\na.jpg,0,0,0.5,1,0,0,0\r\n"


@pytest.fixture
def write(tmp_path):
    def marked(name, text):
        path = tmp_path / name
        path.write_bytes(codecs.BOM_UTF8 + text.encode())
        return path

    return marked


def test_poses_of_photos(write):
    poses = record.poses_of_photos(write("poses.csv", POSES), "poses")
    assert list(poses) == ["a.jpg"]
    np.testing.assert_array_equal(poses["a.jpg"][:3, 3], [0, 0, 0.5])


def test_pairs(write):
    pairs = np.tile(np.eye(4), (3, 2, 1, 1))
    found = record.read_pairs(write("pairs.json", json.dumps(pairs.tolist())), "pairs")
    np.testing.assert_array_equal(found, pairs)


def test_calibration(write):
    path = write("calibration.json", '{"K_head": [[1, 0], [0, 1]]}')
    assert load_calibration(path) == {"K_head": ((1, 0), (0, 1))}
    assert record.read_matrices(path) == {"K_head": ((1, 0), (0, 1))}


def test_tasks_and_rubrics(write):
    assert load_tasks(write("t.toml", DEFAULT_TASKS.read_text())) == load_tasks(None)
    assert read_rubrics(write("r.toml", BUNDLED.read_text())) == read_rubrics()


def test_configuration(write, monkeypatch):
    path = write("dextouch.toml", "[dashboard]\r\nport = 8123\r\n")
    monkeypatch.setenv(configuration_file.VARIABLE, str(path))
    assert DashboardSettings().port == 8123
    assert configuration_file.line_of(path, ["dashboard", "port"]) == 2


def test_sidecars_of_datasets(tmp_path):
    path = tmp_path / "meta.json"
    path.write_bytes(codecs.BOM_UTF8 + b"{}")
    assert source._small_file(path, 1024) == b"{}"
