"""Readers on a starved computer: no packet of a HID device is lost that its process reads.

`python -m benchmarks acquisition` shows what a thread loses there (tens of percent).
"""

import pytest

from benchmarks.acquisition.starved import run_starved

SECONDS = 5.0


@pytest.mark.slow
@pytest.mark.parametrize("load", ["idle", "starved"])
def test_a_reader_process_keeps_up(load):
    found = run_starved(load, "process", SECONDS)
    assert found["sent"] > 0
    assert found["fingers"] <= 0.01
    # 2 % measured; a reader that spins would take a whole core.
    assert found["reader_cpu"] < 0.2
