"""Log of the newest changes of levels, with the number of times each finding was raised."""

import threading
from collections import Counter, deque

from services.acquisition.schemas import Code, HealthEvent, Level

MAX_EVENTS = 2000


class EventLog:
    """The newest 2000 changes of levels, oldest first.

    Any thread may add and ask.
    """

    def __init__(self) -> None:
        self._events: deque[tuple[int, str, Code, Level]] = deque(maxlen=MAX_EVENTS)
        self._raised: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def add(self, t_host_ns: int, stream: str, code: Code, level: Level) -> None:
        """A code of a stream has reached a level; OK is its end."""
        with self._lock:
            self._events.append((t_host_ns, stream, code, level))
            if level != "OK":
                self._raised[stream, code] += 1

    def events(self, since_ns: int = 0) -> tuple[HealthEvent, ...]:
        """Events from a moment on."""
        with self._lock:
            newest = [event for event in self._events if event[0] >= since_ns]
        return tuple(
            HealthEvent(t_host_ns=t_ns, stream=stream, code=code, level=level)
            for t_ns, stream, code, level in newest
        )

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        with self._lock:
            return dict(self._raised)
