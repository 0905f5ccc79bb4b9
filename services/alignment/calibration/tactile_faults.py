"""Detection of dead, stuck and saturated taxels in takes with contact.

A taxel is only called faulty on evidence: its neighbours (or the others under the same known
pressure) moved, and it did not. Where nothing around it moved it stays `unproven`.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from dextouch.tactile.layout import (
    NUM_FINGERTIPS,
    NUM_TAXELS,
    PALM_SHAPE,
    TIP_SHAPE,
    Side,
    select_taxels,
)
from services.alignment.calibration.tactile_tare import TaxelTare

# The largest count that our gloves can send.
FULL_SCALE_COUNTS = 65535.0
SATURATED_RATIO = 0.995
STATES = ("ok", "dead", "stuck", "saturated", "unproven", "nonlinear", "imprecise")
OK, DEAD, STUCK, SATURATED, UNPROVEN, NONLINEAR, IMPRECISE = range(len(STATES))

# Neighbours must move by this much before their stillness means anything.
MIN_MOVE_COUNTS = 10.0
MIN_MOVE_SIGMAS = 10.0
# A taxel that shows less than this part of what its neighbours show does not answer.
SILENT_RATIO = 0.1
# This part of the neighbours may be still too: one dead row crosses two of eight.
STILL_NEIGHBOURS = 0.25
MIN_EVIDENCE = 30
MIN_SILENT = 0.95
MIN_OWN_MOVES = 10
BLOCK = 600


def neighbours() -> Int64[np.ndarray, "320 8"]:
    """Taxels around each taxel on its own pad, anatomical order; −1 where there is none."""
    table = np.full((NUM_TAXELS, 8), -1, dtype=np.int64)
    steps = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
    first = 0
    for shape in [TIP_SHAPE] * NUM_FINGERTIPS + [PALM_SHAPE]:
        cells = np.full((shape[0] + 2, shape[1] + 2), -1, dtype=np.int64)
        cells[1:-1, 1:-1] = first + np.arange(shape[0] * shape[1]).reshape(shape)
        for column, (down, right) in enumerate(steps):
            around = cells[1 + down : 1 + down + shape[0], 1 + right : 1 + right + shape[1]]
            table[first : first + around.size, column] = around.ravel()
        first += shape[0] * shape[1]
    return table


_NEIGHBOURS = neighbours()
_NUM_NEIGHBOURS = (_NEIGHBOURS >= 0).sum(axis=1)


def classify_taxels(
    takes: Sequence[np.ndarray],
    tare: TaxelTare,
    *,
    full_scale_counts: float = FULL_SCALE_COUNTS,
) -> UInt8[np.ndarray, "320"]:
    """State of each taxel (index into `STATES`, anatomical order) from takes with contact.

    The takes are raw counts [T, 360] each; the rest take may be among them.
    """
    evidence, silent, moves = (np.zeros(NUM_TAXELS, dtype=np.int64) for _ in range(3))
    zero = select_taxels(tare.level.mean_counts, side=tare.side)
    needed = np.maximum(
        MIN_MOVE_SIGMAS * select_taxels(tare.level.noise_counts, side=tare.side), MIN_MOVE_COUNTS
    )
    for counts in _blocks(takes, tare.side):
        moved = np.abs(counts - zero)
        around = _least_neighbour(moved)
        told = around >= needed
        evidence += told.sum(axis=0)
        silent += (told & (moved < SILENT_RATIO * around)).sum(axis=0)
        moves += (moved >= needed).sum(axis=0)
    is_silent = (evidence >= MIN_EVIDENCE) & (silent >= MIN_SILENT * evidence)
    is_silent &= moves < MIN_OWN_MOVES
    states = np.full(NUM_TAXELS, UNPROVEN, dtype=np.uint8)
    states[(moves >= MIN_OWN_MOVES) | ((evidence >= MIN_EVIDENCE) & ~is_silent)] = OK
    states[is_silent] = kind_of_silence(takes, tare.side)[is_silent]
    states[_always_full(takes, tare.side, full_scale_counts)] = SATURATED
    return states


def kind_of_silence(takes: Sequence[np.ndarray], side: Side) -> UInt8[np.ndarray, "320"]:
    """`STUCK` for taxels that keep one value other than zero in all takes, else `DEAD`."""
    lowest = select_taxels(np.min([np.min(take, axis=0) for take in takes], axis=0), side=side)
    highest = select_taxels(np.max([np.max(take, axis=0) for take in takes], axis=0), side=side)
    return np.where((lowest == highest) & (lowest != 0), STUCK, DEAD).astype(np.uint8)


def _always_full(
    takes: Sequence[np.ndarray], side: Side, full_scale_counts: float
) -> Bool[np.ndarray, "320"]:
    lowest = np.min([np.median(take, axis=0) for take in takes], axis=0)
    return select_taxels(lowest, side=side) >= SATURATED_RATIO * full_scale_counts


def _blocks(takes: Sequence[np.ndarray], side: Side) -> Iterator[Float64[np.ndarray, "time 320"]]:
    """Pieces of the takes, since eight neighbours of every reading would not fit in memory."""
    for take in takes:
        for start in range(0, len(take), BLOCK):
            block = np.asarray(take[start : start + BLOCK], dtype=np.float64)
            yield select_taxels(block, side=side)


def _least_neighbour(moved: Float64[np.ndarray, "time 320"]) -> Float64[np.ndarray, "time 320"]:
    """Smallest change of the neighbours, excluding the quarter that changed least."""
    around = np.where(_NEIGHBOURS >= 0, moved[:, _NEIGHBOURS], np.inf)
    around.sort(axis=2)
    rank = np.floor(STILL_NEIGHBOURS * _NUM_NEIGHBOURS).astype(np.int64)
    return np.take_along_axis(around, rank[None, :, None], axis=2)[..., 0]
