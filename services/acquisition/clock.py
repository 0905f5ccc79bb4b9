"""The station's one clock: arrival stamps come out, and what paces itself waits on it."""

import threading
import time
from typing import Protocol, runtime_checkable

from dextouch.errors import InvalidInputError


@runtime_checkable
class Waiter(Protocol):
    """One thread's way to wait on a clock; used by one thread, cancelled by any."""

    def wait_until(self, t_ns: int) -> bool:
        """Block until the clock shows `t_ns`; False when cancelled."""
        ...

    def cancel(self) -> None:
        """End the present wait, and every later one, at once."""
        ...

    def close(self) -> None:
        """Stop taking part in the clock."""
        ...


@runtime_checkable
class StationClock(Protocol):
    """Monotonic nanoseconds of the station's host."""

    def now_ns(self) -> int:
        """The time now."""
        ...

    def waiter(self, *, drives_time: bool = False) -> Waiter:
        """A new waiter. `drives_time` only matters to a virtual clock."""
        ...


class RealClock:
    """The host's monotonic clock, if wanted `speed` times as fast (for replays in less time).

    A faster clock also magnifies what the operating system adds to each stamp.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not 0.01 <= speed <= 100:
            raise InvalidInputError(f"clock speed: got {speed}, expected 0.01 … 100")
        self._speed = speed
        self._origin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Nanoseconds of `time.monotonic_ns`, counted `speed` times as fast from the start on."""
        t_ns = time.monotonic_ns()
        if self._speed == 1.0:
            return t_ns
        return self._origin_ns + int((t_ns - self._origin_ns) * self._speed)

    def waiter(self, *, drives_time: bool = False) -> Waiter:
        """A waiter that sleeps."""
        del drives_time
        return _RealWaiter(self, self._speed)


class _RealWaiter:
    def __init__(self, clock: RealClock, speed: float) -> None:
        self._clock = clock
        self._speed = speed
        self._cancelled = threading.Event()

    def wait_until(self, t_ns: int) -> bool:
        while (remaining_ns := t_ns - self._clock.now_ns()) > 0:
            if self._cancelled.wait(remaining_ns / 1e9 / self._speed):
                return False
        return not self._cancelled.is_set()

    def cancel(self) -> None:
        self._cancelled.set()

    def close(self) -> None:
        self._cancelled.set()


class VirtualClock:
    """Time that jumps to the next thing to do as soon as everybody waits for it.

    The time moves when every open waiter waits and at least one of them drives time; it moves to
    the earliest of their targets. A thread that runs holds the time still, so what it stamps is
    exact and repeatable, and a take of minutes passes as fast as the processor allows.
    """

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()
        self._open: set[_VirtualWaiter] = set()

    def now_ns(self) -> int:
        """The virtual time."""
        return self._now_ns

    def waiter(self, *, drives_time: bool = False) -> Waiter:
        """A waiter; from here on the time stands unless this waiter waits."""
        waiter = _VirtualWaiter(self, self._lock, drives_time=drives_time)
        with self._lock:
            self._open.add(waiter)
        return waiter

    def _wait(self, waiter: "_VirtualWaiter", t_ns: int) -> bool:
        with self._lock:
            waiter.target_ns = t_ns
            self._advance()
            while waiter.target_ns is not None and not waiter.cancelled:
                waiter.woken.wait()
            waiter.target_ns = None
            return not waiter.cancelled

    def _cancel(self, waiter: "_VirtualWaiter") -> None:
        with self._lock:
            waiter.cancelled = True
            waiter.woken.notify()

    def _leave(self, waiter: "_VirtualWaiter") -> None:
        with self._lock:
            self._open.discard(waiter)
            self._advance()

    def _advance(self) -> None:
        targets = [w.target_ns for w in self._open if w.target_ns is not None]
        if len(targets) < len(self._open) or not any(w.drives_time for w in self._open):
            due_ns = self._now_ns
        else:
            due_ns = max(self._now_ns, min(targets))
        self._now_ns = due_ns
        for waiter in self._open:
            if waiter.target_ns is not None and waiter.target_ns <= due_ns:
                waiter.target_ns = None
                waiter.woken.notify()


class _VirtualWaiter:
    def __init__(self, clock: VirtualClock, lock: threading.Lock, *, drives_time: bool) -> None:
        self._clock = clock
        self.drives_time = drives_time
        self.woken = threading.Condition(lock)
        self.target_ns: int | None = None
        self.cancelled = False

    def wait_until(self, t_ns: int) -> bool:
        return self._clock._wait(self, t_ns)  # noqa: SLF001 - the two classes are one mechanism

    def cancel(self) -> None:
        self._clock._cancel(self)  # noqa: SLF001

    def close(self) -> None:
        self._clock._leave(self)  # noqa: SLF001
