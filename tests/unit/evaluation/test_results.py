"""The file of results: a line a rollout, earlier studies stay, and a wrong place is named."""

import json

import pytest

from dextouch.errors import StorageError
from services.evaluation.closed_loop import ResultLog
from services.evaluation.scores import RolloutFailure, RolloutScore

SCORE = RolloutScore("real", "mine", "reach", 3, "abc", success=True, probability=0.75)
FAILURE = RolloutFailure("real", "mine", "reach", 4, "InvalidInputError", "act raised …", "trace")


def test_rows_are_there_at_once_and_later_studies_add_to_them(tmp_path):
    path = tmp_path / "new" / "results.jsonl"
    first = ResultLog(path)
    first.keep(SCORE)
    assert len(path.read_text().splitlines()) == 1
    first.keep(FAILURE)
    ResultLog(path).keep(SCORE)
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(row["policy"], row["seed"]) for row in rows] == [("mine", 3), ("mine", 4), ("mine", 3)]
    assert (rows[0]["success"], rows[0]["probability"]) == (True, 0.75)
    assert (rows[1]["error"], rows[1]["traceback"]) == ("InvalidInputError", "trace")
    assert rows[0]["study"] == rows[1]["study"] <= rows[2]["study"]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="choose another --results"):
        ResultLog(tmp_path / "file" / "results.jsonl").keep(SCORE)
