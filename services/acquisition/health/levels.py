"""Findings of single evaluations, and the levels with hysteresis that are computed from them."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from dextouch.schemas import HealthEvent, HealthLevel, RaisedFinding
from services.acquisition.health.codes import CODES, NEVER, SEVERITY
from services.acquisition.health.samples import Block

RAISE_AFTER = 2
CLEAR_AFTER = 5
MAX_EVENTS = 2000


class Finding(NamedTuple):
    """What one evaluation found wrong."""

    code: str
    level: Literal["WARN", "ERROR"]
    message: str


@dataclass(frozen=True)
class Verdict:
    """What one check says: findings, figures by metric name, and whether to look again soon.

    `suspicious` asks for another evaluation before the regular one, for faults that must last a
    while before they count.
    """

    findings: tuple[Finding, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    suspicious: bool = False


# A check of one aspect of a stream or the station, run at every evaluation: with the samples since
# the last one (none for the station) and the time of the station's clock.
Judge = Callable[[Block, int], Verdict]


def find(
    code: str,
    value: float | int,
    message: str,
    *,
    at_least: tuple[float, float] = (-NEVER, -NEVER),
) -> tuple[Finding, ...]:
    """A finding where a value is above the limits of its code.

    Args:
        code: what it is.
        value: in the unit of the code's limits.
        message: in words.
        at_least: limits for WARN and ERROR where those of the code are smaller.
    """
    rule = CODES[code]
    if not value > max(rule.warn, at_least[0]):
        return ()
    is_error = value >= max(rule.error, at_least[1])
    return (Finding(code, "ERROR" if is_error else "WARN", message),)


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
    return max(levels, key=_rank, default=default)


class Hysteresis:
    """A level that rises when 2 judgements in a row agree and falls when 5 do.

    It rises to the milder of the last 2, and falls to the graver of the last 5.
    """

    # Small, as a station has one for each code that any of its streams ever showed.
    __slots__ = ("_recent", "level", "message", "since_ns")

    def __init__(self) -> None:
        self.level: HealthLevel = "OK"
        self.message = ""
        self.since_ns = 0
        self._recent: tuple[HealthLevel, ...] = ()

    @property
    def is_rising(self) -> bool:
        """Whether one more judgement like the last one would raise the level."""
        return bool(self._recent) and _rank(self._recent[-1]) > _rank(self.level)

    def update(self, judgement: HealthLevel) -> HealthLevel:
        """One evaluation."""
        recent = self._recent = (*self._recent, judgement)[-CLEAR_AFTER:]
        if len(recent) >= RAISE_AFTER:
            self.level = max(self.level, min(recent[-RAISE_AFTER:], key=_rank), key=_rank)
        if len(recent) == CLEAR_AFTER:
            self.level = min(self.level, max(recent, key=_rank), key=_rank)
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

        Args:
            findings: at most one a code counts: the gravest.
            now_ns: of the evaluation.
            confirming: an evaluation between the regular ones. It may raise, never clear.
        """
        judged: dict[str, HealthLevel] = {}
        for finding in sorted(findings, key=lambda item: _rank(item.level)):
            judged[finding.code] = finding.level
            self._codes.setdefault(finding.code, Hysteresis()).message = finding.message
        changes: list[tuple[str, HealthLevel]] = []
        for code, hysteresis in self._codes.items():
            judgement, before = judged.get(code, "OK"), hysteresis.level
            if confirming and _rank(judgement) <= _rank(before):
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
        return tuple(sorted(raised, key=lambda item: -_rank(item.level)))


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


def _rank(level: HealthLevel) -> int:
    return SEVERITY.index(level)
