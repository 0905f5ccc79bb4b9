"""Health checks of pressure cells: dead, stuck, saturated, drifting or gone.

A cell that does not change is not necessarily faulty, because a hand at rest looks the same. It is
reported if its neighbours change while it does not, or if no load explains its reading.
`TaxelJudge` checks our own glove by its tare. `CellJudge` checks gloves of other manufacturers,
which have none: a position that never had a reading is not a cell, and if the layout is unknown, a
cell that never changed may be an unused position.
"""

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Shaped

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import NUM_TAXELS, Side, join_pads, raw_indices, split_pads
from services.acquisition.devices.tactile_glove.driver import FULL_SCALE_COUNTS
from services.acquisition.drivers.base import CellLayout, Decoder, TellsCells
from services.acquisition.glove_record import NO_CELL, GloveRecord, mapped_cells
from services.acquisition.health.codes import CODES
from services.acquisition.health.levels import Finding, Verdict, find
from services.acquisition.health.samples import Block

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
_NEVER = np.iinfo(np.int64).max
MOVED_KPA = 1.0
# About as much, where the glove's gain is not known.
MOVED_COUNTS = 40
NOTHING_SHARE = 0.5
MIN_TARE_COUNTS = 20.0
# A tare without a stated scatter is good to one count.
TARE_SIGMA_COUNTS = 1.0
MAX_TOUCHED_SHARE = 0.25
_SCAN_COLUMNS = 20


class CellHistory:
    """State of each cell from all blocks so far, and the rows of the last 0.5 s.

    Args:
        full_scale: the largest reading.
    """

    def __init__(self, full_scale: float) -> None:
        self._pinned_at = SATURATED_SHARE * full_scale
        self.t_ns = 0
        self.recent_ns = np.empty(0, dtype=np.int64)
        self.recent = np.empty((0, 0))
        self.last = np.empty(0)
        self.changed_ns = np.empty(0, dtype=np.int64)
        self.around_ns = np.empty(0, dtype=np.int64)
        self._pinned_ns = np.empty(0, dtype=np.int64)
        self.silent = np.empty(0, dtype=np.bool_)

    @property
    def is_enough(self) -> bool:
        """Whether there is enough data for a verdict."""
        known = self.recent_ns
        return len(known) > 0 and bool(known[-1] - known[0] >= MIN_RECENT_SPAN_NS)

    def add(self, values: Shaped[np.ndarray, "n cells"], t_ns: np.ndarray) -> None:
        """Add the readings of a block, one row per sample; NaN is no reading."""
        if not len(t_ns):
            return
        if not len(self.last):
            self._start(values, int(t_ns[0]))
        changed = np.diff(values, axis=0, prepend=self.last[None]) != 0
        latest_ns = t_ns[len(t_ns) - 1 - np.argmax(changed[::-1], axis=0)]
        self.changed_ns = np.where(changed.any(axis=0), latest_ns, self.changed_ns)
        self.silent = self.silent & ~changed.any(axis=0)
        self.last = values[-1]
        self._note_pinned(~(values >= self._pinned_at), t_ns)
        all_ns = np.concatenate([self.recent_ns, t_ns])
        rows = np.concatenate([self.recent, values])
        kept = all_ns >= all_ns[-1] - RECENT_NS
        self.recent_ns, self.recent = all_ns[kept], rows[kept]
        self.t_ns = int(all_ns[-1])

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest reading of each cell within the last 0.5 s; NaN where one was."""
        return self.recent.min(axis=0), self.recent.max(axis=0)

    def saturated(self) -> Bool[np.ndarray, " cells"]:
        """Cells at full scale for longer than a second."""
        return self._pinned_ns <= self.t_ns - SATURATED_NS

    def find_silent(self, around: Float64[np.ndarray, " cells"]) -> None:
        """Mark cells that stay at one reading while enough of their neighbours move.

        A cell stays marked until it changes.

        Args:
            around: share of its neighbours that moved within the last 0.5 s.
        """
        low, high = self.extremes()
        self.around_ns = np.where(around >= WEAK_SHARE, self.t_ns, self.around_ns)
        quick = (high == low) & (around >= STRONG_SHARE)
        quiet = self.changed_ns <= self.t_ns - QUIET_NS
        slow = quiet & (self.around_ns >= self.changed_ns + RECENT_NS)
        self.silent = self.silent | quick | slow

    def _start(self, values: np.ndarray, t_ns: int) -> None:
        num_cells = values.shape[1]
        self.last = values[0]
        self.recent = np.empty((0, num_cells), dtype=values.dtype)
        self.changed_ns = np.full(num_cells, t_ns, dtype=np.int64)
        self.around_ns = np.zeros(num_cells, dtype=np.int64)
        self._pinned_ns = np.full(num_cells, _NEVER, dtype=np.int64)
        self.silent = np.zeros(num_cells, dtype=np.bool_)

    def _note_pinned(self, below: np.ndarray, t_ns: np.ndarray) -> None:
        # Where the present run at the top began: after the last reading below it.
        index = len(t_ns) - np.argmax(below[::-1], axis=0)
        began_ns = t_ns[np.minimum(index, len(t_ns) - 1)]
        whole_block_ns = np.minimum(self._pinned_ns, t_ns[0])
        began_ns = np.where(below.any(axis=0), began_ns, whole_block_ns)
        self._pinned_ns = np.where(below[-1], _NEVER, began_ns)


class TaxelJudge:
    """Checks the 320 taxels of our own glove from its raw counts.

    Args:
        record: calibration of the glove.
    """

    def __init__(self, record: GloveRecord) -> None:
        self._indices = record.cells
        self._lines = self._indices // _SCAN_COLUMNS, self._indices % _SCAN_COLUMNS
        self._tare_counts = record.tare_counts[self._indices]
        self._gain_counts_per_kpa = record.gain_counts_per_kpa[self._indices]
        sigma_counts = float(np.median(record.tare_sigma_counts[self._indices]))
        self._sigma_counts = max(TARE_SIGMA_COUNTS, sigma_counts)
        self._history = CellHistory(float(FULL_SCALE_COUNTS))

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del now_ns
        history, tare = self._history, self._tare_counts
        if block.values is not None and len(block):
            counts = block.values[:, self._indices].astype(np.int64)
            history.add(counts, block.t_host_ns)
        if not history.is_enough:
            return Verdict()
        moved_counts = MOVED_KPA * self._gain_counts_per_kpa
        low, high = history.extremes()
        history.find_silent(neighbour_share(high - low >= moved_counts))
        at_top = low >= SATURATED_SHARE * FULL_SCALE_COUNTS
        nothing = (tare >= MIN_TARE_COUNTS) & (high < NOTHING_SHARE * tare)
        loaded = history.last > tare + moved_counts
        saturated = history.saturated()
        found = {
            "taxels_dead": nothing | (history.silent & ~loaded),
            "taxels_stuck": history.silent & loaded & ~at_top,
            "taxels_saturated": saturated,
        }
        counted = _verdict(found, NUM_TAXELS, "taxels")
        parts = {code: whole_part(taxels, self._lines) for code, taxels in found.items()}
        findings = [
            Finding(code, "ERROR", f"{part} {_word(code)}") for code, part in parts.items() if part
        ]
        findings += [finding for finding in counted.findings if not parts[finding.code]]
        drift = self._judge_drift()
        waiting = bool((at_top & ~saturated).any())
        figures = {**counted.figures, **drift.figures}
        return Verdict((*findings, *drift.findings), figures, waiting)

    def _judge_drift(self) -> Verdict:
        """Common offset of the taxels at rest; none while much of the hand is touched."""
        offsets = self._history.recent.mean(axis=0) - self._tare_counts
        drift_counts = float(np.median(offsets))
        touched = np.abs(offsets - drift_counts) > CONTACT_THRESHOLD_KPA * self._gain_counts_per_kpa
        if touched.mean() > MAX_TOUCHED_SHARE:
            return Verdict()
        drift = abs(drift_counts) / self._sigma_counts
        text = f"the zero has moved by {drift_counts:+.1f} counts since the tare; tare again"
        return Verdict(find("baseline", drift, text), {"baseline_drift_ratio": drift})


def cell_judge(decoder: Decoder, calibration: Mapping[str, Matrix]) -> "CellJudge | None":
    """The check of the cells that a decoder reads; None where it tells of none.

    Args:
        decoder: of a device with one stream.
        calibration: of the station; `<stream>_cells` (1 x 320) gives for each taxel the number of
            its cell, -1 for none.

    Raises:
        InvalidInputError: the grid is not that of a sample, or the map names a cell that the glove
            has not.
        NotFoundError: the map is of another size.
    """
    if not isinstance(decoder, TellsCells):
        return None
    (descriptor,) = decoder.descriptors
    layout, num_cells = decoder.cells, math.prod(descriptor.shape)
    if layout.grid is not None and math.prod(layout.grid) != num_cells:
        raise InvalidInputError(
            f"{descriptor.device}: got cells on a grid of {layout.grid} in a sample of {num_cells} "
            "numbers, expected as many; fix the driver of this glove"
        )
    cells = mapped_cells(descriptor, calibration)
    if cells is None:
        return CellJudge(layout)
    used = np.zeros(num_cells, dtype=np.bool_)
    used[cells[cells != NO_CELL]] = True
    return CellJudge(layout, used)


class CellJudge:
    """Checks the cells of another manufacturer's glove.

    On a known grid a cell is silent when it does not change while its neighbours move: dead at
    rest, stuck under load. Without one, a loaded cell is stuck when it does not change for 5 s
    while three quarters of the loaded cells do. Cells that no taxel uses tell of their neighbours
    and are not judged themselves.

    Args:
        layout: full scale and grid of its cells.
        used: which of them measure a taxel; None where no map tells.
    """

    def __init__(self, layout: CellLayout, used: Bool[np.ndarray, " cells"] | None = None) -> None:
        self._full_scale, self._grid, self.used = layout.full_scale, layout.grid, used
        self._history = CellHistory(layout.full_scale)
        self._lowest = np.empty(0)
        self._highest = np.empty(0)

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del now_ns
        history = self._history
        if block.values is not None and len(block):
            values = block.values.reshape(len(block), -1).astype(np.float64)
            history.add(values, block.t_host_ns)
            self._remember(values)
        if not history.is_enough:
            return Verdict()
        exists = np.isfinite(self._lowest)
        margin = LOADED_SHARE * self._full_scale
        if self._grid is None:
            exists &= self._highest > self._lowest
            loaded = history.last > self._lowest + margin
            dead, stuck = np.zeros_like(exists), self._stuck(loaded)
        else:
            # The rest level of a cell that was faulty from the start is unknown: use the median.
            rest = float(np.median(self._lowest[exists])) if exists.any() else 0.0
            loaded = history.last > rest + margin
            history.find_silent(self._moved_around(exists, self._grid))
            dead, stuck = history.silent & ~loaded, history.silent & loaded
        saturated = history.saturated()
        # This maker's NaN says that there is no cell: none may come and go.
        judged = exists if self.used is None else exists & self.used
        gone = judged & np.isnan(history.recent).any(axis=0)
        num_cells = max(1, int(judged.sum()))
        found = {
            "taxels_dead": dead & judged & ~gone,
            "taxels_stuck": stuck & judged & ~saturated,
            "taxels_saturated": saturated & judged,
        }
        counted = _verdict(found, num_cells, "cells")
        findings, num_gone = counted.findings, int(gone.sum())
        if num_gone:
            is_error = num_gone / num_cells >= CODES["nan"].error
            level: Literal["WARN", "ERROR"] = "ERROR" if is_error else "WARN"
            findings += (Finding("nan", level, f"{num_gone} cells without a number"),)
        low, _ = history.extremes()
        pinned = low >= SATURATED_SHARE * self._full_scale
        waiting = bool((pinned & judged & ~saturated).any())
        return Verdict(findings, counted.figures, waiting)

    def _remember(self, values: np.ndarray) -> None:
        if not len(self._lowest):
            self._lowest = np.full(values.shape[1], np.nan)
            self._highest = self._lowest
        self._lowest = np.fmin(self._lowest, np.fmin.reduce(values, axis=0))
        self._highest = np.fmax(self._highest, np.fmax.reduce(values, axis=0))

    def _stuck(self, loaded: np.ndarray) -> np.ndarray:
        history = self._history
        quiet = history.changed_ns <= history.t_ns - QUIET_NS
        num_loaded = int(loaded.sum())
        others_move = num_loaded >= MIN_LOADED and (loaded & ~quiet).sum() >= (
            STRONG_SHARE * num_loaded
        )
        return loaded & quiet & others_move

    def _moved_around(self, exists: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
        low, high = self._history.extremes()
        moved = high - low >= MOVED_SHARE * self._full_scale
        there = exists.reshape(grid).astype(np.float64)
        count = sum_around(there) - there
        moving = (moved & exists).reshape(grid).astype(np.float64)
        around = (sum_around(moving) - moving) / np.maximum(count, 1.0)
        return np.where(exists, around.ravel(), 0.0)


def _word(code: str) -> str:
    return code.removeprefix("taxels_")


def _verdict(found: Mapping[str, np.ndarray], num_cells: int, noun: str) -> Verdict:
    """Share of the cells that each code was found in."""
    findings: tuple[Finding, ...] = ()
    for code, cells in found.items():
        count = int(cells.sum())
        findings += find(code, count / num_cells, f"{count} {noun} {_word(code)}")
    figures = {f"{_word(code)}_taxels_ratio": c.sum() / num_cells for code, c in found.items()}
    return Verdict(findings, {name: float(ratio) for name, ratio in figures.items()})


def count_taxels(low_counts: np.ndarray, high_counts: np.ndarray, *, side: Side) -> dict[str, int]:
    """How many taxels are out by the least and greatest counts [360] of a whole take.

    Without a tare a taxel that reads 0 throughout is dead where the others rest above 0. One that
    never changed although its neighbours moved is dead, too, or stuck where it stayed more than
    `MOVED_COUNTS` above the median taxel's least reading.

    Returns:
        Numbers of `dead_taxels`, `stuck_taxels` and `saturated_taxels`.
    """
    indices = raw_indices(side=side)
    low, high = low_counts[indices].astype(np.int64), high_counts[indices].astype(np.int64)
    around = neighbour_share(high - low >= MOVED_COUNTS)
    saturated = low >= SATURATED_SHARE * FULL_SCALE_COUNTS
    silent = (high == low) & (around >= STRONG_SHARE) & ~saturated
    zero = (high == 0) & (np.median(low) >= MIN_TARE_COUNTS)
    loaded = low > np.median(low) + MOVED_COUNTS
    dead = zero | (silent & ~loaded)
    found = {"dead": dead, "stuck": silent & loaded, "saturated": saturated}
    return {f"{word}_taxels": int(taxels.sum()) for word, taxels in found.items()}


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


def sum_around(grid: np.ndarray) -> np.ndarray:
    """Sum of the 3 by 3 cells around each of a grid [..., rows, columns], itself included."""
    rows, columns = grid.shape[-2:]
    padded = np.zeros((*grid.shape[:-2], rows + 2, columns + 2))
    padded[..., 1:-1, 1:-1] = grid
    total = np.zeros_like(grid)
    for row in range(3):
        for column in range(3):
            total += padded[..., row : row + rows, column : column + columns]
    return total
