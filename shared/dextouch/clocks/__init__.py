"""Clock models: counter unwrapping, and device time to host time, offline and online."""

from dextouch.clocks.clock_model import ClockModel, ClockSegment, fit_clock, lateness_ns
from dextouch.clocks.counters import TickCounter, prefers_sequence
from dextouch.clocks.counting_clock import (
    CountedSample,
    CountedTake,
    CountingClock,
    CountingUpdate,
    date_by_counting,
)
from dextouch.clocks.online_clock import OnlineClock
from dextouch.clocks.round_trips import (
    ClockOffset,
    KnownSkew,
    PathLatency,
    RoundTrip,
    RoundTripClock,
)
from dextouch.clocks.timestamps import SequenceReport, find_lost_samples, unwrap_counter

__all__ = [
    "ClockModel",
    "ClockOffset",
    "ClockSegment",
    "CountedSample",
    "CountedTake",
    "CountingClock",
    "CountingUpdate",
    "KnownSkew",
    "OnlineClock",
    "PathLatency",
    "RoundTrip",
    "RoundTripClock",
    "SequenceReport",
    "TickCounter",
    "date_by_counting",
    "find_lost_samples",
    "fit_clock",
    "lateness_ns",
    "prefers_sequence",
    "unwrap_counter",
]
