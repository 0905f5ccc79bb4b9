"""`python -m benchmarks loader`: one short run as users start it, and its table and verdict.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys

import pytest

from benchmarks import loader
from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from dextouch.errors import InvalidInputError


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "loader", "--quick"]
    options = ["--episodes", "2", "--workers", "0,1", "--json", str(folder / "figures.json")]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads((folder / "figures.json").read_text())


@pytest.mark.slow
def test_a_quick_run_measures_everything(run):
    text, figures = run
    rates = figures["windows_per_s"]
    assert list(rates) == [
        loader.LEARNING,
        loader.loading(0),
        loader.loading(1),
        "training from the disk, 0 worker processes",
        "training from the disk, 1 worker processes",
    ]
    assert all(len(values) == 1 and values[0] > 0 for values in rates.values())
    assert figures["options"]["episodes"] == 2
    assert figures["options"]["batch"] == 8
    assert figures["requirements"][0]["verdict"] in text
    ratio = rates[loader.loading(loader.USUAL_WORKERS)][0] / rates[loader.LEARNING][0]
    assert figures["requirements"][0]["figure"] == pytest.approx(ratio)


def rates(*, loading, learning):
    usual = loader.loading(loader.USUAL_WORKERS)
    return {loader.LEARNING: Figure.of(learning), usual: Figure.of(loading)}


def test_the_verdict_is_of_the_rounds_ratios():
    # The second round was slower for both; the third only for the loader.
    found = loader.requirement(rates(loading=[40.0, 20.0, 20.0], learning=[10.0, 5.0, 10.0]))
    assert found.figure == pytest.approx(4.0)
    assert found.is_met
    slow = loader.requirement(rates(loading=[29.0], learning=[10.0]))
    assert slow.is_met is False
    alone = loader.requirement({loader.LEARNING: Figure.of([10.0])})
    assert alone.verdict() == "not measured"


def test_the_table_says_how_often_training_fits():
    table = loader.rate_table(rates(loading=[40.0], learning=[10.0]), 200)
    assert "200 episodes" in table.title
    assert table.rows == [(loader.LEARNING, "10", "1"), (loader.loading(0), "40", "4")]


@pytest.mark.parametrize("words", [["--workers", "many"], ["--rounds", "0"], ["--batches", "0"]])
def test_options_that_mean_nothing_are_refused(words, tmp_path):
    parser = stage_parser("loader")
    loader.add_options(parser)
    options = parser.parse_args(["--store", str(tmp_path), *words])
    with pytest.raises(InvalidInputError, match=words[0]):
        loader.measure(options, tmp_path, pytest.fail)
