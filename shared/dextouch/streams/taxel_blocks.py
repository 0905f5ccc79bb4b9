"""Figures of short blocks of a glove's readings, and the faults of many taxels that these show."""

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
# with a probability of 1e-12. Where taxels at rest have such noise while others move, it is theirs;
# firmware that clamps noise makes it. A glove that never moved may have it.
FROZEN_TAXELS: Final = 0.95
DITHERED_TAXELS: Final = 0.5
MIN_EXPECTED: Final = 60.0
MAX_OWN_SHARE: Final = 0.1
MOVING_TAXELS: Final = 0.99
RESTING_TAXELS: Final = 0.05
# The zero of a pad drifts if its lows rise (or fall) by as much as a contact, of which an eighth at
# either end is not seen, little by little and alike. A contact is there within half a second, and
# presses the middle of a pad more. A grip that is slowly pressed harder is never let go: what
# touches a drifting pad comes and goes twice at least, and presses some taxels more than others by
# half of the drift. Pads of few taxels are always alike.
ZERO_PARTS: Final = 8
# 20 s: a glove that warms up takes minutes, and a grip seconds.
MIN_ZERO_BLOCKS: Final = 40
MIN_DRIFT_KPA: Final = 0.75 * CONTACT_THRESHOLD_KPA
MAX_PART_OF_DRIFT: Final = 0.5
MAX_UNLIKE: Final = 0.35
MIN_PAD_TAXELS: Final = 9
MIN_RELEASES: Final = 2
MIN_TOUCH_SHARE: Final = 0.5
# Taxels that share a limit end at the highest reading of all, five of them, or three where
# converters end (2^n - 1): it is read in so many samples, and more often than all within 2 % below.
# Of other readings with less than three steps there nothing is known: a steady grip is as flat.
MIN_TOP_ROWS: Final = 30
MIN_TOP_SHARE: Final = 0.02
NEAR_TOP: Final = 0.98
MIN_STEPS_NEAR_TOP: Final = 3
MIN_SAME_TOPS: Final = 5
MIN_SAME_CEILINGS: Final = 3
CEILINGS: Final = 2.0 ** np.arange(8, 17) - 1
_NORMAL: Final = NormalDist()
# Pressures of gains that are entered in another unit are off by its size, which gains of one kind
# of glove are not. What makes more than 3 kPa of a kPa is a pressure that was divided by its unit.
PER_UNIT_KPA: Final = {"psi": 6.895, "bar": 100.0, "MPa": 1000.0}
MAX_OFF_UNIT: Final = 1.25
MIN_OFF: Final = 3.0
# No grip stays below it; gloves of a smaller range have it in their layout.
MIN_FULL_SCALE_KPA: Final = 50.0


def implausible_gain(
    gain_counts_per_kpa: np.ndarray, areas_m2: np.ndarray, layout: TactileLayout = DEXTOUCH_V1
) -> str | None:
    """Why gains of some taxels with these areas are in another unit; None if they are not."""
    full_scale_kpa = layout.full_scale / float(np.median(gain_counts_per_kpa))
    ratio = full_scale_kpa / layout.range_kpa
    if 1 / MIN_OFF < ratio < MIN_OFF:
        return None
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
        self.num_moved = self.num_own = 0
        self._lows: list[np.ndarray] = []
        self._num_rows = 0
        num_taxels = len(gain_counts_per_kpa)
        self._top = np.full(num_taxels, -np.inf)
        self._least_step = np.full(num_taxels, np.inf)
        self._num_top, self._num_near, self._span = np.zeros((3, num_taxels))

    def add(self, counts: np.ndarray, offsets: np.ndarray) -> None:
        """The next readings [time, taxels], and by how much they are above the tare."""
        for rows in np.array_split(np.arange(len(counts)), max(1, len(counts) // BLOCK_ROWS)):
            part = slice(rows[0], rows[-1] + 1)
            kpa = offsets[part] / self._gain
            self._lows.append(np.nan_to_num(kpa).min(axis=0).astype(np.float32))
            if not self._note_dither(counts[part]):
                self._note_top(counts[part], offsets[part])
        self._num_rows += len(counts)

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
        is_bounded = expected > MIN_EXPECTED * near.mean() or (share == 1.0 and both.any())
        is_frozen = bool(
            is_bounded and near.mean() >= FROZEN_TAXELS and both.mean() >= DITHERED_TAXELS
        )
        self.num_moved += not is_frozen and bool(near.mean() < MOVING_TAXELS)
        self.num_own += is_bounded and not is_frozen and bool(near.mean() > RESTING_TAXELS)
        self._dithers.append(np.full(len(counts), is_frozen))
        return is_frozen

    def _note_top(self, counts: np.ndarray, offsets: np.ndarray) -> None:
        top = np.fmax(self._top, np.fmax.reduce(counts, axis=0))
        steps = np.abs(np.diff(counts, axis=0))
        least = np.fmin.reduce(steps, axis=0, where=steps > 0, initial=np.inf)
        self._least_step = np.minimum(self._least_step, least)
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
        return found & (self.num_own <= MAX_OWN_SHARE * self.num_moved)

    def follow(self, before: "TaxelBlocks") -> None:
        """Take over what an earlier part says of how the glove moves, and of its own noise."""
        self.num_moved, self.num_own = before.num_moved, before.num_own

    def clipped(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels whose pressures were higher than what is read, for long."""
        least = max(MIN_TOP_ROWS, MIN_TOP_SHARE * self._num_rows)
        flat = (self._num_top >= least) & (self._span > CONTACT_THRESHOLD_KPA * self._gain)
        flat &= (self._num_top > self._num_near) & self._usable
        is_full = self._top >= self._layout.full_scale - self._step / 2
        steps_near_top = (1 - NEAR_TOP) * self._span / self._least_step
        others = self._usable & ~is_full & np.isfinite(self._least_step)
        limit = self._top.max(where=others, initial=-np.inf)
        is_ceiling = limit in CEILINGS
        at_limit = flat & others & (self._top == limit)
        at_limit &= is_ceiling | (steps_near_top >= MIN_STEPS_NEAR_TOP)
        is_limit = at_limit.sum() >= (MIN_SAME_CEILINGS if is_ceiling else MIN_SAME_TOPS)
        return np.asarray(flat & is_full | at_limit & is_limit)


def drifting_taxels(
    lows_kpa: np.ndarray, usable: Bool[np.ndarray, " taxels"], layout: TactileLayout = DEXTOUCH_V1
) -> Bool[np.ndarray, " taxels"]:
    """Taxels of pads whose zero moves, by the lowest pressures of half seconds [parts, taxels].

    A pad is judged that is touched and let go meanwhile: else a slow grip may be all that moves it.
    """
    found = np.zeros(lows_kpa.shape[1], dtype=bool)
    if len(lows_kpa) < MIN_ZERO_BLOCKS:
        return found
    ends = np.linspace(0, len(lows_kpa) - 1, ZERO_PARTS + 1).round().astype(int)
    # What touches a pad hides its zero for a while.
    rising = np.minimum.accumulate(lows_kpa[::-1], axis=0)[::-1]
    falling = np.minimum.accumulate(lows_kpa, axis=0)
    for pad, first in zip(layout.pads, layout.starts, strict=True):
        taxels = first + np.flatnonzero(usable[first : first + pad.num_taxels])
        if len(taxels) < max(MIN_PAD_TAXELS, pad.num_taxels / 2):
            continue
        for zeros, parts in ((rising[:, taxels], ends[:-1]), (falling[:, taxels], ends[1:])):
            steps = np.abs(np.diff(np.percentile(zeros[parts], 25, axis=1)))
            each = np.abs(zeros[parts[-1]] - zeros[parts[0]])
            unlike = float(np.subtract(*np.percentile(each, [90, 10])))
            above_kpa = np.subtract(*np.percentile(lows_kpa[:, taxels] - zeros, [90, 10], axis=1))
            touched = above_kpa > max(MIN_TOUCH_SHARE * steps.sum(), CONTACT_THRESHOLD_KPA)
            if (
                steps.sum() >= MIN_DRIFT_KPA
                and steps.max() <= MAX_PART_OF_DRIFT * steps.sum()
                and unlike <= MAX_UNLIKE * steps.sum()
                and (touched[:-1] & ~touched[1:]).sum() >= MIN_RELEASES
            ):
                found[taxels] = True
    return found
