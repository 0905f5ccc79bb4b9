"""The log of changes of levels."""

import tracemalloc

from services.acquisition.health.evaluation import MAX_EVENTS, EventLog


def test_events_come_out_as_they_went_in():
    log = EventLog()
    assert log.events() == ()
    log.add(5, "head", "gap", "WARN")
    log.add(7, "tactile_left", "disk", "ERROR")
    log.add(9, "head", "gap", "OK")
    told = [(e.t_host_ns, e.stream, e.code, e.level) for e in log.events()]
    assert told == [
        (5, "head", "gap", "WARN"),
        (7, "tactile_left", "disk", "ERROR"),
        (9, "head", "gap", "OK"),
    ]
    assert [e.t_host_ns for e in log.events(7)] == [7, 9]
    assert log.raised() == {("head", "gap"): 1, ("tactile_left", "disk"): 1}


def test_only_the_newest_are_kept_and_all_are_counted():
    log = EventLog()
    for t_ns in range(MAX_EVENTS):
        log.add(t_ns, "head", "gap", "WARN")
    assert [e.t_host_ns for e in log.events()] == list(range(MAX_EVENTS))
    for t_ns in range(MAX_EVENTS, 2 * MAX_EVENTS + 5):
        log.add(t_ns, "head", "gap", "WARN")
    newest = list(range(MAX_EVENTS + 5, 2 * MAX_EVENTS + 5))
    assert [e.t_host_ns for e in log.events()] == newest
    assert log.raised() == {("head", "gap"): 2 * MAX_EVENTS + 5}


def test_its_memory_is_bounded():
    log = EventLog()
    tracemalloc.start()
    try:
        for t_ns in range(3 * MAX_EVENTS):
            log.add(t_ns, f"stream_{t_ns % 20}", "gap", "WARN")
        assert tracemalloc.get_traced_memory()[0] < 1_000_000
    finally:
        tracemalloc.stop()
    assert (len(log.events()), len(log.raised())) == (MAX_EVENTS, 20)
