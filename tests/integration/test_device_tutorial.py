"""docs/tutorials/add_a_device.md followed literally: built, installed, recorded and judged."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from services.acquisition.mocks.pattern import pattern_streams
from services.alignment.calibration.tactile_tare import TactileCalibration
from tests.integration.tutorial_page import ROOT, TutorialPage

PAGE = TutorialPage.read("add_a_device")
# Reads the flags of the page's stations as they do, and builds the drivers of the devices.
STATIONS = """
import sys
from dextouch.serving.settings import load_settings
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.settings import AcquisitionSettings

for flags in {flags!r}:
    settings = load_settings(AcquisitionSettings, flags)
    drivers = build_drivers(settings.devices, StationClock()) if settings.devices else ()
    print(settings.mock_links.gloves, *(f"{{d.name}} {{d.descriptors[0].shape}}" for d in drivers))
print(*(m for m in sys.modules if m == "t64_glove.mock" or ".mocks" in m))
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with the page's files and its package installed below `installed`."""
    folder = tmp_path_factory.mktemp("lab")
    PAGE.write_files(folder)
    # Without a network: the build backend and what the package needs are here already.
    offline = ("--no-build-isolation", "--no-deps", "--no-index", "--no-compile", "--quiet")
    flags = (*offline, "--disable-pip-version-check", "--target", "installed")
    run(folder, "-m", *PAGE.command("pip install "), *flags)
    return folder


def run(folder, *arguments):
    paths = (folder / "installed", ROOT, ROOT / "shared")
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_page_names_every_file_of_a_package():
    names = [Path(path).name for path, _ in PAGE.files]
    assert names == [
        *("pyproject.toml", "__init__.py", "settings.py", "packets.py", "kind.py", "mock.py"),
        "record_t64.py",
    ]


def test_a_take_is_recorded_and_the_dead_cell_is_found(lab):
    (shown,) = PAGE.outputs
    assert run(lab, *PAGE.command("python ")[1:]) == shown
    (take,) = (path for path in (lab / "takes").iterdir() if path.is_dir())
    spool = SpoolReader(take)
    descriptor = spool.streams["tactile_left"]
    assert (descriptor.shape, descriptor.nominal_rate_hz, descriptor.unit) == ((64,), 100, "counts")
    counts = spool.read("tactile_left").values
    # By the page's own table: about 200 without load, at most 4095; the dead cell shows nothing.
    assert counts.shape == (400, 64)
    assert set(counts[:, 30]) == {0}
    others = counts[:, [cell for cell in range(64) if cell != 30]]
    assert others.min() == 200
    assert 1000 < others.max() <= 4095
    assert "taxels_dead" in {entry.event for entry in spool.attributes.ledger}
    # What the take knows of the glove makes pressures of its counts, in the hand's own order.
    glove = TactileCalibration.from_record(spool.attributes.calibration, "left", num_cells=64)
    (truth,) = (s for s in pattern_streams(4.0) if s.descriptor.name == "tactile_left")
    palm_kpa = truth.values[:, 80:].reshape(-1, 15, 16)[0, ::2, ::2]
    found_kpa = glove.to_kpa(counts)[0, 80:].reshape(15, 16)[::2, ::2]
    alive = np.arange(64).reshape(8, 8) != 30
    np.testing.assert_allclose(found_kpa[alive], palm_kpa[alive], atol=0.5 / 60 + 1e-6)


def test_stations_take_its_settings_and_import_no_mock(lab):
    stations = [
        shlex.split(line)[3:] for line in PAGE.commands if line.startswith("dextouch station serve")
    ]
    assert len(stations) == 2
    output = run(lab, "-c", STATIONS.format(flags=stations)).splitlines()
    assert output == ["t64_glove", "tactile_glove glove_left (64,)", ""]
