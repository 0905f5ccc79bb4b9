"""Finds taxels whose readings cannot be true, and samples that a glove repeats."""

from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.streams.repeats import Implausible, implausible_repeats
from dextouch.streams.taxel_blocks import TaxelBlocks, drifting_taxels
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout

# A cell that never moves is dead if it rests further than this from its tare.
DEAD_OFFSET_KPA: Final = 1.0
MIN_SAMPLES_TO_JUDGE: Final = 30
# A cell without a reading in more samples than this is refused; else those samples are left out.
MAX_MISSING: Final = 0.1
# Readings that scatter by more, and are no nearer to the ones before than to any other.
MIN_RANDOM_KPA: Final = 5.0
MIN_RANDOM_RATIO: Final = 0.5
MAX_RESTING_SHARE: Final = 0.2
# Samples that are judged together (5 s of our gloves), and the share of such windows of a take that
# touch alone never makes random; chosen: one in ten.
RANDOM_WINDOW: Final = 300
MIN_RANDOM_SHARE: Final = 0.1
# How many times more than independent taxels those of a glove may move together.
MAX_COMMON_RATIO: Final = 10.0
MARGIN_COUNTS: Final = 1.5
# So many samples at rest show a taxel's noise, and so many equal ones in a row that it has none any
# more: several times as many as ever before.
MIN_REST_SAMPLES: Final = 100
MIN_ENDED_SAMPLES: Final = 300
ENDED_RATIO: Final = 5.0
# Readings of zero that come and go: a loose contact.
MAX_DIPS_SHARE: Final = 0.02
# Readings that turn back in so many of the samples are noisy, and so many taxels of a noisy glove.
MIN_NOISE_SHARE: Final = 0.2
NOISY_TAXELS: Final = 0.5
# A taxel is deaf that stays the same within noise in almost all of so many windows in which so many
# of its neighbours moved by more, and in almost all of the take. What is hard has gaps as sharp as
# that (between two ridges, inside a ring), but its outlines are as sharp: half of the taxels beside
# it, of whose neighbours fewer moved, stay the same as well. Of what spreads by half a taxel 8 %
# do.
MIN_MOVE_KPA: Final = 5.0
MAX_SILENT_KPA: Final = 0.5
NEIGHBOUR_SHARE: Final = 0.75
MIN_ASKED: Final = 2
SILENT_SHARE: Final = 0.95
BESIDE_SHARES: Final = (0.25, 0.6)
MAX_SHARP_SHARE: Final = 0.5


def neighbour_share(
    moved: Bool[np.ndarray, " taxels"],
    layout: TactileLayout = DEXTOUCH_V1,
    exists: Bool[np.ndarray, " taxels"] | None = None,
) -> Float64[np.ndarray, " taxels"]:
    """Share of each taxel's up to 8 neighbours, of those that exist, on its pad that moved."""
    others = np.ones_like(moved) if exists is None else exists
    stacks = zip(layout.split(moved), layout.split(others), strict=True)
    return layout.join([share_around(*stack) for stack in stacks])


def share_around(moved: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Share of the existing neighbours that moved, of each cell [..., rows, columns]."""
    edges = [(0, 0)] * (moved.ndim - 2) + [(1, 1), (1, 1)]
    padded = np.pad(np.stack([moved, exists]).astype(np.float64), [(0, 0), *edges])
    blocks = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(-2, -1))
    num_moved, num = blocks.sum(axis=(-2, -1)) - blocks[..., 1, 1]
    return num_moved / np.maximum(num, 1.0)


class TaxelFaults:
    """Sums over readings of a glove, from which faults of its taxels follow.

    Args:
        tare_counts: of each taxel.
        gain_counts_per_kpa: of each taxel.
        usable: taxels that are judged at all; None of all.
        step: smallest difference of two readings.
        layout: of the taxels.
    """

    def __init__(
        self,
        tare_counts: Float64[np.ndarray, " taxels"],
        gain_counts_per_kpa: Float64[np.ndarray, " taxels"],
        *,
        usable: Bool[np.ndarray, " taxels"] | None = None,
        step: float = 1.0,
        layout: TactileLayout = DEXTOUCH_V1,
    ) -> None:
        self._tare, self._gain, self._layout = tare_counts, gain_counts_per_kpa, layout
        self._usable = np.ones(len(tare_counts), dtype=bool) if usable is None else usable
        # Gloves of few bits round their tare and their readings to whole counts.
        self._margin = np.maximum(DEAD_OFFSET_KPA * self._gain, MARGIN_COUNTS * step)
        self.num_samples, num_taxels = 0, len(tare_counts)
        self._last = np.full(num_taxels, np.nan)
        self._low = np.full(num_taxels, np.inf)
        self._high = -self._low
        self._num_windows = 0
        self._keys: list[np.ndarray] = []
        self._taxel_keys = np.zeros(num_taxels, dtype=np.uint64)
        self._zeros_kpa: list[float] = []
        self.blocks = TaxelBlocks(
            gain_counts_per_kpa, usable=self._usable, step=step, layout=layout
        )
        zeros = np.zeros((11, num_taxels))
        self._finite, self._below, self._rest, self._kept, self._longest, self._random = zeros[:6]
        self._turns, self._dips, self._asked, self._silent, self._moved = zeros[6:]
        self._num_beside = self._num_silent_beside = 0

    def add(self, counts: Float64[np.ndarray, "time taxels"]) -> None:
        """The next readings; nothing is judged of a glove without a usable taxel."""
        if not len(counts) or not self._usable.any():
            return
        offsets = counts - self._tare
        steps = np.diff(counts, axis=0, prepend=self._last[None])
        # Readings that are missing hide no others.
        self._low = np.fmin(self._low, np.fmin.reduce(counts, axis=0))
        self._high = np.fmax(self._high, np.fmax.reduce(counts, axis=0))
        self._finite += np.isfinite(counts).sum(axis=0)
        below = offsets < -self._margin
        self._below += below.sum(axis=0)
        is_zero = below & (counts <= 0)
        self._dips += (is_zero[1:] & ~is_zero[:-1]).sum(axis=0)
        # Samples that repeat the one before hide no turn.
        moves = steps[(np.abs(steps) > 0).any(axis=1)]
        self._turns += (moves[1:] * moves[:-1] < 0).sum(axis=0)
        self._note_keys(counts)
        self._rest += (np.abs(offsets) < self._margin).sum(axis=0)
        self._note_equal(steps == 0)
        for first in range(0, len(counts), RANDOM_WINDOW):
            window = offsets[first : first + RANDOM_WINDOW]
            self._note_random(window)
            self._note_silent(window)
        self.blocks.add(counts, offsets)
        self._last = counts[-1]
        self.num_samples += len(counts)

    def _note_equal(self, equal: Bool[np.ndarray, "time taxels"]) -> None:
        """Count equal readings in a row: the longest row that ended, and the one that has not."""
        at = np.arange(len(equal))[:, None]
        # Of each reading the last one before or at it that was new; before this block if negative.
        new = np.maximum.accumulate(np.where(equal, -1.0 - self._kept, at), axis=0)
        runs = at - new
        ended = np.concatenate([self._kept[None], runs[:-1]])[~equal]
        columns = np.broadcast_to(np.arange(equal.shape[1]), equal.shape)[~equal]
        np.maximum.at(self._longest, columns, ended)
        self._kept = runs[-1]

    def _note_random(self, offsets: Float64[np.ndarray, "time taxels"]) -> None:
        """Count taxels whose readings have nothing to do with those before, nor with others'."""
        if len(offsets) < MIN_SAMPLES_TO_JUDGE:
            return
        known = np.isfinite(offsets)
        some = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, offsets, 0.0).sum(axis=0) / some
        around = np.where(known, offsets - mean, 0.0)
        # A step beside a reading that is missing is none.
        steps = np.where(known[1:] & known[:-1], np.diff(around, axis=0), 0.0)
        variance, steps2 = (around**2).sum(axis=0) / some, (steps**2).mean(axis=0)
        # Of independent readings the mean square of a step is twice the variance.
        found = steps2 > MIN_RANDOM_RATIO * 2 * variance
        found &= variance > (MIN_RANDOM_KPA * self._gain) ** 2
        # What taps returns to rest, and what vibrates moves its neighbours alike.
        found &= (np.abs(offsets) < self._margin).mean(axis=0) < MAX_RESTING_SHARE
        common2 = float((steps.mean(axis=1) ** 2).mean())
        self._random += found & (common2 < MAX_COMMON_RATIO * steps2.mean() / steps2.size)
        self._num_windows += 1

    def _note_keys(self, counts: Float64[np.ndarray, "time taxels"]) -> None:
        """Sums that are equal for equal samples, and for taxels with equal readings throughout."""
        rng = np.random.default_rng(self.num_samples)
        bits = np.ascontiguousarray(counts).view(np.uint64)
        # Of whole numbers only the upper bits are used.
        bits = bits ^ (bits >> np.uint64(33))
        factors = rng.integers(1, 2**63, len(counts), dtype=np.uint64) | np.uint64(1)
        self._taxel_keys += (bits * factors[:, None]).sum(axis=0, dtype=np.uint64)
        places = np.random.default_rng(0).integers(1, 2**63, bits.shape[1], dtype=np.uint64)
        self._keys.append((bits * (places | np.uint64(1))).sum(axis=1, dtype=np.uint64))

    def _note_silent(self, offsets: Float64[np.ndarray, "time taxels"]) -> None:
        """Count windows in which a taxel or its neighbours move, and how sharp contacts are."""
        if len(offsets) < MIN_SAMPLES_TO_JUDGE:
            return
        range_kpa = np.ptp(np.nan_to_num(offsets), axis=0) / self._gain
        moved = range_kpa >= MIN_MOVE_KPA
        around = neighbour_share(moved, self._layout)
        asked = around >= NEIGHBOUR_SHARE
        self._asked += asked
        self._silent += asked & (range_kpa < MAX_SILENT_KPA)
        self._moved += range_kpa >= MAX_SILENT_KPA
        # A taxel that moves alone is no contact.
        around = neighbour_share(moved & (around > 0), self._layout)
        beside = (around > BESIDE_SHARES[0]) & (around < BESIDE_SHARES[1])
        beside_kpa = range_kpa[beside & self._usable & ~moved]
        self._num_beside += len(beside_kpa)
        self._num_silent_beside += int((beside_kpa < MAX_SILENT_KPA).sum())
        lows_kpa = np.sort((np.nan_to_num(offsets).min(axis=0) / self._gain)[self._usable])
        # What presses on the hand leaves one of ten taxels alone.
        self._zeros_kpa.append(float(lows_kpa[len(lows_kpa) // 10]))

    @property
    def zero_kpa(self) -> Float64[np.ndarray, " windows"]:
        """By how much even the least pressed taxels are above their tare, by windows of 5 s."""
        return np.array(self._zeros_kpa)

    def highest_kpa(self) -> Float64[np.ndarray, " taxels"]:
        """Highest pressure of each taxel."""
        return np.asarray((self._high - self._tare) / self._gain)

    def repeats(self) -> list[Implausible]:
        """Samples that the device repeats, if its readings are noisy."""
        n = self.num_samples
        dithered = self.blocks.dithered()
        if dithered.any():
            text = f"readings stay within a count of the same in {dithered.sum()} samples"
            return [Implausible("frozen", text, dithered, harmless=not self.blocks.num_moved)]
        if n < MIN_SAMPLES_TO_JUDGE:
            return []
        keys = np.concatenate(self._keys)
        is_new = np.append(True, keys[1:] != keys[:-1])
        turns = self._turns[self._usable]
        if (turns > MIN_NOISE_SHARE * is_new.sum()).mean() <= NOISY_TAXELS:
            return []
        halves = np.stack([keys >> np.uint64(32), keys & np.uint64(2**32 - 1)], axis=1)
        rows = halves.astype(np.float64)
        return list(implausible_repeats(rows, what="readings", is_noisy=True))

    def faults(self) -> dict[str, Bool[np.ndarray, " taxels"]]:
        """Taxels by reason; of several reasons the first one counts."""
        n, offset = self.num_samples, self._last - self._tare
        silent = (self._low == self._high) & (np.abs(offset) > self._margin)
        is_below = self._below > n / 2
        silent |= self._ended() & ~(is_below & (self._last != 0))
        is_loose = (self._dips > MAX_DIPS_SHARE * n) & ~is_below
        is_still = self._moved <= (1 - SILENT_SHARE) * self._num_windows
        is_deaf = is_still & (self._asked >= MIN_ASKED)
        is_deaf &= self._silent >= SILENT_SHARE * self._asked
        is_deaf &= self._num_silent_beside <= MAX_SHARP_SHARE * self._num_beside
        return {
            "absent": 1.0 - self._finite / n > MAX_MISSING,
            "random": (self._random > MIN_RANDOM_SHARE * self._num_windows) | is_loose,
            "copied": self._copied(),
            "dead": (silent & (self._last == 0)) | is_deaf,
            "below_tare": is_below,
            "stuck": silent,
            "saturated": self.blocks.clipped(),
            "drifting": drifting_taxels(self.blocks.lows_kpa, self._usable, self._layout),
        }

    def _ended(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels that keep a reading to the end which no pressure gives, or lost their noise."""
        last = np.concatenate(self._keys[-2:])[-2:]
        if len(last) == 2 and last[0] == last[1]:
            return np.zeros(len(self._last), dtype=bool)
        offset = self._last - self._tare
        below = (self._kept >= MIN_SAMPLES_TO_JUDGE) & (offset < -self._margin)
        least = np.maximum(MIN_ENDED_SAMPLES, ENDED_RATIO * self._longest)
        rested = self._rest - np.where(np.abs(offset) < self._margin, self._kept, 0)
        quiet = (self._kept >= least) & (rested >= MIN_REST_SAMPLES)
        ended = (below | quiet) & (self._last < np.nanmax(self._high))
        return np.asarray(ended)

    def _copied(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels with the readings of another one throughout, although these are noisy."""
        _, inverse, counts = np.unique(self._taxel_keys, return_inverse=True, return_counts=True)
        return (counts[inverse] > 1) & (self._turns > MIN_NOISE_SHARE * self.num_samples)
