"""Log of the newest changes of levels, with the number of times each finding was raised.

A station lives for weeks: the log takes all of its memory at the start and never more.
"""

import threading
from typing import get_args

import numpy as np

from services.acquisition.schemas import Code, HealthEvent, Level

MAX_EVENTS = 2000
_CODES: tuple[Code, ...] = get_args(Code)
_LEVELS: tuple[Level, ...] = get_args(Level)
_EVENT = np.dtype(
    [("t_host_ns", np.int64), ("stream", np.uint16), ("code", np.uint8), ("level", np.uint8)]
)


class EventLog:
    """The newest 2000 changes of levels, oldest first, in a ring of fixed size.

    Any thread may add and ask.
    """

    def __init__(self) -> None:
        # Filled, not zeroed: zeroed pages take no memory before they are written.
        self._ring = np.full(MAX_EVENTS, 1, dtype=_EVENT)
        self._num_added = 0
        # Names of streams by the number that stands in the ring, and the other way round.
        self._names: list[str] = []
        self._numbers: dict[str, int] = {}
        self._raised: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()

    def add(self, t_host_ns: int, stream: str, code: Code, level: Level) -> None:
        """A code of a stream has reached a level; OK is its end."""
        with self._lock:
            if stream not in self._numbers:
                self._numbers[stream] = len(self._names)
                self._names.append(stream)
            row = (t_host_ns, self._numbers[stream], _CODES.index(code), _LEVELS.index(level))
            self._ring[self._num_added % MAX_EVENTS] = row
            self._num_added += 1
            if level != "OK":
                self._raised[stream, code] = self._raised.get((stream, code), 0) + 1

    def events(self, since_ns: int = 0) -> tuple[HealthEvent, ...]:
        """Events from a moment on."""
        with self._lock:
            oldest = self._num_added % MAX_EVENTS if self._num_added > MAX_EVENTS else 0
            rows = np.roll(self._ring, -oldest)[: min(self._num_added, MAX_EVENTS)]
        return tuple(
            HealthEvent(
                t_host_ns=t_ns, stream=self._names[stream], code=_CODES[code], level=_LEVELS[level]
            )
            for t_ns, stream, code, level in rows[rows["t_host_ns"] >= since_ns].tolist()
        )

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        with self._lock:
            return dict(self._raised)
