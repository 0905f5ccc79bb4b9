"""Rows of a stream's history from stamps that are written down, and the ring that keeps them."""

import tracemalloc

import numpy as np
import pytest

from dextouch.errors import UnknownNameError
from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.health.evaluation import Block
from services.acquisition.health.history import (
    NUM_ROWS,
    STATION_SERIES,
    STREAM_SERIES,
    HealthHistory,
    StreamMeter,
)

SECOND_NS = 1_000_000_000
DAY_S = 86_400
POSE = StreamDescriptor(
    name="head", kind="pose", shape=(7,), dtype="float64", unit="pose_m_wxyz", nominal_rate_hz=50.0
)


def block(t_s):
    t_ns = np.rint(np.asarray(t_s, dtype=np.float64) * 1e9).astype(np.int64)
    nothing = np.zeros_like(t_ns)
    return Block(t_ns, nothing, nothing, nothing)


@pytest.fixture
def statistics():
    return DecoderStatistics()


@pytest.fixture
def meter(statistics):
    meter = StreamMeter(lambda: statistics, POSE, capacity=200)
    meter.row(0, 0, {})
    return meter


def test_a_steady_second(meter):
    # 50 samples, the first at 0.01 s; 20 ms apart.
    meter.add(block(0.01 + 0.02 * np.arange(50)))
    row = meter.row(SECOND_NS, 2, {"clock_skew_ratio": 4e-5, "clock_offset_seconds": -0.2})
    assert row["rate_hz"] == pytest.approx(50.5)
    assert (row["gap_ratio"], row["buffer_ratio"], row["level"]) == (0.0, 0.25, 2.0)
    assert row["interval_max_s"] == pytest.approx(0.02)
    assert row["age_s"] == pytest.approx(0.01)
    assert (row["clock_skew_ppm"], row["clock_offset_s"]) == (pytest.approx(40.0), -0.2)
    assert "clock_residual_s" not in row
    # From now on a second that begins and ends between samples is no different.
    meter.add(block(1.01 + 0.02 * np.arange(50)))
    assert meter.row(2 * SECOND_NS, 0, {})["rate_hz"] == pytest.approx(50.0)


def test_a_silence_is_where_it_was(meter):
    meter.add(block(0.02 * np.arange(1, 41)))  # until 0.8 s
    first = meter.row(SECOND_NS, 0, {})
    second = meter.row(2 * SECOND_NS, 3, {"clock_skew_ratio": 4e-5})
    meter.add(block([2.5, *2.52 + 0.02 * np.arange(24)]))  # until 2.98 s
    third = meter.row(3 * SECOND_NS, 0, {})
    assert [row["gap_ratio"] for row in (first, second, third)] == pytest.approx([0.2, 1.0, 0.5])
    assert [row["rate_hz"] for row in (first, second, third)] == pytest.approx([41.0, 0.0, 25.0])
    assert [row["age_s"] for row in (first, second, third)] == pytest.approx([0.2, 1.2, 0.02])
    assert "interval_max_s" not in second
    assert "clock_skew_ppm" not in second
    assert third["interval_max_s"] == pytest.approx(1.7)


def test_a_pause_of_three_periods_is_no_gap(meter):
    # `gap` begins at 0.1 s, and at three periods.
    meter.add(block([0.1, 0.2, 0.3]))
    assert meter.row(round(0.35e9), 0, {})["gap_ratio"] == 0.0


def test_loss_of_each_second(meter, statistics):
    statistics.packets, statistics.lost = 90, 10
    assert meter.row(SECOND_NS, 0, {})["loss_ratio"] == pytest.approx(0.1)
    # A packet that came late is no longer lost.
    statistics.packets, statistics.lost = 191, 9
    assert meter.row(2 * SECOND_NS, 0, {})["loss_ratio"] == 0.0
    assert "loss_ratio" not in meter.row(3 * SECOND_NS, 0, {})


def test_only_the_newest_rows_are_kept_in_order():
    history = HealthHistory(["a", "b"], num_rows=4)
    for second in range(7):
        streams = {"a": {"rate_hz": float(second)}, "b": {"level": 1.0}}
        history.add(second * SECOND_NS, {"cpu_ratio": 0.1 * second}, streams)
    rows = history.rows()
    assert rows.t_ns.tolist() == [second * SECOND_NS for second in (3, 4, 5, 6)]
    rate = list(STREAM_SERIES).index("rate_hz")
    assert rows.values[0, rate].tolist() == [3.0, 4.0, 5.0, 6.0]
    assert np.isnan(rows.values[1, rate]).all()
    cpu = list(STATION_SERIES).index("cpu_ratio")
    assert rows.station[cpu].tolist() == pytest.approx([0.3, 0.4, 0.5, 0.6])
    newest = history.rows(["b"], since_ns=4 * SECOND_NS, limit=2)
    assert (newest.streams, newest.t_ns.tolist()) == (("b",), [5 * SECOND_NS, 6 * SECOND_NS])
    assert history.rows(since_ns=7 * SECOND_NS).values.shape == (2, len(STREAM_SERIES), 0)
    with pytest.raises(UnknownNameError, match="valid: a, b"):
        history.rows(["c"])


def test_takes_of_a_span():
    history = HealthHistory(["a"])
    history.begin_take("one", 10)
    history.end_take("one", 20)
    history.end_take("one", 99)
    history.begin_take("two", 30)
    assert [(t.recording_id, t.stop_ns) for t in history.takes()] == [("one", 20), ("two", None)]
    assert [take.recording_id for take in history.takes(21)] == ["two"]


@pytest.mark.long
def test_a_day_takes_no_more_memory_than_an_hour():
    names = [f"stream_{index}" for index in range(3)]
    history = HealthHistory(names)
    # 44 bytes a stream and row, 20 of the station and 8 of the time.
    assert history.num_bytes == 3600 * (3 * 44 + 20 + 8)
    row = dict.fromkeys(STREAM_SERIES, 1.0)
    streams, station = dict.fromkeys(names, row), dict.fromkeys(STATION_SERIES, 1.0)

    def run(start_s, stop_s):
        for second in range(start_s, stop_s):
            history.add(second * SECOND_NS, station, streams)
            if second % 60 == 0:
                history.begin_take(f"take-{second}", second * SECOND_NS)

    run(0, 3600)
    tracemalloc.start()
    try:
        run(3600, DAY_S)
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    # The takes' names and times alone: 500 of them are kept.
    assert grown < 500_000
    assert history.num_bytes == 3600 * (3 * 44 + 20 + 8)
    assert history.rows().t_ns[[0, -1]].tolist() == [
        (DAY_S - NUM_ROWS) * SECOND_NS,
        (DAY_S - 1) * SECOND_NS,
    ]
    assert len(history.takes()) == 500
