"""`dextouch evaluate` with policies of one's own, as an outsider writes and starts them."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dextouch.clients import http_link
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli import main
from services.twin.settings import TwinSettings
from services.twin.world import twin_worlds
from tests.unit.worlds.running import served

ROOT = Path(__file__).parents[2]

# Written without a look into this repository: numpy and what docs/rollout_api.md says.
POLICIES = '''
import numpy as np

class Reach:
    """Moves the right wrist 1 cm down from where it is; as a list of lists."""

    def __init__(self, down_m=0.01):
        self.down_m = down_m

    def reset(self, start):
        self.task = start.task

    def act(self, observation):
        rows = np.tile(observation.action_reached[-1], (8, 1)).astype(np.float32)
        rows[:, 11] -= self.down_m
        return rows.tolist()


class NoReset:
    def act(self, observation):
        return np.tile(observation.action_reached[-1], (16, 1)).astype(np.float32)


def make_tensor():
    import torch

    class Tensor:
        def act(self, observation):
            now = torch.from_numpy(observation.action_reached[-1].copy()).requires_grad_()
            return now.repeat(4, 1)

    return Tensor()


class Crashing(NoReset):
    def act(self, observation):
        if observation.first_step > 0:
            raise RuntimeError("gripper not homed")
        return super().act(observation)


class Gone:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("buffer was donated")


class Returning:
    def __init__(self, what):
        self.what = what

    def act(self, observation):
        rows = np.tile(observation.action_reached[-1], (16, 1))
        rows_nan = rows.copy()
        rows_nan[3, 20] = np.nan
        return {
            "nan": rows_nan,
            "six": rows[:6],
            "none": None,
            "ragged": [[1.0], [1.0, 2.0]],
            "gone": Gone(),
            "long": np.tile(rows, (5, 1)),
            "narrow": rows[:, :7],
        }[self.what]


def broken_factory():
    raise KeyError("weights.pt")


def empty_factory():
    return {}
'''

# Packages by what stands in their __init__.py.
PACKAGES = {
    "needy": "import no_such_dependency\n",
    "unset": "raise ValueError('MODEL_DIR is not set')\n",
    "empty": "",
}


@pytest.fixture(scope="module")
def url():
    app = create_world_app(twin_worlds(TwinSettings()), WorldServiceSettings())
    with served(app) as address:
        yield address


@pytest.fixture
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mypolicy.py").write_text(POLICIES)
    (tmp_path / "half.py").write_text("import numpy\nimport no_such_dependency\n")
    (tmp_path / "asks.py").write_text("raise ModuleNotFoundError('install the simulator first')\n")
    (tmp_path / "folder").mkdir()
    for package, text in PACKAGES.items():
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text(text)
    return tmp_path


def evaluate(folder, url, *flags):
    """The command in a process of its own, in the folder of the policy."""
    command = [
        *(sys.executable, "-m", "services.cli.main", "evaluate"),
        *("--real", json.dumps({"url": url, "world": "twin"})),
        *("--imagined", json.dumps({"copy-first": {"url": url, "world": "copy-first"}})),
        *("--seeds", "90000:90001", "--tasks", "stand_bottle", "--num-steps", "16"),
        *("--builtin", "[]", "--json", "out/report.json", *flags),
    ]
    python_path = os.pathsep.join([str(ROOT), str(ROOT / "shared")])
    return subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": python_path},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def rows(folder):
    lines = (folder / "out/report.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
def test_policies_of_ones_own_are_scored(folder, url):
    done = evaluate(
        *(folder, url),
        *("--policy", "mine=mypolicy:Reach", "--policy", "mypolicy:NoReset"),
        *("--policy", "tensor=mypolicy:make_tensor", "--html", "out/report.html"),
        *("--policy-arguments", '{"mine": {"down_m": 0.02}}'),
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((folder / "out/report.json").read_text())
    assert [row["policy"] for row in report["policies"]] == ["mine", "mypolicy:NoReset", "tensor"]
    assert {row["real_rollouts"] for row in report["policies"]} == {1}
    assert report["failures"] == []
    assert "mypolicy:NoReset" in (folder / "out/report.html").read_text()
    assert "mypolicy:NoReset" in done.stdout
    kept = [(row["policy"], row["world"], row["seed"]) for row in rows(folder)]
    names = ("mine", "mypolicy:NoReset", "tensor")
    assert kept == [(name, world, 90000) for name in names for world in ("real", "copy-first")]


@pytest.mark.slow
def test_what_a_policy_does_wrong_is_named_and_the_others_are_scored(folder, url):
    wrong = ("nan", "six", "none", "ragged", "gone", "long", "narrow")
    policies = [("--policy", f"{what}=mypolicy:Returning") for what in wrong]
    done = evaluate(
        *(folder, url, "--policy", "crash=mypolicy:Crashing", "--policy", "good=mypolicy:NoReset"),
        *(word for pair in policies for word in pair),
        *("--policy-arguments", json.dumps({what: {"what": what} for what in wrong})),
        *("--num-steps", "32"),
    )
    assert done.returncode == 1
    assert "16 of 18 rollouts failed" in done.stderr
    assert 'raise RuntimeError("gripper not homed")' in done.stderr
    assert "asking.py" not in done.stderr
    messages = {row["policy"]: row["message"] for row in rows(folder) if row.get("error")}
    where = "task 'stand_bottle', seed 90000"
    expected = {
        "crash": f"policy 'crash', {where}, chunk 1: act raised RuntimeError: gripper not homed",
        "nan": f"policy 'nan', {where}, chunk 0: act returned: 1 values are NaN or infinite, "
        "first in row 3, column 20",
        "six": f"policy 'six', {where}, chunk 0: act returned 6 rows, expected a multiple of 4",
        "none": "act returned NoneType, expected an array [K, 67]",
        "ragged": "act returned list, which does not convert to an array",
        "gone": "act returned Gone, which does not convert to an array (buffer was donated)",
        "long": "act returned 80 rows, expected a multiple of 4, at least 4 and at most 64",
        "narrow": "act returned ndarray of shape [16, 7] and float64, expected an array [K, 67]",
    }
    assert set(messages) == set(expected)
    for name, text in expected.items():
        assert text in messages[name]
    report = json.loads((folder / "out/report.json").read_text())
    scored = [row["policy"] for row in report["policies"] if row["real_rollouts"]]
    assert scored == ["good"]


@pytest.fixture
def in_process(folder, monkeypatch, capsys, free_port):
    """The command in this process, with nothing at the worlds' address."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(http_link, "RETRY_PAUSES_S", ())
    # As it is in the console script `dextouch`; `python -m` sets it.
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    for name in ("mypolicy", "half", "asks", "folder", *PACKAGES):
        monkeypatch.delitem(sys.modules, name, raising=False)
    world = {"url": f"http://127.0.0.1:{free_port}", "world": "twin"}
    flags = ["--real", json.dumps(world), "--imagined", json.dumps({"model": world})]

    def run(policy):
        status = main.main(["evaluate", *flags, "--seeds", "1:2", "--policy", policy])
        return status, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("mypolcy:Reach", ["no module 'mypolcy'", "run from the folder that holds it"]),
        ("mypolicy:Raech", ["unknown factory", "'Raech'; valid: Crashing, Gone, NoReset, Reach,"]),
        ("mypolicy:np", ["mypolicy:np is module, expected a function or class"]),
        ("mypolicy:empty_factory", ["returned dict without a method act"]),
        ("mypolicy:broken_factory", ["KeyError: 'weights.pt'", 'mypolicy.py", line', "in broken"]),
        ("half:Reach", ["No module named 'no_such_dependency'", 'half.py", line 2']),
        ("needy.mine:P", ["No module named 'no_such_dependency'", '__init__.py", line 1']),
        ("unset.mine:P", ["ValueError: MODEL_DIR is not set", '__init__.py", line 1']),
        ("asks:P", ["install the simulator first", 'asks.py", line 1']),
        ("empty.mine:P", ["no module 'empty.mine'", "run from the folder that holds it"]),
        ("absent.mine:P", ["no module 'absent.mine'", "run from the folder that holds it"]),
        ("mypolicy.mine:P", ["no module 'mypolicy.mine'"]),
        ("folder:P", ["unknown factory of policy 'folder:P' in folder 'P'; valid: none"]),
        ("__main__:NoSuchPolicy", ["unknown factory", "'NoSuchPolicy'"]),
        ("mypolicy.py", ["expected MODULE:FACTORY or NAME=MODULE:FACTORY"]),
        ("hold", ["expected MODULE:FACTORY"]),
    ],
)
def test_policies_that_do_not_load(in_process, policy, expected):
    status, shown = in_process(policy)
    assert status == 3
    for text in expected:
        assert text in shown
    assert "asking.py" not in shown


def test_a_world_that_is_away_is_one_error(in_process, folder):
    status, shown = in_process("mypolicy:NoReset")
    assert status == 3
    assert shown.count("\n") == 1
    assert "no answer" in shown
    assert "is the service running?" in shown
    assert not list(folder.glob("*.jsonl"))
