"""The command `run`: what it writes and prints, also when rollouts fail, and paths it refuses."""

import json
import re
from pathlib import Path

import pytest

from dextouch.episodes import EpisodeStore, split_of_scene
from dextouch.errors import InvalidInputError
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.command_line import run_evaluation, run_train_judge
from services.evaluation.policies.user_policies import load_policies
from services.evaluation.scores import REAL
from services.evaluation.settings import command_line
from services.evaluation.trained_networks import save_checkpoint
from tests.unit.evaluation import toy, toy_store
from tests.unit.worlds.running import served


@pytest.mark.long
def test_a_judge_is_measured_on_any_split_of_a_held_out_store(tmp_path):
    urls = {"A": tmp_path / "learned", "B": tmp_path / "learned", "C": tmp_path / "held"}
    for seed in range(60):
        item = toy.demonstration("reach", seed, noise_m=0.0 if seed % 2 else 0.09)
        toy_store.write(EpisodeStore(urls[split_of_scene("reach", seed)]), item)
    figures = tmp_path / "figures.json"
    run_train_judge([
        "--episodes", str(urls["A"]), "--splits", "A,B", "--held-out", str(urls["C"]),
        "--training.num-training-steps", "1", "--jobs", "1", "--image-px", "32",
        "--output", str(tmp_path / "judge.safetensors"), "--json", str(figures),
    ])  # fmt: skip
    num_held_out = json.loads(figures.read_text())["metrics"]["num_held_out_episodes"]
    assert num_held_out == len(EpisodeStore(urls["C"]).list())


def test_a_recorded_command_names_every_file_by_its_last_part():
    for given, kept in (
        (["--episodes", "runs/true,file:///data/imagined"], "--episodes true,imagined"),
        (["--episodes=../a/b/,c", "--base=package"], "--episodes=b/,c --base=package"),
        (["--held-out", '["runs/a", "runs/b"]'], """--held-out '["a", "b"]'"""),
        (["--training.risk", "0.1", "--output", "/x/y.safetensors"],
         "--training.risk 0.1 --output y.safetensors"),
    ):  # fmt: skip
        assert command_line("judge", given) == f"dextouch train judge {kept}"


def test_factories_may_name_their_arguments_as_they_like(tmp_path, monkeypatch):
    (tmp_path / "named_arguments.py").write_text(
        "class Policy:\n"
        "    def __init__(self, call, where):\n"
        "        self.given = call, where\n"
        "    def act(self, observation):\n"
        "        return None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    given = {"mine": {"call": 1, "where": 2}}
    loaded = load_policies(["mine=named_arguments:Policy"], given, [], other_option="")
    assert loaded["mine"].act.__self__.given == (1, 2)


class Stuck(toy.ToyWorld):
    """An imagined world in which every rollout fails at its first chunk."""

    def step(self, state, actions, *, seed, selector):
        raise InvalidInputError("stuck: this world imagines nothing")


@pytest.fixture(scope="module")
def url():
    worlds = {"judge": toy.ToyWorld("judge", judge=True), "stuck": Stuck("stuck", judge=False)}
    with served(create_world_app(worlds, WorldServiceSettings())) as address:
        yield address


def test_a_study_without_a_single_imagined_ending_is_reported(
    tmp_path, capsys, url, probe_checkpoint
):
    save_checkpoint(tmp_path / "probe.safetensors", probe_checkpoint)
    status = run_evaluation(
        [
            *("--real", json.dumps({"url": url, "world": "judge"})),
            *("--imagined", json.dumps({"dream": {"url": url, "world": "stuck"}})),
            *("--probe", str(tmp_path / "probe.safetensors"), "--builtin", '["hold"]'),
            *("--tasks", "reach", "--seeds", "2000:2002", "--num-steps", "16"),
            *("--json", str(tmp_path / "report.json"), "--html", str(tmp_path / "report.html")),
        ]
    )
    shown = capsys.readouterr()
    assert status == 1
    assert "2 of 4 rollouts failed" in shown.err
    (row,) = (line for line in shown.out.splitlines() if line.startswith("reach  "))
    assert re.fullmatch(r"reach +hold +[01]\.[05]+ of 2 +undefined of 0", row)
    assert "hold in dream, 2 x: stuck: this world imagines nothing" in shown.err
    comment = "No start was completed in both worlds (real and dream) by every policy"
    assert "Pearson undefined, Kendall undefined, MMRV undefined" in shown.out
    assert comment in shown.out
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["agreement"]["reach"]["mmrv_paper"] == "undefined"
    assert len(report["failures"]) == 2
    assert comment in (tmp_path / "report.html").read_text()
    kept = [json.loads(line) for line in (tmp_path / "report.jsonl").read_text().splitlines()]
    assert [row["world"] for row in kept] == [REAL, "dream"] * 2


def test_a_report_is_written_before_anything_is_printed(
    tmp_path, monkeypatch, url, probe_checkpoint
):
    save_checkpoint(tmp_path / "probe.safetensors", probe_checkpoint)

    def gone(*_words, **_how):
        raise BrokenPipeError

    monkeypatch.setattr("services.evaluation.command_line.print", gone, raising=False)
    with pytest.raises(BrokenPipeError):
        run_evaluation(
            [
                *("--real", json.dumps({"url": url, "world": "judge"})),
                *("--probe", str(tmp_path / "probe.safetensors"), "--builtin", '["hold"]'),
                *("--tasks", "reach", "--seeds", "2000:2001", "--num-steps", "16"),
                *("--json", str(tmp_path / "report.json")),
                *("--html", str(tmp_path / "report.html")),
            ]
        )
    assert len(json.loads((tmp_path / "report.json").read_text())["rollouts"]) == 1
    assert "hold" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--json", "out.jsonl"], ["--results (by default next to the report)", "--json"]),
        (["--html", "out.jsonl"], ["--results (by default next to the report)", "--html"]),
        (["--results", "out.json", "--json", "out.json"], ["--results", "--json"]),
        (["--results", "page", "--html", "./page"], ["--results", "--html"]),
        (["--json", "page", "--html", "elsewhere/../page"], ["--json", "--html"]),
        (["--results", "link", "--json", "target"], ["--results", "--json"]),
    ],
)
def test_one_file_for_two_things_is_refused(tmp_path, monkeypatch, flags, named):
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to("target")
    real = json.dumps({"url": "http://127.0.0.1:1", "world": "twin"})
    with pytest.raises(InvalidInputError, match="the same file") as caught:
        run_evaluation(["--real", real, "--seeds", "1:2", *flags])
    for flag in named:
        assert flag in str(caught.value)
