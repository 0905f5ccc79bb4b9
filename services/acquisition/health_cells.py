"""Health check of pressure cells without a tare: dead, stuck, saturated or gone.

`CellHistory` serves all gloves; `CellJudge` checks those of other manufacturers, which have no
known tare: cells that are stuck, saturated, or missing. A position that never had a reading is not
a cell. If the layout is unknown, a cell that never changed may be an unused position.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Shaped

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix
from services.acquisition.drivers.base import Decoder, TellsCells
from services.acquisition.health_blocks import Block
from services.acquisition.health_levels import Verdict, above
from services.acquisition.schemas import Code, HealthFinding

# In the calibration's map, of a taxel that no cell measures.
NO_CELL = -1
RECENT_NS = 500_000_000
MIN_RECENT_SPAN_NS = 400_000_000
QUIET_NS = 5_000_000_000
SATURATED_NS = 1_000_000_000
SATURATED_SHARE = 0.995
# Any cell is worth a word; 5 % of them are an error.
SHARE_LIMITS = (0.0, 0.05)
# So many of the neighbours must move: at once for a quick verdict, within 5 s for a slow one.
STRONG_SHARE = 0.75
WEAK_SHARE = 0.5
# Shares of full scale: what counts as moving, and what as loaded.
MOVED_SHARE = 0.01
LOADED_SHARE = 0.05
# With fewer loaded cells than these, nothing can be said about one of them.
MIN_LOADED = 8
_NEVER = np.iinfo(np.int64).max


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


@dataclass(frozen=True)
class Cells:
    """Cells of a glove of another manufacturer.

    `grid` are rows and columns in which its cells lie, None where nothing tells; `used` says which
    of them measure a taxel, None where no map tells.
    """

    full_scale: float
    grid: tuple[int, int] | None
    used: Bool[np.ndarray, " cells"] | None = None


def cells_of(decoder: Decoder, calibration: Mapping[str, Matrix]) -> Cells | None:
    """What is known of the cells that a decoder reads; None where it tells of none.

    Args:
        decoder: of a device with one stream.
        calibration: of the station; `<stream>_cells` (1 x 320) gives for each taxel the number of
            its cell, -1 for none.

    Raises:
        InvalidInputError: the grid is not that of a sample, or the map names a cell that the glove
            has not.
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
    return Cells(layout.full_scale, layout.grid, _used_cells(decoder, calibration))


def _used_cells(
    decoder: Decoder, calibration: Mapping[str, Matrix]
) -> Bool[np.ndarray, " cells"] | None:
    (descriptor,) = decoder.descriptors
    num_cells, name = math.prod(descriptor.shape), f"{descriptor.name}_cells"
    if name not in calibration:
        return None
    cells = np.array(calibration[name], dtype=np.float64).ravel()
    wrong = (cells != np.rint(cells)) | (cells < NO_CELL) | (cells >= num_cells)
    if wrong.any():
        taxel = int(np.argmax(wrong))
        raise InvalidInputError(
            f"calibration {name!r}: got {cells[taxel]:g} for taxel {taxel}, expected a whole "
            f"number -1 … {num_cells - 1}, the cell of the {descriptor.side} glove that measures it"
        )
    used = np.zeros(num_cells, dtype=np.bool_)
    used[cells[cells != NO_CELL].astype(np.int64)] = True
    return used


class CellJudge:
    """Checks the cells of another manufacturer's glove.

    On a known grid a cell is silent when it does not change while its neighbours move: dead at
    rest, stuck under load. Without one, a loaded cell is stuck when it does not change for 5 s
    while three quarters of the loaded cells do. Cells that no taxel uses tell of their neighbours
    and are not judged themselves.

    Args:
        cells: what is known of the glove.
    """

    def __init__(self, cells: Cells) -> None:
        self._full_scale = cells.full_scale
        self._grid = cells.grid
        self._used = cells.used
        self._history = CellHistory(cells.full_scale)
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
        judged = exists if self._used is None else exists & self._used
        gone = judged & np.isnan(history.recent).any(axis=0)
        num_cells = max(1, int(judged.sum()))
        found: dict[Code, tuple[np.ndarray, str]] = {
            "taxels_dead": (dead & judged & ~gone, "dead"),
            "taxels_stuck": (stuck & judged & ~saturated, "stuck"),
            "taxels_saturated": (saturated & judged, "saturated"),
            "nan": (gone, "without a number"),
        }
        findings: tuple[HealthFinding, ...] = ()
        figures: dict[str, float] = {}
        for code, (cells, word) in found.items():
            count = int(cells.sum())
            findings += above(code, count / num_cells, SHARE_LIMITS, f"{count} cells {word}")
            if code != "nan":
                figures[f"{word}_taxels_ratio"] = count / num_cells
        return Verdict(findings, figures, self._is_waiting(judged & ~saturated))

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

    def _is_waiting(self, judged: np.ndarray) -> bool:
        low, _ = self._history.extremes()
        pinned = low >= SATURATED_SHARE * self._full_scale
        return bool((pinned & judged).any())


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
