import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError
from services.acquisition.drivers.base import (
    DATA_REPORT,
    PART_BYTES,
    REPORT_BYTES,
    ReportReassembler,
    split_into_reports,
)

MESSAGES = st.lists(st.binary(min_size=1, max_size=400), min_size=1, max_size=12)


def reassemble(reports):
    reassembler = ReportReassembler()
    found = [reassembler.feed(report) for report in reports]
    return [message for message in found if message is not None], reassembler


@given(MESSAGES)
def test_round_trip(messages):
    reports = [r for i, m in enumerate(messages) for r in split_into_reports(DATA_REPORT, i, m)]
    assert all(len(report) == REPORT_BYTES for report in reports)
    found, reassembler = reassemble(reports)
    assert found == [(DATA_REPORT, message) for message in messages]
    assert reassembler.num_incomplete == 0


@given(MESSAGES, st.data())
def test_lost_reports_cost_only_their_messages(messages, data):
    reports = [(i, r) for i, m in enumerate(messages) for r in split_into_reports(1, i, m)]
    lost = data.draw(st.sets(st.integers(0, len(reports) - 1), max_size=4))
    touched = {reports[index][0] for index in lost}
    kept = [report for index, (_, report) in enumerate(reports) if index not in lost]
    found, _ = reassemble(kept)
    assert found == [(1, m) for i, m in enumerate(messages) if i not in touched]


@given(st.lists(st.binary(max_size=70)))
def test_no_reports_break_it(reports):
    _, reassembler = reassemble(reports)
    assert reassembler.num_incomplete <= len(reports)


def test_limits():
    with pytest.raises(InvalidInputError, match="report"):
        split_into_reports(1, 0, b"")
    with pytest.raises(InvalidInputError, match="report"):
        split_into_reports(1, 0, bytes(256 * PART_BYTES))
