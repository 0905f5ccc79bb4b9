"""Each import contract is broken once on purpose, in a copy of the tree, and must be caught."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LINT = Path(sys.executable).with_name("lint-imports")

# contract · file that offends · the offending line
OFFENCES = [
    ("Nothing shipped imports the benchmarks", "services/cli/main.py", "import benchmarks.command"),
    ("Nothing shipped imports the benchmarks", "shared/dextouch/errors.py", "import services.twin"),
    ("Services do not import each other", "services/twin/scene.py", "import services.evaluation"),
    ("Layers of dextouch", "shared/dextouch/geometry/transforms.py", "import dextouch.schemas"),
    ("torch only where networks are", "services/twin/scene.py", "import torch"),
    ("zarr only in dextouch.episodes and", "services/cli/import_export.py", "import zarr"),
    (
        "Drivers and packets never import mocks",
        "services/acquisition/drivers/base.py",
        "import services.acquisition.mocks.replay",
    ),
    ("No cycles anywhere", "services/twin/scene.py", "import services.twin.world"),
    (
        "Layers of the world model",
        "services/world_model/network/conditioning.py",
        "import services.world_model.training.joint_trainer",
    ),
    (
        "Layers of alignment",
        "services/alignment/retargeting/hand_retargeter.py",
        "import services.alignment.jobs",
    ),
    ("redis only in dextouch.serving", "services/dashboard/feeds.py", "import redis"),
    ("OpenCV only in calibration", "services/alignment/retargeting/wrist.py", "import cv2"),
    (
        "Commands over pipelines, which join services",
        "services/pipelines/twin_geometry.py",
        "import services.cli.extras",
    ),
    ("mujoco only in the twin", "services/evaluation/closed_loop.py", "import mujoco"),
]


def lint(tree: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(LINT), "--no-cache"],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": f"{tree}:{tree / 'shared'}"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def tree(tmp_path):
    for name in ("benchmarks", "services", "shared"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / ".importlinter", tmp_path)
    return tmp_path


@pytest.mark.parametrize(("contract", "path", "line"), OFFENCES)
@pytest.mark.parametrize("lazy", [False, True], ids=["at the top", "inside a function"])
def test_an_offence_is_caught(tree, contract, path, line, lazy):
    offender = tree / path
    extra = f"\n\ndef _offend():\n    {line}\n" if lazy else f"\n{line}\n"
    offender.write_text(offender.read_text() + extra)
    answer = lint(tree)
    broken = [row for row in answer.stdout.splitlines() if " BROKEN" in row]
    assert answer.returncode != 0, answer.stdout + answer.stderr
    assert any(row.startswith(contract) for row in broken), answer.stdout


def test_the_untouched_tree_keeps_every_contract(tree):
    answer = lint(tree)
    assert answer.returncode == 0, answer.stdout + answer.stderr
