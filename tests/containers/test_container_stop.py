"""Every service ends by its stop signal, also while it exports spans to nobody."""

import pytest

pytestmark = pytest.mark.containers
STOP_LIMIT_S = 10.0


def test_all_end_in_time_and_without_error(composed, note):
    ended = {name: composed.stop(name) for name in reversed(list(composed.started_s))}
    for name, (time_s, status) in ended.items():
        note(f"{name}: ended {time_s:.1f} s after SIGTERM with status {status}")
    assert {name: status for name, (_, status) in ended.items() if status != 0} == {}
    assert {name: time_s for name, (time_s, _) in ended.items() if time_s > STOP_LIMIT_S} == {}
