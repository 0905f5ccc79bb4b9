"""Evaluations of streams: samples that are looked at, findings, and levels with hysteresis."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from dextouch.schemas import HealthEvent, HealthLevel, RaisedFinding, TaxelState
from services.acquisition.health.codes import CODES, NEVER, SEVERITY

WINDOW_NS = 10_000_000_000
MIN_ROLLING = 64
RAISE_AFTER = 2
CLEAR_AFTER = 5
MAX_EVENTS = 2000


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream since the last evaluation.

    `latency_ns` is the time from a read's timestamp until its samples were spooled; `values` is
    None for streams whose values are not checked.
    """

    t_host_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    latency_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."] | None = None

    def __len__(self) -> int:
        return len(self.t_host_ns)


NO_SAMPLES = Block(*(np.empty(0, dtype=np.int64) for _ in range(4)))


class CountWindow:
    """Counters that only grow, and by how much they grew within the last 10 s."""

    def __init__(self, count: Callable[[], Mapping[str, int]], now_ns: int = 0) -> None:
        self._count = count
        self.history = deque([(now_ns, count())])

    def growth(self, now_ns: int) -> Counter[str]:
        """Look again; growth since the last look that is 10 s old, or since the first one."""
        history = self.history
        history.append((now_ns, self._count()))
        while len(history) > 2 and history[1][0] <= now_ns - WINDOW_NS:
            history.popleft()
        grown = Counter(history[-1][1])
        grown.subtract(history[0][1])
        return grown


class Rolling:
    """Numbers with their times, those of the last `span_ns` only.

    Its arrays grow to what a full span needs and stay as they are: windows that come and go in
    ever other sizes leave holes in the memory that nothing else fits into.
    """

    def __init__(self, span_ns: int = WINDOW_NS) -> None:
        self._span_ns = span_ns
        self._t_ns = np.zeros(MIN_ROLLING, dtype=np.int64)
        self._values = np.zeros(MIN_ROLLING)
        self._count = 0

    def add(self, t_ns: np.ndarray, values: np.ndarray, now_ns: int) -> np.ndarray:
        """Append, forget what is too old, and give the rest: a view that the next call changes."""
        stop = self._count + len(t_ns)
        while stop > len(self._t_ns):
            self._t_ns = np.concatenate([self._t_ns, np.zeros_like(self._t_ns)])
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
        self._t_ns[self._count : stop] = t_ns
        self._values[self._count : stop] = values
        kept = np.flatnonzero(self._t_ns[:stop] >= now_ns - self._span_ns)
        self._count = len(kept)
        if self._count < stop:
            self._t_ns[: self._count] = self._t_ns[kept]
            self._values[: self._count] = self._values[kept]
        return self.values

    @property
    def values(self) -> Float64[np.ndarray, " n"]:
        """What is kept."""
        return self._values[: self._count]

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Times of what is kept."""
        return self._t_ns[: self._count]


class Finding(NamedTuple):
    """What one evaluation found wrong."""

    code: str
    level: Literal["WARN", "ERROR"]
    message: str


@dataclass
class Evaluation:
    """One evaluation of a stream or of the station, to which each of its checks adds.

    `block` has none of the station itself, `figures` are numbers by metric name, `taxels` those of
    a glove that are out of order, in anatomical order, by state. `suspicious` requests another
    evaluation before the regular one, for faults that must last a while before they count.
    """

    now_ns: int
    block: Block = NO_SAMPLES
    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    taxels: dict[TaxelState, tuple[int, ...]] = field(default_factory=dict)
    suspicious: bool = False

    def judge(
        self,
        code: str,
        value: float | int,
        message: str,
        *,
        at_least: tuple[float, float] = (-NEVER, -NEVER),
    ) -> None:
        """Add a finding where a value is above the limits of its code.

        `at_least` are limits for WARN and ERROR where those of the code are smaller.
        """
        rule = CODES[code]
        if value > max(rule.warn, at_least[0]):
            is_error = value >= max(rule.error, at_least[1])
            self.findings.append(Finding(code, "ERROR" if is_error else "WARN", message))

    def include(self, other: "Evaluation") -> None:
        """Add the findings and figures of another evaluation."""
        self.findings += other.findings
        self.figures |= other.figures


# A check of one aspect of a stream or of the station, run at every evaluation.
HealthCheck = Callable[[Evaluation], None]


def raised_finding(
    code: str, level: HealthLevel, message: str, *, lasted_ns: int | None
) -> RaisedFinding:
    """A finding for the report, with the advice of its code.

    Raises:
        KeyError: a code that is not in `CODES`.
    """
    return RaisedFinding.model_validate(
        {
            "code": code,
            "level": level,
            "message": message,
            "advice": CODES[code].advice,
            "lasted_s": None if lasted_ns is None else max(0, lasted_ns) / 1e9,
        }
    )


def worst(levels: Sequence[HealthLevel], default: HealthLevel = "OK") -> HealthLevel:
    """The most severe level; STALE ranks above ERROR."""
    return max(levels, key=SEVERITY.index, default=default)


class Hysteresis:
    """A level that rises when 2 judgements in a row agree and falls when 5 do.

    It rises to the milder of the last 2, and falls to the graver of the last 5.
    """

    def __init__(self) -> None:
        self.level: HealthLevel = "OK"
        self.message = ""
        self.since_ns = 0
        self._recent: tuple[HealthLevel, ...] = ()

    @property
    def is_rising(self) -> bool:
        """Whether one more judgement like the last one would raise the level."""
        return bool(self._recent) and is_graver(self._recent[-1], self.level)

    def update(self, judgement: HealthLevel) -> HealthLevel:
        """One evaluation."""
        recent = self._recent = (*self._recent, judgement)[-CLEAR_AFTER:]
        if len(recent) >= RAISE_AFTER:
            self.level = worst([self.level, min(recent[-RAISE_AFTER:], key=SEVERITY.index)])
        if len(recent) == CLEAR_AFTER:
            self.level = min(self.level, worst(recent), key=SEVERITY.index)
        return self.level


class Board:
    """Findings of one stream (or of the station), with separate hysteresis for each code."""

    def __init__(self) -> None:
        self._codes: dict[str, Hysteresis] = {}

    @property
    def is_rising(self) -> bool:
        """Whether something was seen once and awaits its confirmation."""
        return any(hysteresis.is_rising for hysteresis in self._codes.values())

    def update(
        self, findings: Sequence[Finding], now_ns: int, *, confirming: bool = False
    ) -> list[tuple[str, HealthLevel]]:
        """One evaluation; codes whose level changed, with the new level.

        Of one code the gravest finding counts. `confirming` is an evaluation between the regular
        ones, which may raise, never clear.
        """
        judged: dict[str, HealthLevel] = {}
        for finding in sorted(findings, key=lambda item: SEVERITY.index(item.level)):
            judged[finding.code] = finding.level
            self._codes.setdefault(finding.code, Hysteresis()).message = finding.message
        changes: list[tuple[str, HealthLevel]] = []
        for code, hysteresis in self._codes.items():
            judgement, before = judged.get(code, "OK"), hysteresis.level
            if confirming and not is_graver(judgement, before):
                continue
            if hysteresis.update(judgement) != before:
                changes.append((code, hysteresis.level))
                if before == "OK":
                    hysteresis.since_ns = now_ns
        return changes

    def active(self, now_ns: int) -> tuple[RaisedFinding, ...]:
        """What is raised now, gravest first."""
        raised = [
            raised_finding(code, h.level, h.message, lasted_ns=now_ns - h.since_ns)
            for code, h in self._codes.items()
            if h.level != "OK"
        ]
        return tuple(sorted(raised, key=lambda item: -SEVERITY.index(item.level)))


class EventLog:
    """The newest 2000 changes of levels, oldest first, and how often each code was raised.

    Any thread may add and ask.
    """

    def __init__(self) -> None:
        self._events: deque[tuple[int, str, str, HealthLevel]] = deque(maxlen=MAX_EVENTS)
        self._raised: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def add(self, t_host_ns: int, stream: str, code: str, level: HealthLevel) -> None:
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


def is_graver(level: HealthLevel, than: HealthLevel) -> bool:
    """Whether a level is more severe than another."""
    return SEVERITY.index(level) > SEVERITY.index(than)
