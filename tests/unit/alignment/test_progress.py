"""Progress of an alignment never goes back."""

from itertools import pairwise
from typing import get_args

from services.alignment.synchronization import Stage, progress_within


def test_every_stage_begins_where_the_one_before_ends():
    stages = get_args(Stage)
    assert progress_within(stages[0], 0.0).share == 0.0
    for before, after in pairwise(stages):
        assert progress_within(before, 0.0).share < progress_within(before, 1.0).share
        assert progress_within(before, 1.0).share == progress_within(after, 0.0).share
    assert progress_within(stages[-1], 1.0).share == 1.0
