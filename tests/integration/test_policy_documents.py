"""The pages about policies and rollouts: their tables hold and their code runs."""

import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.hands import actions
from dextouch.hands.robot_hand import RobotHand
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli import main
from services.twin.settings import TwinSettings
from services.twin.world import twin_worlds
from services.world_model.shipped_checkpoints import paper_form_checkpoint
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.worlds.running import served

DOCS = Path(__file__).parents[2] / "docs"
POLICIES = (DOCS / "policies.md").read_text(encoding="utf-8")
ROLLOUT_API = (DOCS / "rollout_api.md").read_text(encoding="utf-8")
TWIN, MODEL = "http://127.0.0.1:8101", "http://127.0.0.1:8102"


def block(text, part):
    """The fenced block that holds some text."""
    return next(b for b in re.findall(r"```\w*\n(.*?)```", text, re.DOTALL) if part in b)


def table(text, first_header):
    """Rows of the table whose first column has this header, without their back-ticks."""
    lines = text[text.index(f"| {first_header} |") :].split("\n\n")[0].splitlines()[2:]
    return [
        [cell.strip().replace("`", "") for cell in line.strip("|").split("|")] for line in lines
    ]


@pytest.fixture(scope="module")
def worlds():
    model = open_world()
    return twin_worlds(TwinSettings()) | {"world_model": model}


@pytest.fixture(scope="module")
def services(worlds):
    """The addresses of the page, and where its two services are here."""
    twin = {name: worlds[name] for name in ("twin", "copy-first")}
    settings = WorldServiceSettings()
    with (
        served(create_world_app(twin, settings)) as twin_url,
        served(create_world_app({"world_model": worlds["world_model"]}, settings)) as model_url,
    ):
        yield {TWIN: twin_url, MODEL: model_url}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with the page's policy in it."""
    (tmp_path / "my_policy.py").write_text(block(POLICIES, "class ReachForward"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    sys.modules.pop("my_policy", None)
    yield tmp_path
    sys.modules.pop("my_policy", None)


def here(text, services):
    """The text with the addresses of the services here."""
    for written, url in services.items():
        assert text.count(written) <= 1
        text = text.replace(written, url)
    return text


def test_layout_of_an_action():
    rows = table(ROLLOUT_API, "columns")
    assert len(rows) == 5
    for columns, _, unit, constant in rows:
        first, stop = map(int, columns.split(":"))
        assert getattr(actions, constant) == slice(first, stop)
        assert unit == ("rad" if "JOINTS" in constant else "m, none")
    covered = [range(*map(int, row[0].split(":"))) for row in rows]
    assert [column for part in covered for column in part] == list(range(actions.ACTION_DIM))


def test_order_of_the_joints():
    rows = table(ROLLOUT_API, "joint")
    assert [int(index) for index, _ in rows] == list(range(20))
    for side in ("left", "right"):
        assert tuple(f"{side[0]}_{name}" for _, name in rows) == RobotHand(side).joint_names


def test_six_numbers_of_a_rotation_are_the_first_two_columns():
    R = Rotation.from_euler("xyz", [0.3, -0.5, 0.9]).as_matrix()
    T = np.eye(4)
    T[:3, :3] = R
    written = re.search(r"then the second: ((?:r\d\d(?:, )?)+)", ROLLOUT_API)[1].split(", ")
    np.testing.assert_allclose(
        actions.pose_to_9d(T)[3:], [R[int(name[1]), int(name[2])] for name in written]
    )


def test_worlds_say_what_the_table_says(worlds):
    forms = {
        "world_model, with a state model": StateWorld(untrained_state_checkpoint()),
        "world_model, in the paper's form": open_world(paper_form_checkpoint()),
    }
    for name, starts, cameras, longest, success, _ in table(ROLLOUT_API, "world"):
        described = (forms.get(name) or worlds[name.split(",")[0]]).description
        assert described.starts_from == (starts,)
        if cameras.startswith("camera"):
            assert described.cameras == tuple(cameras.removesuffix(" (a setting)").split(", "))
        assert described.max_chunk_steps == int(longest)
        assert described.knows_success == (success == "known")
        assert (described.chunk_multiple, described.model_rate_hz) == (4, 15.0)


def test_the_action_of_the_page():
    exec(block(ROLLOUT_API, "pack_action("), {})  # noqa: S102 - our own page


def test_the_policy_runs_in_the_twin_and_in_the_world_model(folder, services, capsys):
    script = folder / "try_policy.py"
    script.write_text(here(block(POLICIES, "def roll_out"), services))
    left = runpy.run_path(str(script))
    shown = capsys.readouterr().out
    assert re.search(r"success in the twin: (True|False)", shown)
    assert left["real"].first_step == left["imagined"].first_step == 65
    # The right wrist went where it was sent: five times 2 cm, less what the controller lags.
    assert left["imagined"].action_reached[-1, 11] == pytest.approx(-0.1)
    assert -0.11 < left["real"].action_reached[-1, 11] < -0.05
    assert left["real"].reached_is_measured
    assert not left["imagined"].reached_is_measured


def test_the_environment_of_the_page_runs(folder, services, capsys):
    script = folder / "try_env.py"
    script.write_text(here(block(POLICIES, "gymnasium.make("), services))
    runpy.run_path(str(script))
    assert "chunks ended at step 80 success: False" in capsys.readouterr().out


def test_the_vector_environment_of_the_page_runs(folder, services):
    script = folder / "try_vector.py"
    script.write_text(here(block(POLICIES, "WorldVectorEnv("), services))
    left = runpy.run_path(str(script))
    assert left["info"]["last_step"].tolist() == [32, 32]


def test_the_command_of_the_page_scores_the_policy(folder, services, capsys):
    command = here(block(POLICIES, "dextouch evaluate --policy"), services)
    _, *words = shlex.split(command.replace("\\\n", " "))
    words[words.index("90000:90010")] = "90000:90001"
    assert main.main([*words, "--num-steps", "16", "--builtin", "[]"]) == 0
    report = json.loads((folder / "report.json").read_text())
    assert [row["policy"] for row in report["policies"]] == ["mine"]
    assert report["imagined_world"] == "world_model"
    assert {"report.json", "report.jsonl", "report.html"} <= {p.name for p in folder.iterdir()}
    assert "mine" in capsys.readouterr().out
