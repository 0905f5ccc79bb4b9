"""What dates a stream, and what its clock report says of it."""

import dataclasses
import io

import numpy as np
import pytest
from rich.console import Console

from dextouch.errors import InvalidInputError
from dextouch.schemas import ClockReport
from dextouch.streams import ClockCapabilities, SampleBatch, StreamDescriptor
from services.alignment.command_line import report_line, report_page
from services.alignment.schemas import AlignmentReport
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
    assert timed.report.method == method
    assert timed.report.latency_ms == 3.0
    assert timed.report.latency_sigma_ms == 0.25
    assert time_stream(batch, descriptor).report.latency_sigma_ms is None


@pytest.mark.parametrize("stamps", [True, False])
@pytest.mark.parametrize("stop_s", [0.05, 0.5, 3.0])
def test_a_device_that_stood_still_is_dated_right_on_both_sides(stamps, stop_s):
    """A minute at 100 Hz; its timer stops for a while in the middle, and nothing says so."""
    index = np.arange(6000, dtype=np.int64)
    true_ns = 10**12 + index * PERIOD_NS + (index >= 3000) * round(stop_s * 1e9)
    _, descriptor = take(stamps=stamps, numbers=True)
    batch = SampleBatch(
        t_host_ns=true_ns + index * 7919 % 97 * 5000,
        t_device_ns=index * PERIOD_NS if stamps else np.full(6000, -1),
        sequence=index,
        values=np.zeros((6000, 1), dtype=np.float32),
    )
    timed = time_stream(batch, descriptor)
    np.testing.assert_allclose(timed.t_host_ns - true_ns, 0, atol=100_000)
    assert (timed.report.num_steps, timed.report.warnings) == (1, ("stop",))


@pytest.mark.parametrize(
    ("stamps", "skew_ppm", "warnings"),
    [(True, 900, ()), (True, 1100, ("skew",)), (False, 1100, ()), (False, 30_000, ("skew",))],
)
def test_a_clock_far_off_its_rate_is_a_warning(stamps, skew_ppm, warnings):
    """Numbers count by a nominal rate, which may be off by percents; stamps may not."""
    batch, descriptor = take(stamps=stamps, numbers=True)
    since_ns = np.arange(COUNT, dtype=np.int64) * (PERIOD_NS + PERIOD_NS * skew_ppm // 1_000_000)
    timed = time_stream(dataclasses.replace(batch, t_host_ns=10**12 + since_ns), descriptor)
    assert timed.report.skew_ppm == pytest.approx(skew_ppm, abs=1)
    assert timed.report.warnings == warnings


def test_clumps_are_no_warning():
    """The last sample of each does not wait, and tells the clock."""
    batch, descriptor = take(stamps=True, numbers=True)
    # Five at a time: they wait for 40, 30, 20, 10 and 0 ms.
    clumps_ns = np.repeat(batch.t_host_ns[4::5] // PERIOD_NS * PERIOD_NS, 5)
    timed = time_stream(dataclasses.replace(batch, t_host_ns=clumps_ns), descriptor)
    np.testing.assert_allclose(timed.t_host_ns - 10**12, timed.kept * PERIOD_NS, atol=500_000)
    report = timed.report
    assert report.residual_rms_ms == pytest.approx(np.sqrt(600), abs=0.01)
    assert report.warnings == ()


@pytest.mark.parametrize(("late_ms", "warnings"), [(1, ()), (8, ("residual",))])
def test_samples_that_are_all_late_are_a_warning(late_ms, warnings):
    """A clock loses so much in ten seconds and gains it in ten: the line lies below its arcs."""
    index = np.arange(6000, dtype=np.int64)
    arc = 1 - np.abs(index / 1000 % 2 - 1)
    _, descriptor = take(stamps=True, numbers=True)
    batch = SampleBatch(
        t_host_ns=10**12 + index * PERIOD_NS + np.rint(arc * late_ms * 1e6).astype(np.int64),
        t_device_ns=index * PERIOD_NS,
        sequence=index,
        values=np.zeros((6000, 1), dtype=np.float32),
    )
    assert time_stream(batch, descriptor).report.warnings == warnings


def test_doubts_are_on_the_line_and_the_page_of_a_report():
    clocks = (
        ClockReport(stream="glove_left", num_samples=9),
        ClockReport(
            stream="glove_right",
            num_samples=9,
            skew_ppm=-4200.0,
            residual_rms_ms=71.25,
            num_steps=3,
            warnings=("skew", "residual", "stop"),
        ),
    )
    report = AlignmentReport(
        recording_id="take",
        episode_id="take-1",
        created=True,
        domain="human",
        num_steps=4,
        streams={},
        absent=(),
        clocks=clocks,
        quality={},
        content_sha256="0" * 64,
    )
    console = Console(width=300, record=True, file=io.StringIO())
    console.print(report_page(report))
    for text in (report_line(report), console.export_text()):
        assert "glove_right: unreliable times: its clock is skewed by -4200 ppm and even" in text
        assert "(71.2 ms RMS of all) and the device clock stopped or was slewed, or the" in text
        assert "glove_left: times" not in text


def test_reports_of_older_episodes_load():
    report = ClockReport.model_validate({"stream": "x", "skew_ppm": 1.0, "num_samples": 3})
    assert (report.method, report.latency_sigma_ms) == (None, None)
    assert (report.num_steps, report.warnings) == (0, ())


@pytest.mark.parametrize(("stamps", "numbers"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("count", [2, 9])
def test_a_stream_of_few_samples_is_dated_by_their_arrival(stamps, numbers, count):
    """Such as a thermometer with a sample every few seconds: too few for a line."""
    whole, descriptor = take(stamps=stamps, numbers=numbers)
    batch = SampleBatch(*(column[:count] for column in vars(whole).values()))
    timed = time_stream(batch, descriptor, latency_ns=1000)
    assert timed.report.method == "arrival"
    np.testing.assert_array_equal(timed.t_host_ns, batch.t_host_ns - 1000)


@pytest.mark.parametrize("stamps", [True, False])
@pytest.mark.parametrize("bits", [16, 32])
def test_a_device_that_starts_anew_has_lost_what_it_did_not_send_alone(stamps, bits):
    """Its counter begins at 0 again after more than half of its way: the nearer way is ahead."""
    index = np.arange(COUNT, dtype=np.int64)
    is_new = index >= 150
    _, descriptor = take(stamps=stamps, numbers=True)
    capabilities = descriptor.capabilities.model_copy(update={"sequence_bits": bits})
    true_ns = 10**12 + index * PERIOD_NS + is_new * 2_000_000_000
    batch = SampleBatch(
        t_host_ns=true_ns + index * 7919 % 97 * 5000,
        t_device_ns=np.where(is_new, index - 150, index + 1000) * PERIOD_NS
        if stamps
        else -(index**0),
        sequence=np.where(is_new, index - 150, index + round(0.55 * 2**bits)),
        values=np.zeros((COUNT, 1), dtype=np.float32),
    )
    timed = time_stream(batch, descriptor.model_copy(update={"capabilities": capabilities}))
    assert (timed.report.num_steps, timed.report.num_dropped) == (1, 0)
    np.testing.assert_allclose(timed.t_host_ns - true_ns, 0, atol=100_000)


def test_a_counter_beyond_its_bits_is_refused_with_the_name_of_its_stream():
    batch, descriptor = take(stamps=True, numbers=True)
    narrow = ClockCapabilities(device_time=True, sequence=True, device_time_bits=24)
    descriptor = descriptor.model_copy(update={"capabilities": narrow})
    with pytest.raises(InvalidInputError, match=r"stream 'x': counter: got counts 0 … 2990000000"):
        time_stream(batch, descriptor)
