"""The root cause of an ended take: one sentence, one advice, for its gravest problem."""

import pytest

from dextouch.schemas import HealthCause, TakeProblem
from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.supervisor import StreamCounters
from services.acquisition.take import StreamFacts, root_cause

HUB = HealthCause(
    code="hub",
    subject="1-2",
    level="STALE",
    message="USB hub 1-2: nothing comes from head, wrist",
    advice="Plug the hub in again.",
    lasted_s=2.0,
    streams=("head", "wrist"),
    findings=("unplugged",),
)


def problem(stream, code, level="ERROR"):
    return TakeProblem(stream=stream, code=code, level=level, message=f"{stream}: {code}")


def test_no_problem_has_no_cause():
    assert root_cause((), (HUB,)) is None


def test_what_health_saw_explains_the_gravest_problem():
    problems = (problem("glove", "loss", "WARN"), problem("wrist", "gap"))
    cause = root_cause(problems, (HUB,))
    assert (cause.message, cause.advice) == (HUB.message, HUB.advice)


def test_a_cause_of_something_else_explains_nothing():
    jitter = HUB.model_copy(update={"findings": ("jitter",)})
    elsewhere = HUB.model_copy(update={"streams": ("camera",)})
    cause = root_cause((problem("wrist", "gap"),), (jitter, elsewhere))
    assert cause.message == "wrist: gap"


def test_errors_lead_and_a_missing_stream_leads_them():
    problems = (
        problem("camera", "image_blurred", "WARN"),
        problem("head", "gap"),
        problem("wrist", "missing_stream"),
        problem("glove", "missing_stream"),
    )
    cause = root_cause(problems, ())
    assert cause.message == "wrist: missing_stream (and in 1 other stream)"
    # The advice of docs/health.md for a device from which nothing comes.
    assert cause.advice.startswith("Power-cycle the device")


def test_nothing_is_to_plug_on_a_simulated_device():
    cause = root_cause((problem("head", "missing_stream"),), (), simulated={"head"})
    assert "simulated" in cause.advice


@pytest.mark.parametrize(("kind", "rate_hz"), [("scalar", 1.0), ("pose", 4.0), ("image", 1.0)])
def test_a_slow_stream_has_no_gap_before_it_misses_samples(kind, rate_hz):
    shape, dtype, unit = ((4, 4, 3), "uint8", "rgb8") if kind == "image" else ((7,), "float64", "1")
    descriptor = StreamDescriptor(
        name="slow", kind=kind, shape=shape, dtype=dtype, unit=unit, nominal_rate_hz=rate_hz
    )
    period_ns, events = descriptor.period_ns(), vars(DecoderStatistics())
    count = StreamCounters(10, 0, period_ns, 10 * period_ns, period_ns)
    whole = StreamFacts(descriptor, count, events, (0, 11 * period_ns))
    assert not list(whole.problems())
    count.largest_gap_ns = 4 * period_ns
    assert [problem.code for problem in whole.problems()] == ["gap"]
    # A short take may hold a single sample of it.
    one = StreamCounters(1, 0, period_ns, period_ns, 0)
    assert not list(StreamFacts(descriptor, one, events, (0, 2 * period_ns)).problems())
