"""The table of planted bugs fits the code, and tests notice nearly all of them."""

import ast
import os

import pytest

from tests.mutants.bugs import ROOT, planted_bugs
from tests.mutants.run import MIN_KILLED, survivors_of

BUGS = planted_bugs()


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: f"{bug.area}: {bug.what}")
def test_a_planted_bug_fits_the_code(bug):
    source = (ROOT / bug.file).read_text(encoding="utf-8")
    changed = bug.planted(source)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source))
    assert bug.tests
    assert all((ROOT / test.partition("::")[0]).is_file() for test in bug.tests)


@pytest.mark.slow
def test_nearly_all_planted_bugs_are_noticed():
    survivors = survivors_of(BUGS, jobs=os.cpu_count() or 1)
    assert 1 - len(survivors) / len(BUGS) >= MIN_KILLED, [bug.what for bug in survivors]
