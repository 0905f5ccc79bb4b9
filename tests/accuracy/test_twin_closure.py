"""Human takes of the twin, retargeted, succeed on its robot hand and touch at the same times."""

import sys
from statistics import mean

import pytest

from benchmarks.closure.benchmark import (
    METHODS,
    OURS,
    TASKS,
    close_take,
    contact_times,
    retarget_take,
    timing_errors,
)
from dextouch.errors import InvalidInputError
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage

SEEDS = range(100, 120)
COPIED = METHODS[0]
# Two periods of the commands' grid of 15 Hz, and the lag of the twin's wrist.
QUICK_BOUND_MS = 200


def absolute(values):
    return mean(abs(value) for value in values) if values else float("nan")


def rate(takes):
    return sum(take.succeeded for take in takes) / len(takes)


def say(takes):
    errors = timing_errors([(take.human_contact, take.contact) for take in takes])
    human = sum(take.human_succeeded for take in takes) / len(takes)
    sys.stdout.write(
        f"\n{takes[0].task:12s} {takes[0].method.name:45s} success {rate(takes):4.2f} (human "
        f"{human:4.2f}) | first, last contact: hand {absolute(errors.hand_first_ms):4.0f}, "
        f"{absolute(errors.hand_last_ms):4.0f} ms, pad {absolute(errors.pad_first_ms):4.0f}, "
        f"{absolute(errors.pad_last_ms):4.0f} ms | pads missing {errors.num_missing}, extra "
        f"{errors.num_extra}"
    )
    return errors


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
def test_a_retargeted_take_succeeds(task, capsys):
    (take,) = close_take(task, SEEDS[0], [OURS])
    with capsys.disabled():
        errors = say([take])
    assert take.human_succeeded
    assert take.succeeded
    assert errors.hand_first_ms
    assert max(abs(late) for late in errors.hand_first_ms) <= QUICK_BOUND_MS
    assert max(abs(late) for late in errors.hand_last_ms) <= QUICK_BOUND_MS


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_twenty_retargeted_takes(task, capsys):
    takes = [take for seed in SEEDS for take in close_take(task, seed, METHODS)]
    by_method = {method: [t for t in takes if t.method == method] for method in METHODS}
    with capsys.disabled():
        for some in by_method.values():
            say(some)
    assert rate(by_method[OURS]) >= 0.8
    # Nothing is held by a hand that only goes where the human's was.
    assert rate(by_method[COPIED]) <= 0.2


@pytest.mark.long
def test_a_robot_take_is_refused():
    stage = Stage("stack_bowls", "robot", TwinSettings())
    episode = record(stage, 0, TakeOptions(images=()))
    with pytest.raises(InvalidInputError, match="expected human"):
        retarget_take(episode)
    # Compared with itself nothing is early, late or missing.
    times = contact_times(episode.streams)
    errors = timing_errors([(times, times)])
    assert set(errors.hand_first_ms + errors.pad_last_ms) == {0.0}
    assert (errors.num_missing, errors.num_extra) == (0, 0)
