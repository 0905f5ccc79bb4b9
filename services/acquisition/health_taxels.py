"""Health check of the taxels of our own glove: dead, stuck, saturated or drifting.

A taxel that does not change is not necessarily faulty, because a hand at rest looks the same. It is
reported if its neighbours change while it does not, or if no load explains its reading.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.streams import StreamDescriptor
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import NUM_TAXELS, Side, join_pads, raw_indices, split_pads
from services.acquisition.devices.tactile_glove.packets import FULL_SCALE_COUNTS
from services.acquisition.health_blocks import Block
from services.acquisition.health_cells import (
    SATURATED_SHARE,
    SHARE_LIMITS,
    STRONG_SHARE,
    CellHistory,
    sum_around,
)
from services.acquisition.health_levels import Verdict, above
from services.acquisition.schemas import Code, HealthFinding

MOVED_KPA = 1.0
# About as much, where the glove's gain is not known.
MOVED_COUNTS = 40
NOTHING_SHARE = 0.5
MIN_TARE_COUNTS = 20.0
DRIFT_LIMITS = (3.0, 10.0)
# A tare without a stated scatter is good to one count.
TARE_SIGMA_COUNTS = 1.0
MAX_TOUCHED_SHARE = 0.25
_SCAN_COLUMNS = 20


@dataclass(frozen=True)
class GloveRecord:
    """Calibration of the 320 taxels of one glove, in anatomical order."""

    side: Side
    tare_counts: Float64[np.ndarray, "320"]
    gain_counts_per_kpa: Float64[np.ndarray, "320"]
    tare_sigma_counts: Float64[np.ndarray, "320"]


class TaxelJudge:
    """Checks the 320 taxels of one glove from its raw counts."""

    def __init__(self, descriptor: StreamDescriptor, glove: GloveRecord) -> None:
        self._descriptor = descriptor
        self._glove = glove
        self._indices = raw_indices(side=glove.side)
        self._lines = self._indices // _SCAN_COLUMNS, self._indices % _SCAN_COLUMNS
        self._moved_counts = MOVED_KPA * glove.gain_counts_per_kpa
        self._history = CellHistory(float(FULL_SCALE_COUNTS))

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del now_ns
        history = self._history
        if block.values is not None and len(block):
            counts = block.values[:, self._indices].astype(np.int64)
            history.add(counts, block.t_host_ns)
        if not history.is_enough:
            return Verdict()
        low, high = history.extremes()
        history.find_silent(neighbour_share(high - low >= self._moved_counts))
        at_top = low >= SATURATED_SHARE * FULL_SCALE_COUNTS
        saturated = history.saturated()
        tare = self._glove.tare_counts
        nothing = (tare >= MIN_TARE_COUNTS) & (high < NOTHING_SHARE * tare)
        loaded = history.last > tare + self._moved_counts
        dead = nothing | (history.silent & ~loaded)
        stuck = history.silent & loaded & ~at_top
        findings = (
            *self._finding("taxels_dead", dead, "dead"),
            *self._finding("taxels_stuck", stuck, "stuck"),
            *self._finding("taxels_saturated", saturated, "saturated"),
        )
        figures = {
            "dead_taxels_ratio": float(dead.mean()),
            "stuck_taxels_ratio": float(stuck.mean()),
            "saturated_taxels_ratio": float(saturated.mean()),
        }
        drift = self._judge_drift()
        waiting = bool((at_top & ~saturated).any())
        return Verdict(findings + drift.findings, {**figures, **drift.figures}, waiting)

    def _finding(self, code: Code, taxels: np.ndarray, word: str) -> tuple[HealthFinding, ...]:
        part = whole_part(taxels, self._lines)
        if part is not None:
            return (HealthFinding(code=code, level="ERROR", message=f"{part} {word}"),)
        count = int(taxels.sum())
        return above(code, count / NUM_TAXELS, SHARE_LIMITS, f"{count} taxels {word}")

    def _judge_drift(self) -> Verdict:
        """Common offset of the taxels at rest; none while much of the hand is touched."""
        glove = self._glove
        offsets = self._history.recent.mean(axis=0) - glove.tare_counts
        drift_counts = float(np.median(offsets))
        touched = np.abs(offsets - drift_counts) > (
            CONTACT_THRESHOLD_KPA * glove.gain_counts_per_kpa
        )
        if touched.mean() > MAX_TOUCHED_SHARE:
            return Verdict()
        sigma_counts = max(TARE_SIGMA_COUNTS, float(np.median(glove.tare_sigma_counts)))
        drift = abs(drift_counts) / sigma_counts
        text = f"the zero has moved by {drift_counts:+.1f} counts since the tare; tare again"
        return Verdict(
            above("baseline", drift, DRIFT_LIMITS, text), {"baseline_drift_ratio": drift}
        )


@dataclass(frozen=True)
class TaxelCounts:
    """How many of the 320 taxels are out."""

    dead: int
    stuck: int
    saturated: int


def count_taxels(low_counts: np.ndarray, high_counts: np.ndarray, *, side: Side) -> TaxelCounts:
    """What the least and greatest counts [360] of a whole take say about the taxels.

    Without a tare a taxel that reads 0 throughout is dead where the others rest above 0. One that
    never changed although its neighbours moved is dead, too, or stuck where it stayed more than
    `MOVED_COUNTS` above the median taxel's least reading.
    """
    indices = raw_indices(side=side)
    low, high = low_counts[indices].astype(np.int64), high_counts[indices].astype(np.int64)
    around = neighbour_share(high - low >= MOVED_COUNTS)
    saturated = low >= SATURATED_SHARE * FULL_SCALE_COUNTS
    silent = (high == low) & (around >= STRONG_SHARE) & ~saturated
    zero = (high == 0) & (np.median(low) >= MIN_TARE_COUNTS)
    loaded = low > np.median(low) + MOVED_COUNTS
    dead = zero | (silent & ~loaded)
    return TaxelCounts(int(dead.sum()), int((silent & loaded).sum()), int(saturated.sum()))


def neighbour_share(moved: Bool[np.ndarray, "320"]) -> Float64[np.ndarray, "320"]:
    """Share of the up to 8 neighbours on its pad that moved, for each taxel."""
    shares = []
    for grid in split_pads(moved.astype(np.float64)):
        around = sum_around(grid) - grid
        count = sum_around(np.ones_like(grid)) - 1.0
        shares.append(around / count)
    return join_pads(shares[0], shares[1])


def whole_part(taxels: Bool[np.ndarray, "320"], lines: tuple[np.ndarray, np.ndarray]) -> str | None:
    """Name of a pad or scan line that consists of such taxels only; None when there is none."""
    tips, palm = split_pads(taxels)
    if tips.all(axis=(1, 2)).any():
        return "a whole fingertip is"
    if palm.all():
        return "the whole palm is"
    for numbers, word in zip(lines, ("row", "column"), strict=True):
        good = np.bincount(numbers[~taxels], minlength=int(numbers.max()) + 1)
        empty = np.flatnonzero(good[: int(numbers.max()) + 1] == 0)
        if len(empty):
            return f"scan {word} {empty[0]} is"
    return None
