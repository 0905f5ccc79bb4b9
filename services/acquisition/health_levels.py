"""Levels of findings with hysteresis, computed from single evaluations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from services.acquisition.health_advice import ADVICE
from services.acquisition.schemas import Code, HealthFinding, Level, RaisedFinding

RAISE_AFTER = 2
CLEAR_AFTER = 5
SEVERITY: tuple[Level, ...] = ("OK", "WARN", "ERROR", "STALE")

Judgement = Literal["OK", "WARN", "ERROR"]


def worst(levels: Sequence[Level], default: Level = "OK") -> Level:
    """The most severe level; STALE ranks above ERROR."""
    return max(levels, key=SEVERITY.index, default=default)


@dataclass(frozen=True)
class Verdict:
    """What one judge says: findings, figures by metric name, and whether to look again soon.

    `suspicious` asks for another evaluation before the regular one, for faults that must last a
    while before they count.
    """

    findings: tuple[HealthFinding, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    suspicious: bool = False


def above(
    code: Code, value: float, limits: tuple[float, float], message: str
) -> tuple[HealthFinding, ...]:
    """A finding when `value` lies above the first limit, an ERROR from the second one on."""
    if not value > limits[0]:
        return ()
    level: Literal["WARN", "ERROR"] = "ERROR" if value >= limits[1] else "WARN"
    return (HealthFinding(code=code, level=level, message=message),)


class Hysteresis:
    """A level that rises when 2 judgements in a row agree and falls when 5 do.

    It rises to the milder of the last 2, and falls to the graver of the last 5.
    """

    # Small, as a station has one for each code that any of its streams ever showed.
    __slots__ = ("_recent", "level")

    def __init__(self) -> None:
        self.level: Judgement = "OK"
        self._recent: tuple[Judgement, ...] = ()

    @property
    def is_rising(self) -> bool:
        """Whether one more judgement like the last one would raise the level."""
        return bool(self._recent) and _rank(self._recent[-1]) > _rank(self.level)

    def update(self, judgement: Judgement) -> Judgement:
        """One evaluation."""
        recent = self._recent = (*self._recent, judgement)[-CLEAR_AFTER:]
        if len(recent) >= RAISE_AFTER:
            mildest = min(recent[-RAISE_AFTER:], key=_rank)
            if _rank(mildest) > _rank(self.level):
                self.level = mildest
        if len(recent) == CLEAR_AFTER:
            gravest = max(recent, key=_rank)
            if _rank(gravest) < _rank(self.level):
                self.level = gravest
        return self.level


class Board:
    """Findings of one stream (or of the station), with separate hysteresis for each code."""

    def __init__(self) -> None:
        self._codes: dict[Code, Hysteresis] = {}
        self._messages: dict[Code, str] = {}
        self._since_ns: dict[Code, int] = {}

    @property
    def is_rising(self) -> bool:
        """Whether something was seen once and awaits its confirmation."""
        return any(hysteresis.is_rising for hysteresis in self._codes.values())

    def update(
        self, findings: Sequence[HealthFinding], now_ns: int, *, confirming: bool = False
    ) -> list[tuple[Code, Judgement]]:
        """One evaluation; codes whose level changed, with the new level.

        Args:
            findings: at most one a code counts: the gravest.
            now_ns: of the evaluation.
            confirming: an evaluation between the regular ones. It may raise, never clear.
        """
        judged: dict[Code, Judgement] = {}
        for finding in sorted(findings, key=lambda item: _rank(item.level)):
            judged[finding.code] = finding.level
            self._messages[finding.code] = finding.message
            if finding.code not in self._codes:
                self._codes[finding.code] = Hysteresis()
        changes: list[tuple[Code, Judgement]] = []
        for code, hysteresis in list(self._codes.items()):
            judgement = judged.get(code, "OK")
            before = hysteresis.level
            if confirming and _rank(judgement) <= _rank(before):
                continue
            if hysteresis.update(judgement) != before:
                changes.append((code, hysteresis.level))
                if before == "OK":
                    self._since_ns[code] = now_ns
        return changes

    def active(self, now_ns: int) -> tuple[RaisedFinding, ...]:
        """What is raised now, gravest first."""
        raised = [
            RaisedFinding(
                code=code,
                level=hysteresis.level,
                message=self._messages[code],
                advice=ADVICE[code],
                lasted_s=max(0, now_ns - self._since_ns[code]) / 1e9,
            )
            for code, hysteresis in self._codes.items()
            if hysteresis.level != "OK"
        ]
        return tuple(sorted(raised, key=lambda item: -_rank(item.level)))


def _rank(level: Level) -> int:
    return SEVERITY.index(level)
