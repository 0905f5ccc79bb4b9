"""`python -m benchmarks twin`: one short run as users start it, and errors by hand.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from benchmarks.twin import benchmark
from benchmarks.twin.benchmark import (
    AS_SERVED,
    HEAD,
    HEAD_LAST,
    SELECTORS,
    SOLVERS,
    Played,
    contact_error,
)
from dextouch.errors import InvalidInputError


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "twin", "--quick"]
    options = ["--rounds", "1", "--out", str(folder)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder, json.loads((folder / "bench_twin.json").read_text())


@pytest.mark.slow
def test_a_quick_run_measures_everything(run):
    folder, figures = run
    assert list(figures["chunk_ms"]) == list(SELECTORS)
    assert list(figures["solver_ms"]) == list(figures["contact_error"]) == list(SOLVERS)
    assert all(values[0] > 0 for values in figures["chunk_ms"].values())
    assert figures["options"]["chunks_with_contact"] >= 2
    assert "Solvers on" in (folder / "bench_twin.md").read_text()
    assert "Physics of a chunk" in (folder / "bench_twin.svg").read_text()


def test_the_twin_repeats_itself_and_coarser_solvers_do_not(run):
    errors = run[1]["contact_error"]
    assert (errors[AS_SERVED]["force_n"], errors[AS_SERVED]["object_mm"]) == (0.0, 0.0)
    assert errors["1 Newton step"]["force_n"] > errors["3 Newton steps"]["force_n"] > 0


def test_selectors_leave_the_state_as_it_is(run):
    (verdict,) = [r for r in run[1]["requirements"] if "leave the state" in r["what"]]
    assert verdict["verdict"] == "pass"


def played(force_n: float, x_m: float) -> Played:
    forces_n = np.zeros((2, 2, 6))
    forces_n[:, 1, 3] = force_n
    return Played(forces_n, np.array([[x_m, 0.0, 0.0], [0.0, 0.0, 0.0]]), 1.0)


def test_contact_errors_by_hand():
    truth = [played(2.0, 0.0), played(0.0, 0.0)]
    # Of four samples of one pad two are 1 N too much, the others are felt in neither.
    error = contact_error([played(3.0, 0.003), played(0.0, 0.001)], truth)
    assert error.force_n == pytest.approx(1.0)
    assert error.force_rms_n == pytest.approx(2.0)
    # Objects are 3, 0, 1 and 0 mm away.
    assert error.object_mm == pytest.approx(0.5)
    assert contact_error(truth, truth).force_n == 0.0


def test_verdicts_are_of_the_rounds_ratios():
    times_ms = {HEAD: Figure.of([100.0, 200.0]), HEAD_LAST: Figure.of([70.0, 140.0])}
    saved, share, equal = benchmark.requirements(times_ms, states_are_equal=True)
    assert (saved.figure, equal.figure) == (pytest.approx(0.7), 1.0)
    assert share.figure == pytest.approx(150 / 1066.667, rel=1e-4)
    assert benchmark.requirements(times_ms, states_are_equal=False)[2].is_met is False


def test_no_round_is_refused(tmp_path):
    parser = stage_parser("twin")
    benchmark.add_options(parser)
    with pytest.raises(InvalidInputError, match="--rounds"):
        benchmark.measure(parser.parse_args(["--rounds", "0"]), tmp_path, pytest.fail)
