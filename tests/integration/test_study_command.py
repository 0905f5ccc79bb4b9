"""`dextouch study` with the twin and the package's world model, each in a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dextouch.episodes import EpisodeStore
from services.cli import main

ROOT = Path(__file__).parents[2]
STUDY = """
name = "bottle"
tasks = ["stack_bowls"]
first_seed = 31000
num_starts = {starts}
in_flight = 2
[imagined.model]
builtin = "world-model"
[policies.careful]
script = "script 0 mm"
[policies.hold]
builtin = "hold"
"""


@pytest.fixture
def study(tmp_path):
    def write(starts):
        path = tmp_path / "bottle.toml"
        path.write_text(STUDY.format(starts=starts))
        return path

    return write


def test_a_study_from_file_to_tables(study, tmp_path, capsys):
    path = study(1)
    assert main.main(["study", "run", str(path)]) == 0
    assert "0 of 4 rollouts have a result" in capsys.readouterr().out
    folder = tmp_path / "bottle"
    report = json.loads((folder / "report.json").read_text())
    assert {(r["policy"], r["real"], r["imagined"]) for r in report["policies"]} == {
        ("careful", 1.0, 1.0),
        ("hold", 0.0, 0.0),
    }
    assert r"\multirow{2}{*}{careful}" in (folder / "tables.tex").read_text()
    assert "bottle" in (folder / "report model.html").read_text()
    store = EpisodeStore(folder / "rollouts")
    assert sorted(store.open(one).attributes.origin for one in store.list()) == [
        *["imagined"] * 2,
        *["twin"] * 2,
    ]
    for one in store.list():
        store.open(one).verify()
        assert store.open(one).num_steps == 81
    # All results are there: the report alone gives the same page, and nothing is run.
    before = (folder / "report.json").read_bytes()
    assert main.main(["study", "report", str(folder), "--json", str(tmp_path / "again.json")]) == 0
    assert (folder / "report.json").read_bytes() == before == (tmp_path / "again.json").read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("first_seed = 31000", "first_seed = 100", "trained on task 'stack_bowls' with seeds"),
        ('"script 0 mm"', '"script clumsy"', "unknown script 'script clumsy'"),
        ('"stack_bowls"', '"stack_bowl"', "'stack_bowl'"),
        ('builtin = "world-model"', 'checkpoint = "no.safetensors"', "no.safetensors"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_anything_runs(
    study, tmp_path, capsys, old, new, message
):
    path = study(1)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert main.main(["study", "run", str(path)]) == 3
    assert message in capsys.readouterr().err
    assert not (tmp_path / "bottle").exists()


def rows(folder):
    path = folder / "results.jsonl"
    return path.read_text().count("\n") if path.exists() else 0


@pytest.mark.slow
def test_a_study_killed_three_times_writes_the_same_reports(study, tmp_path):
    path, cut = study(3), tmp_path / "cut"
    command = [sys.executable, "-m", "services.cli.main", "study", "run", str(path)]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'shared'}", "OMP_NUM_THREADS": "1"}
    for _ in range(3):
        before = rows(cut)
        child = subprocess.Popen([*command, "--folder", str(cut)], cwd=ROOT, env=environment)
        while rows(cut) < before + 3:
            assert child.poll() is None
            time.sleep(0.05)
        child.send_signal(signal.SIGKILL)
        child.wait()
    for arguments in (["--folder", str(cut)], []):
        subprocess.run([*command, *arguments], cwd=ROOT, env=environment, check=True)
    for name in ("report.json", "report model.html", "tables.tex"):
        assert (cut / name).read_bytes() == (tmp_path / "bottle" / name).read_bytes(), name
    kept = EpisodeStore(cut / "rollouts")
    assert kept.list() == EpisodeStore(tmp_path / "bottle" / "rollouts").list()
    for one in kept.list():
        kept.open(one).verify()
