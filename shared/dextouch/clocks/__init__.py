"""Clock models: counter unwrapping, and device time to host time, offline and online."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.clocks.clock_model import ClockModel as ClockModel
    from dextouch.clocks.clock_model import ClockSegment as ClockSegment
    from dextouch.clocks.clock_model import fit_clock as fit_clock
    from dextouch.clocks.clock_model import lateness_ns as lateness_ns
    from dextouch.clocks.counters import SequenceReport as SequenceReport
    from dextouch.clocks.counters import TickCounter as TickCounter
    from dextouch.clocks.counters import find_lost_samples as find_lost_samples
    from dextouch.clocks.counters import prefers_sequence as prefers_sequence
    from dextouch.clocks.counters import unwrap_counter as unwrap_counter
    from dextouch.clocks.counting_clock import CountedSample as CountedSample
    from dextouch.clocks.counting_clock import CountedTake as CountedTake
    from dextouch.clocks.counting_clock import CountingClock as CountingClock
    from dextouch.clocks.counting_clock import date_by_counting as date_by_counting
    from dextouch.clocks.online_clock import OnlineClock as OnlineClock
    from dextouch.clocks.round_trips import ClockOffset as ClockOffset
    from dextouch.clocks.round_trips import KnownSkew as KnownSkew
    from dextouch.clocks.round_trips import PathLatency as PathLatency
    from dextouch.clocks.round_trips import RoundTrip as RoundTrip
    from dextouch.clocks.round_trips import RoundTripClock as RoundTripClock
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
