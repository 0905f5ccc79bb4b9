"""The benchmark of agreement intervals, in its shortest form."""

import json

from benchmarks.__main__ import main
from benchmarks.agreement import MEASURED, METHODS


def test_stage_reports_coverage_of_both_methods(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.command.refuse_shape_checks", lambda: None)
    path = tmp_path / "figures.json"
    assert main(["agreement", "--quick", "--studies", "2", "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    keys = {(row["method"], row["figure"]) for row in found["coverage"]}
    assert keys == {(method, name) for method in METHODS for name in MEASURED}
    assert {row["what"] for row in found["requirements"]} >= {
        "pearson: studies whose 95 % interval holds the truth"
    }
