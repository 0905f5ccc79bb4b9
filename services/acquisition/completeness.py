"""The check of a take: whether it is complete, what its ledger counts and its quality."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dextouch.schemas import LedgerEntry
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS
from services.acquisition.counters import StreamCounters
from services.acquisition.drivers.packet_search import DecoderStatistics
from services.acquisition.health_taxels import TaxelCounts, count_taxels
from services.acquisition.schemas import StreamTake, TakeCheck, TakeProblem

RATE_WARN = 0.02
RATE_ERROR = 0.10
LOSS_WARN = 0.001
LOSS_ERROR = 0.05
# Shorter takes say nothing about rates and loss ratios.
MIN_JUDGED_S = 1.0
# Any taxel that is out is worth a word; with 5 % of them a take is not worth keeping.
TAXELS_ERROR = 16
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
    """One stream of a take, with what its device's decoder counted during the take."""

    descriptor: StreamDescriptor
    counters: StreamCounters
    decoder: DecoderStatistics

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

    def taxels(self) -> TaxelCounts | None:
        """Dead, stuck and saturated taxels of the take; None for streams of other devices.

        Cells of other gloves are checked by health monitoring, whose findings the check includes.
        """
        side, extremes = self.descriptor.side, self.counters.extremes
        if side is None or extremes is None or self.descriptor.kind != "tactile":
            return None
        if self.descriptor.shape != (NUM_RAW_TAXELS,):
            return None
        return count_taxels(extremes.low_counts, extremes.high_counts, side=side)


def check_take(facts: Sequence[StreamFacts], span: TakeSpan) -> TakeCheck:
    """Judge a take: complete means no problem of level ERROR."""
    problems = [problem for fact in facts for problem in _problems(fact, span)]
    streams = [
        StreamTake(
            stream=fact.descriptor.name,
            num_samples=fact.counters.num_samples,
            rate_hz=fact.rate_hz(),
            largest_gap_s=fact.largest_gap_s(span),
            lost=fact.decoder.lost,
            crc_errors=fact.decoder.crc_errors,
        )
        for fact in facts
    ]
    return TakeCheck(
        complete=all(problem.level != "ERROR" for problem in problems),
        duration_s=span.duration_s,
        streams=tuple(streams),
        problems=tuple(problems),
    )


def take_ledger(facts: Sequence[StreamFacts]) -> tuple[LedgerEntry, ...]:
    """Counted events of the take, for the recording's attributes."""
    entries = []
    for fact in facts:
        counted: Mapping[str, int] = {
            "lost": fact.decoder.lost,
            "late": fact.decoder.late,
            "crc_errors": fact.decoder.crc_errors,
            "length_errors": fact.decoder.length_errors,
            "resync_bytes": fact.decoder.resync_bytes,
            "refused": fact.decoder.refused,
            "suspects": fact.decoder.suspects,
            "repeated": fact.decoder.repeated,
            "restarts": fact.decoder.restarts,
            **_taxel_events(fact),
        }
        name = fact.descriptor.name
        entries += [LedgerEntry(stream=name, event=e, count=n) for e, n in counted.items() if n]
    return tuple(entries)


def take_quality(facts: Sequence[StreamFacts], span: TakeSpan) -> dict[str, float]:
    """Figures of a take by stream, for the recording's `quality`; the episode takes them over."""
    quality: dict[str, float] = {}
    for fact in facts:
        name, rate_hz = fact.descriptor.name, fact.rate_hz()
        quality[f"{name}_largest_gap_s"] = fact.largest_gap_s(span)
        if rate_hz is not None:
            quality[f"{name}_rate_hz"] = rate_hz
        if fact.descriptor.capabilities.sequence:
            lost = fact.decoder.lost
            quality[f"{name}_loss_ratio"] = lost / max(1, lost + fact.decoder.packets)
        for event, count in _taxel_events(fact).items():
            quality[f"{name}_num_{event}"] = float(count)
    return quality


def _taxel_events(fact: StreamFacts) -> dict[str, int]:
    taxels = fact.taxels()
    if taxels is None:
        return {}
    return {
        "dead_taxels": taxels.dead,
        "stuck_taxels": taxels.stuck,
        "saturated_taxels": taxels.saturated,
    }


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
    if off > RATE_WARN:
        text = f"{rate_hz:.1f} Hz, expected {descriptor.nominal_rate_hz:g} Hz"
        found.append(_problem(fact, "rate", "ERROR" if off > RATE_ERROR else "WARN", text))
    loss = fact.decoder.lost / max(1, fact.decoder.lost + fact.decoder.packets)
    if loss > LOSS_WARN:
        text = f"{fact.decoder.lost} packets lost ({loss:.1%}), {fact.decoder.crc_errors} corrupt"
        found.append(_problem(fact, "loss", "ERROR" if loss > LOSS_ERROR else "WARN", text))
    for event, count in _taxel_events(fact).items():
        if count:
            text = f"{count} {event.replace('_', ' ')} during the whole take"
            level = "ERROR" if count >= TAXELS_ERROR else "WARN"
            found.append(_problem(fact, event, level, text))
    return found


def _problem(fact: StreamFacts, code: str, level: str, text: str) -> TakeProblem:
    name = fact.descriptor.name
    return TakeProblem.model_validate(
        {"stream": name, "code": code, "level": level, "message": f"{name}: {text}"}
    )
