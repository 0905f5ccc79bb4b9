"""Batches of one size, whatever is asked."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.schemas import ReturnSelector
from dextouch.worlds import BatchWorld, FixedBatchWorld, SteppedRollout
from tests.unit.worlds import fakes


class Rounding:
    """A world whose answer depends on the size of the batch, as matrix products do."""

    description = fakes.SumWorld().description
    sizes: list[int]

    def __init__(self):
        self.sizes = []

    def reset(self, start):
        return ("started", start)

    def step(self, state, actions, *, seed, selector=None):
        raise AssertionError

    def step_batch(self, states, actions, *, seeds, selectors=None):
        assert len(states) == len(actions) == len(seeds) == len(selectors)
        self.sizes.append(len(states))
        rows = zip(states, actions, seeds, selectors, strict=True)
        size = {"rounding": 1e-7 * len(states)}
        return [
            SteppedRollout((s, float(a.sum()), n, one), fakes.observation(), size)
            for s, a, n, one in rows
        ]

    def snapshot(self, state):
        return b"state"

    def restore(self, data):
        return data.decode()


def test_every_batch_has_the_fixed_size_and_asks_for_nothing_more():
    world = Rounding()
    fixed = FixedBatchWorld(world, 4)
    assert isinstance(fixed, BatchWorld)
    chunks, last = np.ones((3, 4, 67)), ReturnSelector(steps="last")
    alone = fixed.step("a", chunks[0], seed=7, selector=last)
    both = fixed.step_batch(["b", "a"], chunks[:2], seeds=[3, 7], selectors=[last, last])
    assert alone.state == both[1].state == ("a", 4 * 67, 7, last)
    assert alone.info == both[1].info == {"rounding": 4e-7}
    assert len(both) == 2
    assert world.sizes == [4, 4]
    assert fixed.description == world.description
    assert (fixed.snapshot("a"), fixed.restore(b"b")) == (b"state", "b")


def test_more_than_fits_is_refused():
    with pytest.raises(InvalidInputError, match="got 3 entries, expected at most 2"):
        FixedBatchWorld(Rounding(), 2).step_batch("abc", np.ones((3, 4, 67)), seeds=[1, 2, 3])
    with pytest.raises(InvalidInputError, match="size of 0"):
        FixedBatchWorld(Rounding(), 0)
