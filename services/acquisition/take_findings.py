"""Health findings in the streams of a take, collected while it runs.

The findings that the API, the metrics and the dashboard show become entries of the take's ledger,
warnings of its check, and figures of its quality.
"""

from collections.abc import Collection
from typing import Protocol, runtime_checkable

from dextouch.schemas import HealthEvents, LedgerEntry, StationHealth, TakeProblem
from services.acquisition.health import CODES

# What stands in the take's quality in a form of its own (`_rate_hz`), or counts from the
# station's start.
OTHER_FIGURES = {"rate_hz", "clock_resets"}
# What the check of the take says in its own words, by the code that it has there.
IN_THE_CHECK: dict[str, tuple[str, ...]] = {
    "silent": ("gap", "missing_stream"),
    "unplugged": ("gap", "missing_stream"),
    "gap": ("gap", "missing_stream"),
    "rate": ("rate", "missing_stream"),
    "loss": ("loss",),
    "taxels_dead": ("dead_taxels",),
    "taxels_stuck": ("stuck_taxels",),
    "taxels_saturated": ("saturated_taxels",),
}


@runtime_checkable
class HealthSource(Protocol):
    """The part of a station's health that a take uses."""

    def report(self) -> StationHealth:
        """Every stream at this moment."""
        ...

    def events(self, since_ns: int = 0) -> HealthEvents:
        """Changes of levels from a moment on."""
        ...

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        ...


class TakeFindings:
    """Health findings in streams since this object was created.

    A finding counts as often as its level was raised or changed during the take, and once more if
    it was already raised when the take began. Findings that were not confirmed before the end are
    not included.

    Args:
        health: of the station; without one there are no findings.
        t_host_ns: start of the take.
    """

    def __init__(self, health: HealthSource | None, t_host_ns: int) -> None:
        self._health = health
        self._started_ns = t_host_ns
        self._before: dict[tuple[str, str], int] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._first_ns: dict[tuple[str, str], int] = {}
        self._worst: dict[str, float] = {}
        if health is None:
            return
        self._before = health.raised()
        for stream in health.report().streams:
            for finding in stream.findings:
                key = (stream.stream, finding.code)
                # What was never raised is no finding yet: a stream that is about to begin.
                if key in self._before:
                    self._counts[key] = 1
                    self._first_ns[key] = t_host_ns

    def look(self) -> None:
        """Update the worst value of each figure; called repeatedly during the take."""
        if self._health is None:
            return
        for stream in self._health.report().streams:
            for figure, value in stream.figures.items():
                name = f"{stream.stream}_worst_{figure}"
                if figure not in OTHER_FIGURES and abs(value) >= abs(self._worst.get(name, 0.0)):
                    self._worst[name] = value

    def end(self) -> None:
        """Count what was raised; what comes later is not of this take."""
        if self._health is None:
            return
        self.look()
        for key, count in self._health.raised().items():
            num_new = count - self._before.get(key, 0)
            if num_new:
                self._counts[key] = self._counts.get(key, 0) + num_new
        for event in self._health.events(self._started_ns).events:
            if event.level != "OK":
                self._first_ns.setdefault((event.stream, event.code), event.t_host_ns)
        self._health = None

    def entries(self, streams: Collection[str]) -> list[LedgerEntry]:
        """One entry a finding of these streams, named by its code."""
        return [
            LedgerEntry(
                stream=stream,
                event=code,
                count=count,
                first_t_host_ns=self._first_ns.get((stream, code)),
            )
            for (stream, code), count in self._counts.items()
            if stream in streams
        ]

    def quality(self) -> dict[str, float]:
        """The worst of each figure of health during the take, as `STREAM_worst_FIGURE`."""
        return dict(self._worst)

    def problems(
        self, streams: Collection[str], known: Collection[TakeProblem]
    ) -> list[TakeProblem]:
        """The findings of these streams in words, but for those that the check names already.

        They are warnings: whether a take is complete is judged by its own samples.
        """
        told = {(problem.stream, problem.code) for problem in known}
        found = []
        for entry in self.entries(streams):
            codes = IN_THE_CHECK.get(entry.event, (entry.event,))
            if any((entry.stream, code) in told for code in codes):
                continue
            times = "once" if entry.count == 1 else f"{entry.count} times"
            advice = CODES[entry.event].advice
            found.append(
                TakeProblem(
                    stream=entry.stream,
                    code=entry.event,
                    level="WARN",
                    message=f"{entry.stream}: {entry.event} found {times}. {advice}",
                )
            )
        return found
