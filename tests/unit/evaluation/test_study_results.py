"""The file of a study's results: it survives kills, and holds one study alone."""

from dataclasses import replace

import pytest

from dextouch.errors import ConflictError, CorruptDataError
from services.evaluation.scores import RolloutFailure, RolloutScore
from services.evaluation.studies.results import StudyHeader, StudyResults

HEADER = StudyHeader("toy", {"name": "toy"}, {"definition": "a", "world real": "b"})
SCORE = RolloutScore("real", "hold", "reach", 2000, "abc", success=True, probability=0.75)
FAILURE = RolloutFailure("dream", "hold", "reach", 2000, "InvalidInputError", "raised", repeat=1)


def test_results_are_resumed_and_a_torn_line_is_dropped(tmp_path):
    first = StudyResults.create_or_resume(tmp_path, HEADER)
    first.keep(SCORE)
    first.keep(FAILURE)
    whole = first.path.read_bytes()
    for cut in (1, 20, len(whole.splitlines()[-1])):
        first.path.write_bytes(whole[:-cut])
        assert list(StudyResults.read(tmp_path).outcomes.values()) == [SCORE]
        again = StudyResults.create_or_resume(tmp_path, HEADER)
        assert list(again.outcomes.values()) == [SCORE]
        again.keep(FAILURE)
        assert again.path.read_bytes() == whole
    assert StudyResults.read(tmp_path).outcomes == first.outcomes
    # A study killed before its first line was whole begins anew.
    first.path.write_bytes(whole[:10])
    assert StudyResults.create_or_resume(tmp_path, HEADER).outcomes == {}
    assert StudyResults.read(tmp_path).header == HEADER


def test_the_last_outcome_of_a_rollout_counts(tmp_path):
    results = StudyResults.create_or_resume(tmp_path, HEADER)
    results.keep(FAILURE)
    better = replace(SCORE, world="dream", repeat=1)
    results.keep(better)
    assert list(StudyResults.read(tmp_path).outcomes.values()) == [better]


def test_results_of_another_study_are_refused(tmp_path):
    StudyResults.create_or_resume(tmp_path, HEADER).keep(SCORE)
    other = replace(HEADER, digests={"definition": "a", "world real": "c", "probe": "d"})
    with pytest.raises(ConflictError, match="world real, probe changed") as caught:
        StudyResults.create_or_resume(tmp_path, other)
    assert "--folder" in caught.value.message


@pytest.mark.parametrize("damage", [b'{"world": "real"}', b"\x00\xff", b"[]"])
def test_a_damaged_line_is_named(tmp_path, damage):
    results = StudyResults.create_or_resume(tmp_path, HEADER)
    results.keep(SCORE)
    with results.path.open("ab") as file:
        file.write(damage + b"\n")
    with pytest.raises(CorruptDataError, match="line 3"):
        StudyResults.create_or_resume(tmp_path, HEADER)
