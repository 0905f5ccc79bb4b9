"""The check of a take: whether it is complete, what its ledger counts and its quality."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from dextouch.schemas import LedgerEntry, StreamTake, TakeCheck, TakeProblem
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS
from services.acquisition.health import CODES, count_taxels
from services.acquisition.supervisor import StreamCounters

# A take may lose more than a running station before it is not worth keeping.
LOSS_ERROR = 0.05
# Shorter takes say nothing about rates and loss ratios.
MIN_JUDGED_S = 1.0
MAX_GAP_S = {"image": 0.5}
MAX_GAP_OTHERS_S = 0.2


@dataclass(frozen=True)
class TakeSpan:
    """Start and end of a take on the host's clock."""

    start_t_host_ns: int
    stop_t_host_ns: int

    @property
    def duration_s(self) -> float:
        """Length of the take."""
        return (self.stop_t_host_ns - self.start_t_host_ns) / 1e9


@dataclass(frozen=True)
class StreamFacts:
    """One stream of a take, with all that its device and its reader counted during the take.

    `judged` names the counts that are figures of the take's quality, too.
    """

    descriptor: StreamDescriptor
    counters: StreamCounters
    events: Mapping[str, int]
    judged: Collection[str] = ()

    @property
    def loss_ratio(self) -> float:
        """Share of the packets that were lost."""
        lost = self.events["lost"]
        return lost / max(1, lost + self.events["packets"])

    def rate_hz(self) -> float | None:
        """Mean rate between the first and the last sample; None of less than two."""
        first_ns, last_ns = self.counters.first_t_host_ns, self.counters.last_t_host_ns
        if first_ns is None or last_ns is None or last_ns <= first_ns:
            return None
        return (self.counters.num_samples - 1) * 1e9 / (last_ns - first_ns)

    def largest_gap_s(self, span: TakeSpan) -> float:
        """Longest time without a sample, the take's ends included."""
        first_ns, last_ns = self.counters.first_t_host_ns, self.counters.last_t_host_ns
        if first_ns is None or last_ns is None:
            return span.duration_s
        edges = (first_ns - span.start_t_host_ns, span.stop_t_host_ns - last_ns)
        return max(self.counters.largest_gap_ns, *edges) / 1e9

    def taxels(self) -> dict[str, int]:
        """Numbers of dead, stuck and saturated taxels; none for streams of other devices.

        Cells of other gloves are checked by health monitoring, whose findings the check includes.
        """
        side, low, high = (
            self.descriptor.side,
            self.counters.low_counts,
            self.counters.high_counts,
        )
        if side is None or low is None or high is None or self.descriptor.kind != "tactile":
            return {}
        if self.descriptor.shape != (NUM_RAW_TAXELS,):
            return {}
        return count_taxels(low, high, side=side)


def check_take(facts: Sequence[StreamFacts], span: TakeSpan) -> TakeCheck:
    """Judge a take: complete means no problem of level ERROR."""
    problems = [problem for fact in facts for problem in _problems(fact, span)]
    streams = [
        StreamTake(
            stream=fact.descriptor.name,
            num_samples=fact.counters.num_samples,
            rate_hz=fact.rate_hz(),
            largest_gap_s=fact.largest_gap_s(span),
            lost=fact.events["lost"],
            crc_errors=fact.events["crc_errors"],
        )
        for fact in facts
    ]
    return TakeCheck(
        complete=all(problem.level != "ERROR" for problem in problems),
        duration_s=span.duration_s,
        streams=tuple(streams),
        problems=tuple(problems),
    )


def take_ledger(facts: Sequence[StreamFacts]) -> list[LedgerEntry]:
    """Counted events of the take, for the recording's attributes."""
    entries = []
    for fact in facts:
        counted = {**fact.events, **fact.taxels(), "packets": 0}
        name = fact.descriptor.name
        entries += [LedgerEntry(stream=name, event=e, count=n) for e, n in counted.items() if n]
    return entries


def take_quality(facts: Sequence[StreamFacts], span: TakeSpan) -> dict[str, float]:
    """Figures of a take by stream, for the recording's `quality`; the episode takes them over."""
    quality: dict[str, float] = {}
    for fact in facts:
        name, rate_hz = fact.descriptor.name, fact.rate_hz()
        quality[f"{name}_largest_gap_s"] = fact.largest_gap_s(span)
        if rate_hz is not None:
            quality[f"{name}_rate_hz"] = rate_hz
        if fact.descriptor.capabilities.sequence:
            quality[f"{name}_loss_ratio"] = fact.loss_ratio
        judged = {event: fact.events[event] for event in fact.judged}
        for event, count in {**judged, **fact.taxels()}.items():
            quality[f"{name}_num_{event}"] = float(count)
    return quality


def _problems(fact: StreamFacts, span: TakeSpan) -> list[TakeProblem]:
    descriptor, found = fact.descriptor, []
    if fact.counters.num_samples == 0:
        return [_problem(fact, "missing_stream", "ERROR", "no sample arrived; is it connected?")]
    max_gap_s = MAX_GAP_S.get(descriptor.kind, MAX_GAP_OTHERS_S)
    gap_s = fact.largest_gap_s(span)
    if gap_s > max_gap_s:
        text = f"{gap_s:.2f} s without a sample, expected at most {max_gap_s} s"
        found.append(_problem(fact, "gap", "ERROR", text))
    if span.duration_s < MIN_JUDGED_S:
        return found
    rate_hz = fact.rate_hz() or 0.0
    off = abs(rate_hz / descriptor.nominal_rate_hz - 1.0)
    if off > CODES["rate"].warn:
        text = f"{rate_hz:.1f} Hz, expected {descriptor.nominal_rate_hz:g} Hz"
        level = "ERROR" if off > CODES["rate"].error else "WARN"
        found.append(_problem(fact, "rate", level, text))
    loss = fact.loss_ratio
    if loss > CODES["loss"].warn:
        lost, damaged = fact.events["lost"], fact.events["crc_errors"]
        text = f"{lost} packets lost ({loss:.1%}), {damaged} corrupt"
        found.append(_problem(fact, "loss", "ERROR" if loss > LOSS_ERROR else "WARN", text))
    for event, count in fact.taxels().items():
        if count:
            text = f"{count} {event.replace('_', ' ')} during the whole take"
            level = "ERROR" if count >= CODES["taxels_dead"].error * NUM_TAXELS else "WARN"
            found.append(_problem(fact, event, level, text))
    return found


def _problem(fact: StreamFacts, code: str, level: str, text: str) -> TakeProblem:
    name = fact.descriptor.name
    return TakeProblem.model_validate(
        {"stream": name, "code": code, "level": level, "message": f"{name}: {text}"}
    )
