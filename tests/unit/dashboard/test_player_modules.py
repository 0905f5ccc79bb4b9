"""Pure modules of the player in Node, among them its decoder on bodies that Python packed."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dextouch.streams import pack
from services.dashboard.app import STATIC

FIELDS = {
    "text": "Zürich " + "x" * 300,
    "short": "a",
    "none": None,
    "flags": [True, False],
    "small": [0, 127, 128, 65_535, 65_536, 2**32, 2**53 - 1],
    "negative": [-1, -32, -33, -128, -129, -32_769, -(2**31) - 1],
    "half": 0.5,
    "nested": {"list": list(range(20)), "map": {str(k): k for k in range(20)}},
}
ARRAYS = {
    "bytes": np.arange(7, dtype=np.uint8),
    "flags": np.array([[True, False, True]]),
    "counts": np.arange(360, dtype=np.uint16).reshape(2, 180),
    "int32": np.array([-5, 2**31 - 1], dtype=np.int32),
    "stamps": np.array([0, -1, 2**53 + 1, 2**63 - 1, -(2**63)], dtype=np.int64),
    "float32": np.array([1.5, np.nan, np.inf], dtype=np.float32),
    "float64": np.array([[0.1], [-2.5e300]]),
    "none": np.empty((0, 25, 3)),
    "many": np.zeros(70_000, dtype=np.uint8),
}


def plain(array):
    """Values as the Node test writes them: 64-bit integers, NaN and infinity as text."""
    if array.dtype == np.int64:
        return [str(value) for value in array.ravel().tolist()]
    values = array.astype(int).ravel().tolist() if array.dtype == bool else array.ravel().tolist()
    names = {"nan": "NaN", "inf": "Infinity"}
    return [names.get(str(value), value) for value in values]


def test_player_modules(tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node on the PATH; apt-get install nodejs")
    shutil.copytree(STATIC, tmp_path / "static")
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copy(Path(__file__).with_name("player_modules.test.js"), tmp_path)
    packed = tmp_path / "packed"
    packed.mkdir()
    for name, fields, arrays in (
        ("all", FIELDS, ARRAYS),
        ("empty", {}, {}),
        # Whatever the length of the name, the numbers behind it are read at their place.
        *((f"place_{k}", {}, {"x" * k: np.array([1.25, -3.0])}) for k in range(1, 9)),
    ):
        (packed / f"{name}.bin").write_bytes(pack(fields, arrays))
        expected = {
            "fields": fields,
            "arrays": {
                key: {
                    "dtype": array.dtype.name,
                    "shape": list(array.shape),
                    "values": plain(array),
                }
                for key, array in arrays.items()
            },
        }
        (packed / f"{name}.json").write_text(json.dumps(expected))
    run = subprocess.run(
        [node, "--test", "player_modules.test.js"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-6000:] + run.stderr[-2000:]
    assert run.stdout.count("that Python packed") >= 10


def exports(module, name):
    return re.search(rf"export [\w* ]*\b{name}\b|export \{{[^}}]*\b{name}\b", module.read_text())


def test_what_a_module_imports_another_one_exports():
    missing = [
        f"{path.name}: {name} of {source}"
        for path in STATIC.rglob("*.js")
        for names, source in re.findall(r'import \{([^}]*)\} from "(\.[^"]*)"', path.read_text())
        for name in re.findall(r"(\w+)(?: as \w+)?\s*(?:,|$)", names.strip())
        if not exports(path.parent / source, name)
    ]
    assert missing == []
