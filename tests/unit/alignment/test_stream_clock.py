"""What dates a stream, and what its clock report says of it."""

import numpy as np
import pytest

from dextouch.schemas.episodes import ClockReport
from dextouch.streams.descriptors import ClockCapabilities, StreamDescriptor
from dextouch.streams.samples import SampleBatch
from services.alignment.synchronization.stream_clock import time_stream

PERIOD_NS = 10_000_000
COUNT = 300


def take(*, stamps, numbers, period_ns=PERIOD_NS):
    index = np.arange(COUNT, dtype=np.int64)
    waits_ns = index * 7919 % 97 * 5000
    batch = SampleBatch(
        t_host_ns=10**12 + index * period_ns + waits_ns,
        t_device_ns=index * PERIOD_NS if stamps else np.full(COUNT, -1),
        sequence=index if numbers else np.full(COUNT, -1),
        values=np.zeros((COUNT, 1), dtype=np.float32),
    )
    descriptor = StreamDescriptor(
        name="x",
        kind="scalar",
        shape=(1,),
        dtype="float32",
        unit="1",
        nominal_rate_hz=100,
        capabilities=ClockCapabilities(device_time=stamps, sequence=numbers),
    )
    return batch, descriptor


@pytest.mark.parametrize(
    ("given", "method"),
    [
        ({"stamps": True, "numbers": True}, "device"),
        ({"stamps": False, "numbers": True}, "sequence"),
        ({"stamps": False, "numbers": False}, "counting"),
        ({"stamps": False, "numbers": False, "period_ns": 13_000_000}, "arrival"),
    ],
)
def test_the_report_names_the_method_and_the_latency(given, method):
    batch, descriptor = take(**given)
    timed = time_stream(batch, descriptor, latency_ns=3_000_000, latency_sigma_ns=250_000.0)
    assert (timed.method, timed.report.method) == (method, method)
    assert timed.report.latency_ms == 3.0
    assert timed.report.latency_sigma_ms == 0.25
    assert time_stream(batch, descriptor).report.latency_sigma_ms is None


def test_reports_of_older_episodes_load():
    report = ClockReport.model_validate({"stream": "x", "skew_ppm": 1.0, "num_samples": 3})
    assert (report.method, report.latency_sigma_ms) == (None, None)
