"""Clocks: straight counters, and device time to host time, offline and as samples arrive."""

from dextouch.clocks.clock_model import ClockModel, ClockSegment, fit_clock
from dextouch.clocks.online_clock import OnlineClock
from dextouch.clocks.timestamps import SequenceReport, find_lost_samples, unwrap_counter

__all__ = [
    "ClockModel",
    "ClockSegment",
    "OnlineClock",
    "SequenceReport",
    "find_lost_samples",
    "fit_clock",
    "unwrap_counter",
]
