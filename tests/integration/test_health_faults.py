"""Every fault of a station, on real drivers in simulated time: found, named, soon."""

import pytest

from services.acquisition.health.codes import CODES
from tests.integration.health_scenarios import HARMLESS, SCENARIOS, observe

# In every run of the tests; all of them are in the matrix.
QUICK = (
    "packets dropped",
    "bytes lost",
    "packets out of order",
    "silence of 0.4 s",
    "85 % of the rate",
    "60 ms of host latency",
    "clock steps backward",
    "other hand",
    "unplugged (serial)",
    "taxels dead",
    "zero drifts",
    "cell becomes NaN (Wuji)",
    "NaN (justfloat)",
    "tracker occluded",
    "pose noise of 3 mm",
    "image blurred",
    "disk full in 20 min",
)
# Told to whoever asks while a sample is overdue; what needs minutes of asking the device; and what
# happens to the computer (test_health_chaos.py). What images show is in test_health_judges.py.
TESTED_ELSEWHERE = {"late", "latency_calibration", "upload_refused", "not_followed"}
TESTED_ELSEWHERE |= {"overload", "host_suspended", "wall_clock_set", "image_content"}


def judged(name, outcome):
    """The matrix row of a fault, and what is wrong with what was found."""
    scenario = SCENARIOS[name]
    found, accused = outcome.found(scenario), outcome.accused(scenario)
    wrong = []
    if found is None:
        wrong.append(f"{name}: found only {outcome.besides(scenario)}")
    elif found[1] > scenario.limit_s + 1e-6:
        wrong.append(f"{name}: found after {found[1]:.2f} s, expected {scenario.limit_s} s")
    if accused:
        wrong.append(f"{name}: accused {sorted(accused)}, expected {scenario.where}")
    code, seconds = found or ("-", float("nan"))
    besides = ", ".join(f"`{other}`" for other in outcome.besides(scenario)) or "-"
    row = f"| {name} | {scenario.device} | `{code}` | {seconds:.2f} | {besides} |"
    return row, wrong


@pytest.mark.parametrize("name", QUICK)
def test_each_fault_is_found_and_named(name, tmp_path):
    _, wrong = judged(name, observe(SCENARIOS[name], tmp_path))
    assert wrong == []


@pytest.mark.slow
def test_the_confusion_matrix(tmp_path):
    rows, wrong = [], []
    for number, (name, scenario) in enumerate(SCENARIOS.items()):
        row, problems = judged(name, observe(scenario, tmp_path / str(number)))
        rows.append(row)
        wrong += problems
    print("\n| fault | device | finding | after (s) | also raised |\n|---|---|---|---|---|")  # noqa: T201 - the matrix
    print("\n".join(rows))  # noqa: T201
    assert wrong == []


def test_every_code_has_a_fault_that_must_raise_it():
    codes = {code for scenario in SCENARIOS.values() for code in scenario.codes.split()}
    assert codes | TESTED_ELSEWHERE == set(CODES)


@pytest.mark.parametrize("name", HARMLESS)
def test_what_is_no_fault_raises_nothing(name, tmp_path):
    assert observe(HARMLESS[name], tmp_path).seconds == {}
