"""Health checks of the pressure cells of gloves.

A cell that does not change is reported if its neighbours change while it does not, or if no load
explains its reading (docs/health.md). `TaxelCheck` checks gloves that send counts, whose layout
wires their taxels, by their tare, `CellCheck` those of other manufacturers.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix, TaxelState
from dextouch.streams import (
    TaxelFaults,
    drifting_taxels,
    implausible_gain,
    neighbour_share,
    share_around,
)
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import DEXTOUCH_V1, Side, TactileLayout
from services.acquisition.drivers.base import CellLayout, Decoder
from services.acquisition.health.codes import CODES
from services.acquisition.health.evaluation import Evaluation, Finding
from services.acquisition.health.glove_records import NO_CELL, GloveRecord, mapped_cells

RECENT_NS = 500_000_000
MIN_RECENT_SPAN_NS = 400_000_000
QUIET_NS = 5_000_000_000
SATURATED_NS = 1_000_000_000
SATURATED_SHARE = 0.995
# So many of the neighbours must move: at once for a quick verdict, within 5 s for a slow one.
STRONG_SHARE = 0.75
WEAK_SHARE = 0.5
# Shares of full scale: what counts as moving, and what as loaded.
MOVED_SHARE = 0.01
LOADED_SHARE = 0.05
# With fewer loaded cells than these, nothing can be said about one of them.
MIN_LOADED = 8
MOVED_KPA = 1.0
# About as much, where the glove's gain is not known.
MOVED_COUNTS = 40
NOTHING_SHARE = 0.5
MIN_TARE_COUNTS = 20.0
# A tare without a stated scatter is good to one count.
TARE_SIGMA_COUNTS = 1.0
MAX_TOUCHED_SHARE = 0.25
DRIFT_NS = 10_000_000_000
MAX_ZEROS = 1200
# Said of taxels that a take would lose, after their number; braces stand for their pads.
LOST_TAXELS = {
    "random": "",
    "copied": "",
    "saturated": " in {}: pressures end at the highest reading",
}
LOST_TAXELS |= {"drifting": " in {}: tare the glove again once it is warm"}
# Evaluations come once a second; one may be late.
MAX_STEP_NS = 1_500_000_000
PINNED_STATES: Final[tuple[TaxelState, ...]] = ("dead", "stuck", "saturated")
_SCAN_COLUMNS = 20


class _PressureCheck(ABC):
    """State of each cell from all samples so far, and the readings of the last 0.5 s."""

    def __init__(self, full_scale: float, noun: str) -> None:
        self._noun = noun
        self._top = SATURATED_SHARE * full_scale
        # Arrays of one element are those of all cells, until the first reading tells their number.
        self._recent_ns = np.empty(0, dtype=np.int64)
        self._recent = np.empty((0, 1))
        self._changed_ns = np.zeros(1, dtype=np.int64)
        self._around_ns = np.zeros(1, dtype=np.int64)
        self._below_ns = np.zeros(1, dtype=np.int64)
        self._silent = np.zeros(1, dtype=np.bool_)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block = evaluation.block
        if block.values is not None and len(block):
            self._add(self._readings(block.values), block.t_host_ns)
        known_ns = self._recent_ns
        if len(known_ns) and known_ns[-1] - known_ns[0] >= MIN_RECENT_SPAN_NS:
            self._judge(evaluation, self._recent.min(axis=0), self._recent.max(axis=0))

    @abstractmethod
    def _readings(self, values: np.ndarray) -> np.ndarray:
        """One row of cells a sample; NaN is no reading."""

    @abstractmethod
    def _judge(self, evaluation: Evaluation, low: np.ndarray, high: np.ndarray) -> None:
        """Judge by the least and greatest reading of the last 0.5 s; NaN where one was."""

    def _add(self, values: np.ndarray, t_ns: np.ndarray) -> None:
        if not len(self._recent_ns):
            self._recent = values[:0]
            self._changed_ns = self._below_ns = t_ns[:1]
        before = self._recent[-1:] if len(self._recent) else values[:1]
        changed = np.diff(values, axis=0, prepend=before) != 0
        self._changed_ns = _latest_ns(changed, t_ns, self._changed_ns)
        self._below_ns = _latest_ns(~(values >= self._top), t_ns, self._below_ns)
        self._silent = self._silent & ~changed.any(axis=0)
        all_ns, rows = np.append(self._recent_ns, t_ns), np.concatenate([self._recent, values])
        kept = all_ns >= all_ns[-1] - RECENT_NS
        self._recent_ns, self._recent = all_ns[kept], rows[kept]

    def _saturated(self) -> Bool[np.ndarray, " cells"]:
        """Cells at full scale for longer than a second."""
        return self._below_ns < self._recent_ns[-1] - SATURATED_NS

    def _quiet(self) -> Bool[np.ndarray, " cells"]:
        """Cells without a change for 5 s."""
        return self._changed_ns <= self._recent_ns[-1] - QUIET_NS

    def _find_silent(
        self, is_same: np.ndarray, around: Float64[np.ndarray, " cells"]
    ) -> Bool[np.ndarray, " cells"]:
        """Cells that stay the same while enough of their neighbours move, until they change."""
        self._around_ns = np.where(around >= WEAK_SHARE, self._recent_ns[-1], self._around_ns)
        slow = self._quiet() & (self._around_ns >= self._changed_ns + RECENT_NS)
        self._silent = self._silent | is_same & (around >= STRONG_SHARE) | slow
        return self._silent

    def _mark(
        self,
        evaluation: Evaluation,
        states: Mapping[TaxelState, np.ndarray],
        cells: np.ndarray | None = None,
    ) -> None:
        """Name the taxels in each state; a taxel has the first of the states that it is in.

        `cells` is the cell of each taxel where the masks are those of cells.
        """
        left = np.ones((), dtype=np.bool_)
        for state, mask in states.items():
            taxels = mask if cells is None else mask[cells] & (cells != NO_CELL)
            if (marked := np.flatnonzero(taxels & left)).size:
                evaluation.taxels[state] = tuple(marked.tolist())
            left = left & ~taxels

    def _report(
        self,
        evaluation: Evaluation,
        found: Mapping[str, np.ndarray],
        num_cells: int,
        parts: Mapping[str, str] | None = None,
    ) -> None:
        """Report the share of the cells that each code was found in; a part of that name is out."""
        for code, cells in found.items():
            count, word = int(cells.sum()), code.removeprefix("taxels_")
            evaluation.figures[f"{word}_taxels_ratio"] = count / num_cells
            if parts and code in parts:
                evaluation.findings.append(Finding(code, "ERROR", f"{parts[code]} is {word}"))
            else:
                evaluation.judge(code, count / num_cells, f"{count} {self._noun} {word}")


class TaxelCheck(_PressureCheck):
    """Checks the taxels of a glove from its raw counts.

    A taxel drifts if for 10 s it read 2 kPa or more above its tare, or below it, while three
    quarters of its neighbours read less than half of that: what presses there would press them,
    too. This is only marked and raises nothing, because a point that presses one taxel looks alike.
    `refused` are taxels whose gain the calibration refused, `layout` is that of the glove.
    """

    def __init__(
        self,
        record: GloveRecord,
        refused: Bool[np.ndarray, " taxels"] | None = None,
        layout: TactileLayout = DEXTOUCH_V1,
    ) -> None:
        super().__init__(layout.full_scale, "taxels")
        self._layout = layout
        self._indices = record.cells
        self._tare_counts = record.tare_counts[self._indices]
        self._gain_counts_per_kpa = record.gain_counts_per_kpa[self._indices]
        sigma_counts = float(np.median(record.tare_sigma_counts[self._indices]))
        self._sigma_counts = max(TARE_SIGMA_COUNTS, sigma_counts)
        none = np.zeros(layout.num_taxels, dtype=np.bool_)
        self._refused = none if refused is None else refused
        self._usable = ~self._refused & (self._indices != NO_CELL)
        self._drifts = none
        # Lowest pressures of half seconds, for some ten minutes.
        self._zeros: deque[np.ndarray] = deque(maxlen=MAX_ZEROS)
        good = self._usable & (self._gain_counts_per_kpa > 0)
        self._gain_text = (
            implausible_gain(self._gain_counts_per_kpa[good], layout.areas_m2[good], layout)
            if layout.unit == "counts" and good.any()
            else None
        )
        self._faults, self._faults_ns = self._begin(), 0
        self._found: list[Finding] = []
        # The readings at which it was found frozen, and since when.
        self._frozen: tuple[np.ndarray, int] | None = None
        # Least reading of each half second of the last 10 s, with its time.
        self._lows: deque[tuple[int, np.ndarray]] = deque()

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        super().__call__(evaluation)
        block = evaluation.block
        if block.values is not None and len(block):
            self._judge_faults(self._readings(block.values).astype(np.float64), evaluation)
        evaluation.findings += self._found

    def _begin(self) -> TaxelFaults:
        return TaxelFaults(
            self._tare_counts,
            self._gain_counts_per_kpa,
            usable=self._usable,
            layout=self._layout,
        )

    def _judge_faults(self, taxels: np.ndarray, evaluation: Evaluation) -> None:
        """What alignment finds in whole takes, in parts of 5 s."""
        now_ns = evaluation.now_ns
        if not self._usable.any():
            return
        if self._frozen is not None:
            if (taxels == self._frozen[0]).all():
                lasted_s = (now_ns - self._frozen[1]) * 1e-9
                evaluation.judge("frozen", lasted_s, f"readings are frozen for {lasted_s:.0f} s")
                return
            self._frozen = None
        self._faults.add(taxels)
        self._faults_ns = self._faults_ns or now_ns
        if now_ns - self._faults_ns < QUIET_NS:
            return
        judged, part = Evaluation(now_ns), self._faults
        for one in part.repeats():
            lasted_s = float(one.samples.mean()) * (now_ns - self._faults_ns) * 1e-9
            if one.harmless:
                judged.findings.append(Finding("frozen", "WARN", one.message))
                continue
            judged.judge("frozen", lasted_s, one.message)
            if one.samples[-1] and one.cause == "frozen":
                self._frozen = taxels[-1], now_ns - round(lasted_s * 1e9)
        faults = part.faults()
        self._zeros.extend(part.blocks.lows_kpa)
        drifts = drifting_taxels(np.stack(self._zeros), self._usable, self._layout)
        faults["drifting"] = self._drifts = drifts
        # At full scale they have a code of their own.
        top_kpa = (self._top - self._tare_counts) / self._gain_counts_per_kpa
        faults["saturated"] &= part.highest_kpa() < top_kpa
        judged.findings += self._lost(faults)
        if self._gain_text:
            judged.findings.append(Finding("implausible", "ERROR", self._gain_text))
        self._found, self._faults, self._faults_ns = judged.findings, self._begin(), 0
        self._faults.blocks.follow(part.blocks)

    def _lost(self, faults: Mapping[str, Bool[np.ndarray, " taxels"]]) -> Iterator[Finding]:
        """What a take would lose for these faults."""
        pads = list(zip(self._layout.pads, self._layout.starts, strict=True))
        for reason, more in LOST_TAXELS.items():
            taxels = faults[reason]
            if count := int(taxels.sum()):
                is_error = count >= CODES["taxels_dead"].error * self._layout.num_taxels
                where = [pad.part for pad, at in pads if taxels[at : at + pad.num_taxels].any()]
                text = f"{count} taxels are {reason}" + more.format(", ".join(where))
                yield Finding("implausible", "ERROR" if is_error else "WARN", text)

    def _readings(self, values: np.ndarray) -> np.ndarray:
        taxels = values[:, self._indices]
        return taxels.astype(np.int64) if taxels.dtype.kind in "iu" else taxels.astype(np.float64)

    def _judge(self, evaluation: Evaluation, low: np.ndarray, high: np.ndarray) -> None:
        tare, moved_counts = self._tare_counts, MOVED_KPA * self._gain_counts_per_kpa
        silent = self._find_silent(
            high == low, neighbour_share(high - low >= moved_counts, self._layout)
        )
        at_top, saturated = low >= self._top, self._saturated()
        nothing = (tare >= MIN_TARE_COUNTS) & (high < NOTHING_SHARE * tare)
        loaded = self._recent[-1] > tare + moved_counts
        found = {
            "taxels_dead": nothing | (silent & ~loaded),
            "taxels_stuck": silent & loaded & ~at_top,
            "taxels_saturated": saturated,
        }
        parts = {code: part for code, taxels in found.items() if (part := self._part(taxels))}
        self._report(evaluation, found, self._layout.num_taxels, parts)
        evaluation.suspicious |= bool((at_top & ~saturated).any())
        self._mark(
            evaluation,
            {
                **{state: found[f"taxels_{state}"] for state in PINNED_STATES},
                "drifting": self._drifting(evaluation.now_ns, low) | self._drifts,
                "refused": self._refused,
                "absent": self._indices == NO_CELL,
            },
        )
        self._judge_drift(evaluation)

    def _drifting(self, now_ns: int, low: np.ndarray) -> Bool[np.ndarray, " taxels"]:
        """Taxels whose own zero has moved; none before 10 s are known."""
        lows = self._lows
        lows.append((now_ns, low))
        while now_ns - lows[0][0] > DRIFT_NS:
            lows.popleft()
        if now_ns - lows[0][0] < DRIFT_NS - MAX_STEP_NS:
            return np.zeros(self._layout.num_taxels, dtype=np.bool_)
        rows_kpa = (np.stack([row for _, row in lows]) - self._tare_counts) / (
            self._gain_counts_per_kpa
        )
        rest_kpa = rows_kpa.min(axis=0)
        rest_kpa -= np.median(rest_kpa)
        below_kpa = np.median(rows_kpa, axis=0) - np.median(rows_kpa)
        moved = (rest_kpa >= CONTACT_THRESHOLD_KPA) | (below_kpa <= -CONTACT_THRESHOLD_KPA)
        still = np.abs(rest_kpa) < CONTACT_THRESHOLD_KPA / 2
        return moved & (neighbour_share(still, self._layout) >= STRONG_SHARE)

    def _judge_drift(self, evaluation: Evaluation) -> None:
        """Common offset of the taxels at rest; none while much of the hand is touched."""
        offsets = self._recent.mean(axis=0) - self._tare_counts
        drift_counts = float(np.median(offsets))
        touched = np.abs(offsets - drift_counts) > CONTACT_THRESHOLD_KPA * self._gain_counts_per_kpa
        if touched.mean() <= MAX_TOUCHED_SHARE:
            drift = evaluation.figures["baseline_drift_ratio"] = (
                abs(drift_counts) / self._sigma_counts
            )
            text = f"the zero has moved by {drift_counts:+.1f} counts since the tare; tare again"
            evaluation.judge("baseline", drift, text)

    def _part(self, taxels: np.ndarray) -> str | None:
        """Name of a pad or scan line that consists of such taxels only."""
        for pad, start in zip(self._layout.pads, self._layout.starts, strict=True):
            if taxels[start : start + pad.num_taxels].all():
                return "the whole palm" if pad.part == "palm" else "a whole fingertip"
        if self._layout is not DEXTOUCH_V1:
            # How another glove is scanned is not known.
            return None
        rows, columns = np.divmod(self._indices, _SCAN_COLUMNS)
        for word, lines in (("row", rows), ("column", columns)):
            empty = np.setdiff1d(lines, lines[~taxels])
            if len(empty):
                return f"scan {word} {empty[0]}"
        return None


def cell_judge(decoder: Decoder, calibration: Mapping[str, Matrix]) -> "CellCheck | None":
    """The check of the cells that a decoder reads; None where it tells of none.

    `<stream>_cells` (1 x taxels) of the calibration gives for each taxel the number of its cell, -1
    for none. Without it the layout of the stream does, if there is one.

    Raises:
        InvalidInputError: the grid is not that of a sample, or the map names a cell that the glove
            has not.
        NotFoundError: the map is of another size.
    """
    layout = decoder.cells
    if layout is None:
        return None
    (descriptor,) = decoder.descriptors
    num_cells = math.prod(descriptor.shape)
    if layout.grid is not None and math.prod(layout.grid) != num_cells:
        raise InvalidInputError(
            f"{descriptor.device}: got cells on a grid of {layout.grid} in a sample of {num_cells} "
            "numbers, expected as many; fix the driver of this glove"
        )
    cells = mapped_cells(descriptor, calibration)
    used = None if cells is None else np.isin(np.arange(num_cells), cells[cells != NO_CELL])
    return CellCheck(layout, used, cells, descriptor.layout)


class CellCheck(_PressureCheck):
    """Checks the cells of another manufacturer's glove.

    On a known grid, or on the pads of a known layout, a cell is silent when it does not change
    while its neighbours move: dead at rest, stuck under load. Without them, a loaded cell is stuck
    when it does not change for 5 s while three quarters of the loaded cells do. Cells that no taxel
    uses tell of their neighbours and are not judged themselves.

    Args:
        layout: full scale and grid of its cells.
        used: which of them measure a taxel; None where no map tells.
        taxel_cells: the cell of each taxel, -1 for none; None where no map tells.
        pads: layout of the taxels; None where neighbours are those of the grid.
    """

    def __init__(
        self,
        layout: CellLayout,
        used: Bool[np.ndarray, " cells"] | None = None,
        taxel_cells: Int64[np.ndarray, " taxels"] | None = None,
        pads: TactileLayout | None = None,
    ) -> None:
        super().__init__(layout.full_scale, "cells")
        self._full_scale, self._grid, self.used = layout.full_scale, layout.grid, used
        self._taxel_cells, self._pads = taxel_cells, pads
        self._lowest = self._highest = np.full(1, np.nan)

    def _readings(self, values: np.ndarray) -> np.ndarray:
        rows = values.reshape(len(values), -1).astype(np.float64)
        self._lowest = np.fmin(self._lowest, np.fmin.reduce(rows, axis=0))
        self._highest = np.fmax(self._highest, np.fmax.reduce(rows, axis=0))
        return rows

    def _judge(self, evaluation: Evaluation, low: np.ndarray, high: np.ndarray) -> None:
        exists, last = np.isfinite(self._lowest), self._recent[-1]
        margin = LOADED_SHARE * self._full_scale
        if self._grid is None and self._pads is None:
            exists &= self._highest > self._lowest
            loaded = last > self._lowest + margin
            dead, stuck = np.zeros_like(exists), self._stuck(loaded)
        else:
            # The rest level of a cell that was faulty from the start is unknown: use the median.
            rest = float(np.median(self._lowest[exists])) if exists.any() else 0.0
            loaded = last > rest + margin
            moved = (high - low >= MOVED_SHARE * self._full_scale) & exists
            around = self._around(moved, exists)
            silent = self._find_silent(high == low, np.where(exists, around, 0.0))
            dead, stuck = silent & ~loaded, silent & loaded
        # This maker's NaN says that there is no cell: none may come and go.
        judged = exists if self.used is None else exists & self.used
        gone, saturated = judged & np.isnan(self._recent).any(axis=0), self._saturated()
        num_cells, num_gone = max(1, int(judged.sum())), int(gone.sum())
        found = {
            "taxels_dead": dead & judged & ~gone,
            "taxels_stuck": stuck & judged & ~saturated,
            "taxels_saturated": saturated & judged,
        }
        self._report(evaluation, found, num_cells)
        if self._taxel_cells is not None:
            states: dict[TaxelState, np.ndarray] = {"gone": gone}
            states |= {state: found[f"taxels_{state}"] for state in PINNED_STATES}
            self._mark(evaluation, states, self._taxel_cells)
            if (absent := np.flatnonzero(self._taxel_cells == NO_CELL)).size:
                evaluation.taxels["absent"] = tuple(absent.tolist())
        if num_gone:
            is_error = num_gone / num_cells >= CODES["nan"].error
            text = f"{num_gone} cells without a number"
            evaluation.findings.append(Finding("nan", "ERROR" if is_error else "WARN", text))
        evaluation.suspicious |= bool(((low >= self._top) & judged & ~saturated).any())

    def _around(self, moved: np.ndarray, exists: np.ndarray) -> Float64[np.ndarray, " cells"]:
        """Share of the neighbours that moved, of each cell."""
        pads, cells = self._pads, self._taxel_cells
        if pads is None or cells is None:
            return share_around(moved.reshape(self._grid), exists.reshape(self._grid)).ravel()
        there = cells != NO_CELL
        around = np.zeros(len(moved))
        shares = neighbour_share(moved[cells] & there, pads, exists[cells] & there)
        around[cells[there]] = shares[there]
        return around

    def _stuck(self, loaded: np.ndarray) -> np.ndarray:
        quiet, num_loaded = self._quiet(), int(loaded.sum())
        num_moving = int((loaded & ~quiet).sum())
        others_move = num_loaded >= MIN_LOADED and num_moving >= STRONG_SHARE * num_loaded
        return loaded & quiet & others_move


def count_taxels(
    low_counts: np.ndarray,
    high_counts: np.ndarray,
    *,
    side: Side,
    layout: TactileLayout = DEXTOUCH_V1,
) -> dict[str, int]:
    """How many taxels are out by the least and greatest counts [cells] of a whole take.

    Without a tare a taxel that reads 0 throughout is dead where the others rest above 0. One that
    never changed although its neighbours moved is dead, too, or stuck where it stayed more than
    `MOVED_COUNTS` above the median taxel's least reading.

    Returns:
        Numbers of `dead_taxels`, `stuck_taxels` and `saturated_taxels`.
    """
    indices = layout.raw_indices(side)
    low, high = low_counts[indices].astype(np.int64), high_counts[indices].astype(np.int64)
    around = neighbour_share(high - low >= MOVED_COUNTS, layout)
    saturated = low >= SATURATED_SHARE * layout.full_scale
    silent = (high == low) & (around >= STRONG_SHARE) & ~saturated
    zero = (high == 0) & (np.median(low) >= MIN_TARE_COUNTS)
    loaded = low > np.median(low) + MOVED_COUNTS
    dead = zero | (silent & ~loaded)
    found = {"dead": dead, "stuck": silent & loaded, "saturated": saturated}
    return {f"{word}_taxels": int(taxels.sum()) for word, taxels in found.items()}


def _latest_ns(flags: np.ndarray, t_ns: np.ndarray, before_ns: np.ndarray) -> np.ndarray:
    """When each cell was flagged last; what it was before where it is not flagged now."""
    last_ns = t_ns[len(t_ns) - 1 - np.argmax(flags[::-1], axis=0)]
    return np.where(flags.any(axis=0), last_ns, before_ns)
