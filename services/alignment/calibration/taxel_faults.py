"""Taxels of a take that are unusable, and why, by the readings of the take itself.

Calibration refuses taxels before a take; these fail during it.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.errors import InvalidInputError
from services.alignment.calibration.tactile_tare import (
    ABSENT,
    BELOW_TARE,
    DEAD,
    OK,
    RANDOM,
    REASONS,
    STUCK,
    TactileCalibration,
)

# A cell that never moves is dead if it rests further than this from its tare.
DEAD_OFFSET_KPA = 1.0
MIN_SAMPLES_TO_JUDGE = 30
# A cell without a reading in more samples than this is refused; else those samples are left out.
MAX_MISSING = 0.1
# Readings that scatter by more, and are no nearer to the ones before than to any other.
MIN_RANDOM_KPA = 5.0
MIN_RANDOM_RATIO = 0.5
MAX_RESTING_SHARE = 0.2
# Samples that are judged together (5 s of our gloves), and the share of such windows of a take that
# touch alone never makes random; chosen: one in ten.
RANDOM_WINDOW = 300
MIN_RANDOM_SHARE = 0.1
# How many times more than independent taxels those of a glove may move together.
MAX_COMMON_RATIO = 10.0
# More taxels than this that are random, or below their tare: the glove or its tare is wrong.
MAX_WRONG_TAXELS = 0.5
MARGIN_COUNTS = 1.5
# So many samples at rest show a taxel's noise, and so many equal ones in a row that it has none any
# more: several times as many as ever before.
MIN_REST_SAMPLES = 100
MIN_ENDED_SAMPLES = 300
ENDED_RATIO = 5.0
# Fingertips press with up to some 1000 kPa.
MAX_PRESSURE_KPA = 5000.0


def unusable_taxels(
    calibration: TactileCalibration, pieces: Iterable[np.ndarray]
) -> UInt8[np.ndarray, " taxels"]:
    """Why each taxel of a take is unusable, index into `REASONS`; 0 if usable.

    In addition to those that the glove's calibration refuses: cells that are constant but not at
    their tare (dead at zero, stuck elsewhere), or become so during the take; cells whose readings
    are random, or below the tare for most of the time; and cells that are NaN in more than a tenth
    of the samples.

    Args:
        calibration: of the glove.
        pieces: consecutive raw readings [T, cells] of the take.

    Raises:
        InvalidInputError: more than half of the taxels are random, dead, stuck or below their
            tare, or some read more than any finger presses.
        ShapeError: not [T, cells].
    """
    reasons, take = calibration.state.copy(), _TaxelTake(calibration)
    for counts in pieces:
        take.add(calibration.taxels(counts).astype(np.float64))
    if take.num_samples < MIN_SAMPLES_TO_JUDGE:
        return reasons
    take.check_pressures()
    for reason, taxels in take.faults().items():
        reasons[(reasons == OK) & taxels] = reason
    for reason, what, advice in (
        (RANDOM, "have nothing to do with the ones before", "check cable, port and protocol"),
        (DEAD, "are zero throughout or from some moment on", "check cable and power"),
        (STUCK, "never change, or no more from some moment on", "restart the glove"),
        (BELOW_TARE, "lie below their tare", "tare the glove again"),
    ):
        share = float((reasons == reason)[calibration.state == OK].mean())
        if share > MAX_WRONG_TAXELS:
            raise InvalidInputError(
                f"{calibration.side} glove: readings of {share:.0%} of its taxels {what}; {advice}",
                fault=REASONS[reason],
            )
    return reasons


class _TaxelTake:
    """Sums over the readings of a take, from which faults of its taxels follow."""

    def __init__(self, calibration: TactileCalibration) -> None:
        self._glove = calibration
        # Gloves of few bits round their tare and their readings to whole counts.
        self._margin = np.maximum(
            DEAD_OFFSET_KPA * calibration.gain_counts_per_kpa, MARGIN_COUNTS * calibration.step
        )
        self.num_samples, num_taxels = 0, len(calibration.cells)
        self._last = np.full(num_taxels, np.nan)
        self._low = np.full(num_taxels, np.inf)
        self._high = -self._low
        self._num_windows = 0
        zeros = np.zeros((6, num_taxels))
        self._finite, self._below, self._rest, self._kept, self._longest, self._random = zeros

    def add(self, counts: Float64[np.ndarray, "time taxels"]) -> None:
        """The next readings."""
        if not len(counts):
            return
        offsets = counts - self._glove.tare_counts
        steps = np.diff(counts, axis=0, prepend=self._last[None])
        # Readings that are missing hide no others.
        self._low = np.fmin(self._low, np.fmin.reduce(counts, axis=0))
        self._high = np.fmax(self._high, np.fmax.reduce(counts, axis=0))
        self._finite += np.isfinite(counts).sum(axis=0)
        self._below += (offsets < -self._margin).sum(axis=0)
        self._rest += (np.abs(offsets) < self._margin).sum(axis=0)
        self._note_equal(steps == 0)
        for first in range(0, len(counts), RANDOM_WINDOW):
            self._note_random(offsets[first : first + RANDOM_WINDOW])
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
        found &= variance > (MIN_RANDOM_KPA * self._glove.gain_counts_per_kpa) ** 2
        # What taps returns to rest, and what vibrates moves its neighbours alike.
        found &= (np.abs(offsets) < self._margin).mean(axis=0) < MAX_RESTING_SHARE
        common2 = float((steps.mean(axis=1) ** 2).mean())
        self._random += found & (common2 < MAX_COMMON_RATIO * steps2.mean() / steps2.size)
        self._num_windows += 1

    def check_pressures(self) -> None:
        """Refuse readings that no finger gives, as a gain per Pa makes them."""
        glove = self._glove
        offsets_kpa = (self._high - glove.tare_counts) / glove.gain_counts_per_kpa
        highest_kpa = float(np.sort(offsets_kpa[glove.state == OK])[-3:].min())
        if highest_kpa > MAX_PRESSURE_KPA:
            raise InvalidInputError(
                f"{glove.side} glove: three taxels read {highest_kpa:.3g} kPa or more, expected at "
                f"most {MAX_PRESSURE_KPA:g} kPa; its gain looks like counts/Pa: calibrate it again",
                fault="unit",
            )

    def faults(self) -> dict[int, Bool[np.ndarray, " taxels"]]:
        """Taxels by reason; of several reasons the first one counts."""
        n, offset = self.num_samples, self._last - self._glove.tare_counts
        silent = (self._low == self._high) & (np.abs(offset) > self._margin)
        is_below = self._below > n / 2
        silent |= self._ended() & ~(is_below & (self._last != 0))
        return {
            ABSENT: 1.0 - self._finite / n > MAX_MISSING,
            RANDOM: self._random > MIN_RANDOM_SHARE * self._num_windows,
            DEAD: silent & (self._last == 0),
            BELOW_TARE: is_below,
            STUCK: silent,
        }

    def _ended(self) -> Bool[np.ndarray, " taxels"]:
        """Taxels that keep a reading to the end which no pressure gives, or that lost their noise.

        A stream that is frozen as a whole, and readings at full scale, are none of these.
        """
        offset = self._last - self._glove.tare_counts
        below = (self._kept >= MIN_SAMPLES_TO_JUDGE) & (offset < -self._margin)
        least = np.maximum(MIN_ENDED_SAMPLES, ENDED_RATIO * self._longest)
        rested = self._rest - np.where(np.abs(offset) < self._margin, self._kept, 0)
        quiet = (self._kept >= least) & (rested >= MIN_REST_SAMPLES)
        ended = (below | quiet) & (self._last < np.nanmax(self._high))
        return ended & (ended.mean() <= MAX_WRONG_TAXELS)
