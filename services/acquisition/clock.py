"""Clock of a station, which timestamps arrivals and on which all threads wait."""

import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import KW_ONLY, dataclass
from functools import partial

# Far more than the fraction of a millisecond that reading two clocks or slewing one takes.
MIN_NOTICED_NS = 100_000_000
# Two clocks are read together in a few µs; where it took longer, the process was interrupted.
# Chosen: ten attempts, since even a busy machine interrupts fewer than one of two.
READ_GAP_NS = 20_000
CLOCK_READS = 10


class StationClock:
    """Monotonic clock of the station's host, in nanoseconds.

    It runs at the rate of the host's crystal: CLOCK_MONOTONIC and CLOCK_BOOTTIME follow NTP, which
    changes their rate by up to 8 % (chrony's `maxslewrate`), CLOCK_MONOTONIC_RAW does not
    (clock_gettime(2)). That one stands while the host is suspended; the time in suspend, which
    CLOCK_BOOTTIME has beyond CLOCK_MONOTONIC, is added, so that this clock continues.
    """

    def __init__(self) -> None:
        self._sleep_lock = threading.Lock()
        self._asleep_ns = self._boot_over_monotonic_ns()

    def read_ns(self, clock_id: int) -> int:
        """Time of one of the operating system's clocks, such as `time.CLOCK_BOOTTIME`."""
        return time.clock_gettime_ns(clock_id)

    def now_ns(self) -> int:
        """Nanoseconds since the boot of the host, including time in suspend."""
        return self.read_ns(time.CLOCK_MONOTONIC_RAW) + self.suspended_ns()

    def waiter(self, *, drives_time: bool = False) -> "Waiter":
        """A new waiter. `drives_time` only matters to a virtual clock."""
        return Waiter(self)

    def suspended_ns(self) -> int:
        """How long the host has slept since its boot."""
        with self._sleep_lock:
            # Both clocks are slewed alike. Time passes between reading the two, which can only
            # reduce the difference: the largest one is right, and `now_ns` never goes back.
            self._asleep_ns = max(self._asleep_ns, self._boot_over_monotonic_ns())
            return self._asleep_ns

    def wall_offset_ns(self) -> int:
        """Wall clock minus the time since boot; a jump means that the wall clock was set."""
        clocks = (time.CLOCK_REALTIME, time.CLOCK_BOOTTIME)
        return _difference_ns(*(partial(self.read_ns, clock_id) for clock_id in clocks))

    def _boot_over_monotonic_ns(self) -> int:
        return self.read_ns(time.CLOCK_BOOTTIME) - self.read_ns(time.CLOCK_MONOTONIC)


class Waiter:
    """One thread's way to wait on a clock; used by one thread, cancelled by any."""

    def __init__(self, clock: StationClock) -> None:
        self._clock = clock
        self._cancelled = threading.Event()

    def wait_until(self, t_ns: int) -> bool:
        """Block until the clock shows `t_ns`; False when cancelled."""
        while (remaining_ns := t_ns - self._clock.now_ns()) > 0:
            if self._cancelled.wait(remaining_ns / 1e9):
                return False
        return not self._cancelled.is_set()

    def cancel(self) -> None:
        """End the present wait, and every later one, at once."""
        self._cancelled.set()

    def close(self) -> None:
        """Stop taking part in the clock."""
        self._cancelled.set()


class VirtualClock(StationClock):
    """Virtual clock that jumps to the next target as soon as all threads wait.

    The time moves when every open waiter waits and at least one of them drives time; it moves to
    the earliest of their targets. Time does not advance while a thread runs, so timestamps are
    exact and reproducible, and a take of minutes runs as fast as the processor allows.
    """

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns
        super().__init__()
        self.lock = threading.Lock()
        self.open_waiters: set[_VirtualWaiter] = set()

    def read_ns(self, clock_id: int) -> int:
        """The virtual time: all clocks of a simulated host agree."""
        return self._now_ns

    def now_ns(self) -> int:
        """The virtual time."""
        return self._now_ns

    def waiter(self, *, drives_time: bool = False) -> Waiter:
        """A waiter; from now on time advances only while this waiter waits."""
        waiter = _VirtualWaiter(self, drives_time=drives_time)
        with self.lock:
            self.open_waiters.add(waiter)
        return waiter

    def suspended_ns(self) -> int:
        """A simulated host never sleeps."""
        return 0

    def wall_offset_ns(self) -> int:
        """Nobody sets the wall clock of a simulated host."""
        return 0

    def advance(self) -> None:
        """Move the time and wake who is due; the caller holds the lock."""
        waiters = self.open_waiters
        targets = [w.target_ns for w in waiters if w.target_ns is not None]
        if len(targets) == len(waiters) and any(w.drives_time for w in waiters):
            self._now_ns = max(self._now_ns, min(targets))
        for waiter in waiters:
            if waiter.target_ns is not None and waiter.target_ns <= self._now_ns:
                waiter.target_ns = None
                waiter.woken.notify()


class _VirtualWaiter(Waiter):
    def __init__(self, clock: VirtualClock, *, drives_time: bool) -> None:
        self._time = clock
        self.drives_time = drives_time
        self.woken = threading.Condition(clock.lock)
        self.target_ns: int | None = None
        self._is_cancelled = False

    def wait_until(self, t_ns: int) -> bool:
        with self._time.lock:
            self.target_ns = t_ns
            self._time.advance()
            while self.target_ns is not None and not self._is_cancelled:
                self.woken.wait()
            self.target_ns = None
            return not self._is_cancelled

    def cancel(self) -> None:
        with self._time.lock:
            self._is_cancelled = True
            self.woken.notify()

    def close(self) -> None:
        with self._time.lock:
            self._time.open_waiters.discard(self)
            self._time.advance()


@dataclass(eq=False)
class PeriodicCall:
    """Calls a function in a thread of its own, `period_ns` from the end of one call to the next.

    `on_wake` is called before each call with the time and how late the thread woke, both in ns.
    """

    call: Callable[[], None]
    _: KW_ONLY
    period_ns: int
    clock: StationClock
    name: str
    on_wake: Callable[[int, int], None] | None = None
    _running: tuple[Waiter, threading.Thread] | None = None

    def start(self) -> None:
        """Start calling, one period from now."""
        waiter = self.clock.waiter()
        thread = threading.Thread(target=self._run, args=(waiter,), name=self.name, daemon=True)
        self._running = waiter, thread
        thread.start()

    def cancel(self) -> None:
        """End after the call that is under way, which may be this one; waits for nothing."""
        if self._running is not None:
            self._running[0].cancel()

    def stop(self) -> None:
        """End the thread, after the call that is under way; nothing if it was never started."""
        if self._running is not None:
            self.cancel()
            self._running[1].join()

    def _run(self, waiter: Waiter) -> None:
        with closing(waiter):
            while waiter.wait_until(due_ns := self.clock.now_ns() + self.period_ns):
                if self.on_wake is not None:
                    now_ns = self.clock.now_ns()
                    self.on_wake(now_ns, now_ns - due_ns)
                self.call()


def station_offset_ns(clock: StationClock) -> int:
    """What a recent stamp on CLOCK_MONOTONIC of this host needs to be on the station's clock.

    NTP slews CLOCK_MONOTONIC against the station's clock, by 500 ppm (the kernel) or more (chrony),
    so it is read anew for every few stamps: for one of a tenth of a second ago 500 ppm are 50 µs.
    """
    return -_difference_ns(partial(clock.read_ns, time.CLOCK_MONOTONIC), clock.now_ns)


def _difference_ns(first: Callable[[], int], second: Callable[[], int]) -> int:
    """The first clock minus the second at one moment.

    A reading that was interrupted is repeated; what remains is below half of READ_GAP_NS.
    """
    gap_ns, difference_ns = sys.maxsize, 0
    for _ in range(CLOCK_READS):
        before_ns, first_ns, after_ns = second(), first(), second()
        if after_ns - before_ns < gap_ns:
            gap_ns = after_ns - before_ns
            difference_ns = first_ns - (before_ns + after_ns) // 2
        if gap_ns <= READ_GAP_NS:
            break
    return difference_ns


class HostWatch:
    """Finds out, at every `look`, whether the host slept or its wall clock was set meanwhile.

    Neither touches the stamps: the station's clock counts on through sleep and nobody sets it. But
    both explain things (a gap in all streams; a `started_at` that does not fit), so they are told.
    `events` are, by name, when each was noticed on the station's clock and how long it was, in ns.
    """

    def __init__(self, clock: StationClock) -> None:
        self._clock = clock
        self.events: dict[str, list[tuple[int, int]]] = {"host_suspended": [], "wall_clock_set": []}
        self._before_ns = clock.suspended_ns(), clock.wall_offset_ns()

    def look(self) -> None:
        """Compare with the last look."""
        after_ns = self._clock.suspended_ns(), self._clock.wall_offset_ns()
        steps_ns = (abs(b - a) for a, b in zip(self._before_ns, after_ns, strict=True))
        for events, step_ns in zip(self.events.values(), steps_ns, strict=True):
            if step_ns > MIN_NOTICED_NS:
                events.append((self._clock.now_ns(), step_ns))
        self._before_ns = after_ns

    def problems(self) -> tuple[str, ...]:
        """What happened, in words."""
        texts = {
            "host_suspended": "the host was suspended for {s:.1f} s during the take: "
            "a gap in all streams",
            "wall_clock_set": "the wall clock was set by {s:.1f} s during the take: timestamps "
            "are not affected, but started_at may be wrong",
        }
        return tuple(
            texts[name].format(s=sum(step_ns for _, step_ns in events) / 1e9)
            for name, events in self.events.items()
            if events
        )
