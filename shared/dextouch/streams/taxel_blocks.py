"""Figures of short blocks of a glove's readings, and the faults of many taxels that these show."""

from functools import lru_cache
from itertools import chain, permutations
from statistics import NormalDist
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.tactile.layout import CONTACT_THRESHOLD_KPA, DEXTOUCH_V1, TactileLayout

# Half a second of our gloves.
BLOCK_ROWS: Final = 30
# A frozen glove with dither: almost all taxels stay within one count of their middle, half of them
# reach both sides, and normal noise that is off by one as often would be off by two in so many
# readings. Noise of which so many are expected has fewer than 16 (5 % of the taxels may be faulty)
# with a probability of 1e-12. Where taxels at rest have such noise while others move, it is theirs.
FROZEN_TAXELS: Final = 0.95
DITHERED_TAXELS: Final = 0.5
MIN_EXPECTED: Final = 60.0
MAX_OWN_SHARE: Final = 0.1
# The zero of a pad drifts if its lows rise (or fall) by as much as a contact, of which an eighth at
# either end is not seen, little by little and alike. A contact is there within half a second, and
# presses the middle of a pad more.
ZERO_PARTS: Final = 8
MIN_DRIFT_KPA: Final = 0.75 * CONTACT_THRESHOLD_KPA
MAX_PART_OF_DRIFT: Final = 0.5
MAX_UNLIKE: Final = 0.35
# Three taxels that end at the same reading share a limit, two where converters end (2^n - 1): it is
# read in so many samples, and more often than all that is within 2 % below.
MIN_TOP_ROWS: Final = 30
MIN_TOP_SHARE: Final = 0.02
NEAR_TOP: Final = 0.98
MIN_SAME_TOPS: Final = 3
CEILINGS: Final = 2.0 ** np.arange(8, 17) - 1
# A ghost of a row: wherever that row is pressed, the other one reads the same share of it at least,
# in six columns, though what presses moves along the row, and the taxel between both reads less,
# which what presses both would press more. Next to each other nothing is between.
MIN_GHOST: Final = 0.07
MAX_GHOST: Final = 0.65
MIN_GHOST_KPA: Final = 2.5
ROUNDING_KPA: Final = 0.2
GHOST_TOLERANCE: Final = 0.15
BETWEEN: Final = 0.8
ROUNDING: Final = 0.01
GHOST_SHARE: Final = 0.7
GHOST_FOLLOWS: Final = 0.95
MIN_GHOST_COLUMNS: Final = 6
MIN_GHOST_READINGS: Final = 8
MIN_GHOST_MOVE: Final = 0.7
MAX_KEPT_ROWS: Final = 2000
KEEP_EVERY: Final = 5
_NORMAL: Final = NormalDist()
# Pressures of gains that are entered in another unit are off by its size, which gains of one kind
# of glove are not. What makes more than 3 kPa of a kPa is a pressure that was divided by its unit.
PER_UNIT_KPA: Final = {"psi": 6.895, "bar": 100.0, "MPa": 1000.0}
MAX_OFF_UNIT: Final = 1.25
# A glove of 16 bits has a full scale above 50 kPa.
MIN_FULL_SCALE_KPA: Final = 50.0


def implausible_gain(
    gain_counts_per_kpa: np.ndarray, areas_m2: np.ndarray, layout: TactileLayout = DEXTOUCH_V1
) -> str | None:
    """Why gains of some taxels with these areas are in another unit; None if they are not."""
    full_scale_kpa = layout.full_scale / float(np.median(gain_counts_per_kpa))
    ratio = full_scale_kpa / layout.range_kpa
    units = {f"counts/{name}": 1 / size for name, size in PER_UNIT_KPA.items()}
    units |= {"counts/N": float(np.median(areas_m2)) * 1e3, "psi taken for kPa": 6.895}
    unit = min(units, key=lambda name: abs(float(np.log(ratio / units[name]))))
    is_unit = max(ratio / units[unit], units[unit] / ratio) < MAX_OFF_UNIT
    if not is_unit and full_scale_kpa >= MIN_FULL_SCALE_KPA:
        return None
    return (
        f"makes {full_scale_kpa:.3g} kPa of full scale, expected about {layout.range_kpa:g} kPa; "
        f"these look like {unit}: calibrate it again"
    )


class TaxelBlocks:
    """Sums over half seconds of a glove's readings.

    Args:
        gain_counts_per_kpa: of each taxel.
        usable: taxels that are judged.
        step: smallest difference of two readings.
        layout: of the taxels.
    """

    def __init__(
        self,
        gain_counts_per_kpa: Float64[np.ndarray, " taxels"],
        *,
        usable: Bool[np.ndarray, " taxels"],
        step: float = 1.0,
        layout: TactileLayout = DEXTOUCH_V1,
    ) -> None:
        self._gain, self._usable = gain_counts_per_kpa, usable
        self._step, self._layout = step, layout
        self._dithers: list[np.ndarray] = []
        self._num_dithered = self._num_own = 0
        self._lows: list[np.ndarray] = []
        self._kept: list[np.ndarray] = []
        self._keep_every, self._num_rows = KEEP_EVERY, 0
        num_taxels = len(gain_counts_per_kpa)
        self._top = np.full(num_taxels, -np.inf)
        self._num_top, self._num_near, self._span = np.zeros((3, num_taxels))

    def add(self, counts: np.ndarray, offsets: np.ndarray) -> None:
        """The next readings [time, taxels], and by how much they are above the tare."""
        for rows in np.array_split(np.arange(len(counts)), max(1, len(counts) // BLOCK_ROWS)):
            part = slice(rows[0], rows[-1] + 1)
            kpa = offsets[part] / self._gain
            self._lows.append(np.nan_to_num(kpa).min(axis=0).astype(np.float32))
            if not self._note_dither(counts[part]):
                self._note_top(counts[part], offsets[part])
        first = -self._num_rows % self._keep_every
        self._kept.append((offsets[first :: self._keep_every] / self._gain).astype(np.float32))
        self._num_rows += len(counts)
        if sum(map(len, self._kept)) > MAX_KEPT_ROWS:
            self._kept = [np.concatenate(self._kept)[::2]]
            self._keep_every *= 2

    def _note_dither(self, counts: np.ndarray) -> bool:
        steps = counts[:, self._usable] / self._step
        low, high = steps.min(axis=0), steps.max(axis=0)
        near = high - low < 2.5
        both = near & (high - low > 1.5)
        off = np.abs(steps - (low + high) / 2)[:, both] > 0.75
        share = float(off.sum()) / max(1, near.sum() * len(steps))
        expected = 0.0
        if 0 < share < 1:
            sigma = 0.5 / _NORMAL.inv_cdf(1 - share / 2)
            expected = 2 * _NORMAL.cdf(-1.5 / sigma) * near.sum() * len(steps)
        is_bounded = expected > MIN_EXPECTED or (share == 1.0 and both.any())
        is_frozen = bool(
            is_bounded and near.mean() >= FROZEN_TAXELS and both.mean() >= DITHERED_TAXELS
        )
        self._num_dithered += is_frozen
        self._num_own += is_bounded and not is_frozen
        self._dithers.append(np.full(len(counts), is_frozen))
        return is_frozen

    def _note_top(self, counts: np.ndarray, offsets: np.ndarray) -> None:
        top = np.fmax(self._top, np.fmax.reduce(counts, axis=0))
        self._num_top[top > self._top] = 0
        self._top = top
        self._num_top += (counts == top).sum(axis=0)
        self._span = np.fmax(self._span, np.fmax.reduce(offsets, axis=0))
        self._num_near += ((counts < top) & (offsets > NEAR_TOP * self._span)).sum(axis=0)

    @property
    def lows_kpa(self) -> np.ndarray:
        """Lowest pressure of each half second and taxel [blocks, taxels]."""
        return np.stack(self._lows) if self._lows else np.zeros((0, len(self._gain)))

    def dithered(self) -> Bool[np.ndarray, " n"]:
        """Samples of a glove that is frozen but for a count."""
        found = np.concatenate(self._dithers) if self._dithers else np.zeros(0, dtype=bool)
        return found & (self._num_own <= MAX_OWN_SHARE * self._num_dithered)

    def clipped(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels whose pressures were higher than what is read, for long."""
        least = max(MIN_TOP_ROWS, MIN_TOP_SHARE * self._num_rows)
        flat = (self._num_top >= least) & (self._span > CONTACT_THRESHOLD_KPA * self._gain)
        flat &= (self._num_top > self._num_near) & self._usable
        tops, inverse, same = np.unique(self._top, return_inverse=True, return_counts=True)
        same = np.bincount(inverse, weights=flat, minlength=len(tops))
        is_limit = same >= np.where(np.isin(tops, CEILINGS), 2, MIN_SAME_TOPS)
        is_limit |= tops >= self._layout.full_scale - self._step / 2
        return np.asarray(flat & is_limit[inverse])

    def ghosts(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels of rows that hold a part of another row."""
        kpa = np.concatenate(self._kept) if self._kept else np.zeros((0, len(self._gain)))
        # The last column stands for no taxel between.
        kpa = np.pad(kpa, ((0, 0), (0, 1)), constant_values=np.inf)
        shares = [
            (_ghost_share(*(kpa[:, some] for some in rows)), rows[1])
            for rows in _pairs_of_rows(self._layout)
        ]
        found = np.zeros(len(self._gain), dtype=bool)
        for share, other in sorted(shares, key=lambda of: -of[0]):
            # Rows of a pad and scan lines have taxels in common.
            if share and not found[other].any():
                found[other] = True
        return found & self._usable


@lru_cache(maxsize=8)
def _pairs_of_rows(layout: TactileLayout) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Taxels of a row, of another one, and between both (-1 of none), of pads and scan lines."""
    stacks = layout.split(np.arange(layout.num_taxels))
    lines = [np.swapaxes(stack, 0, 1).reshape(stack.shape[1], -1) for stack in stacks]
    if layout == DEXTOUCH_V1:
        # Lines that are scanned cross the rows of the palm.
        lines.append(stacks[-1].reshape(12, 20))
    pads = np.repeat(np.arange(len(layout.pads)), [pad.num_taxels for pad in layout.pads])
    grids = np.concatenate([np.indices(pad.shape).reshape(2, -1) for pad in layout.pads], axis=1)
    at = {place: taxel for taxel, place in enumerate(zip(pads, *grids, strict=True))}
    found = []
    for one, other in chain.from_iterable(permutations(rows, 2) for rows in lines):
        middle = zip(pads[one], *((grids[:, one] + grids[:, other]) // 2), strict=True)
        between = np.array([at.get(place, -1) for place in middle])
        apart = np.abs(grids[:, other] - grids[:, one]).max(axis=0)
        found.append((one, other, np.where(apart > 1, between, -1)))
    return found


def _ghost_share(pressed: np.ndarray, ghost: np.ndarray, between: np.ndarray) -> float:
    """Which share of one row another row reads at least, whatever presses the one; 0 of none."""
    is_pressed = pressed > MIN_GHOST_KPA
    asked = is_pressed & (between < BETWEEN * ghost) & (ghost > ROUNDING_KPA)
    columns = np.flatnonzero(asked.sum(axis=0) >= MIN_GHOST_READINGS)
    if len(columns) < MIN_GHOST_COLUMNS:
        return 0.0
    ratios = np.where(asked, ghost / np.maximum(pressed, MIN_GHOST_KPA), np.nan)[:, columns]
    least = np.nanpercentile(ratios, 5, axis=0)
    share = float(np.median(least))
    if not MIN_GHOST <= share <= MAX_GHOST:
        return 0.0
    fits = np.abs(least - share) <= GHOST_TOLERANCE * share + ROUNDING
    weights = np.where(asked, pressed, 0.0)[asked.any(axis=1)]
    centres = weights @ np.arange(pressed.shape[1]) / weights.sum(axis=1)
    follows = (ghost >= share / 2 * pressed)[is_pressed].mean() >= GHOST_FOLLOWS
    enough = fits.sum() >= max(MIN_GHOST_COLUMNS, GHOST_SHARE * len(columns))
    return share if follows and enough and centres.std() >= MIN_GHOST_MOVE else 0.0


def drifting_taxels(
    lows_kpa: np.ndarray, usable: Bool[np.ndarray, " taxels"], layout: TactileLayout = DEXTOUCH_V1
) -> Bool[np.ndarray, " taxels"]:
    """Taxels of pads whose zero moves, by the lowest pressures of parts of a take [parts, taxels].

    A pad that is touched from some moment on, or as slowly as a drift in its middle, is none.
    """
    found = np.zeros(lows_kpa.shape[1], dtype=bool)
    if len(lows_kpa) < ZERO_PARTS:
        return found
    lows = np.stack([part.min(axis=0) for part in np.array_split(lows_kpa, ZERO_PARTS)])
    # What touches a pad hides its zero for a while.
    rising = np.minimum.accumulate(lows[::-1], axis=0)[::-1]
    falling = np.minimum.accumulate(lows, axis=0)
    for pad, first in zip(layout.pads, layout.starts, strict=True):
        taxels = first + np.flatnonzero(usable[first : first + pad.num_taxels])
        if len(taxels) < pad.num_taxels / 2:
            continue
        for zeros in (rising[:, taxels], falling[:, taxels]):
            steps = np.abs(np.diff(np.percentile(zeros, 25, axis=1)))
            each = np.abs(zeros[-1] - zeros[0])
            unlike = float(np.subtract(*np.percentile(each, [90, 10])))
            if (
                steps.sum() >= MIN_DRIFT_KPA
                and steps.max() <= MAX_PART_OF_DRIFT * steps.sum()
                and unlike <= MAX_UNLIKE * steps.sum()
            ):
                found[taxels] = True
    return found
