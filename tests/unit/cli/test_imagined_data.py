"""Which episodes `dextouch train imagined` takes, and how their seeds are written."""

import argparse

import pytest

from services.cli.imagined_data import Choice, seed_range


def test_seeds_are_written_as_a_range():
    assert seed_range("3:7") == range(3, 7)
    for wrong in ("7:3", "3", "a:b", "-1:4", "3:3", ""):
        with pytest.raises(argparse.ArgumentTypeError, match="FIRST:LAST"):
            seed_range(wrong)


def test_a_choice_takes_its_tasks_and_seeds():
    assert Choice().takes("stack_bowls", 5)
    assert Choice(("stack_bowls",), range(5, 6)).takes("stack_bowls", 5)
    assert not Choice(("stand_bottle",)).takes("stack_bowls", 5)
    assert not Choice(seeds=range(6, 9)).takes("stack_bowls", 5)
