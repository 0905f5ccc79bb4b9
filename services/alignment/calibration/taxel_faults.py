"""Taxels of a take that are unusable, and why, by the readings of the take itself.

Calibration refuses taxels before a take; these fail during it.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

from dextouch.errors import InvalidInputError
from dextouch.streams import MIN_SAMPLES_TO_JUDGE, TaxelFaults
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.alignment.calibration.tactile_tare import (
    BELOW_TARE,
    COPIED,
    DEAD,
    OK,
    RANDOM,
    REASONS,
    STUCK,
    TactileCalibration,
)

# More taxels than this that are random, or below their tare: the glove or its tare is wrong.
MAX_WRONG_TAXELS = 0.5
# Fingertips press with up to some 1000 kPa.
MAX_PRESSURE_KPA = 5000.0
# No hand is pressed by so much everywhere; less is reported.
MAX_ZERO_KPA = 100.0


def taxel_faults(
    calibration: TactileCalibration,
    pieces: Iterable[np.ndarray],
    layout: TactileLayout = DEXTOUCH_V1,
) -> TaxelFaults:
    """What consecutive raw readings [T, cells] of a take say of its taxels.

    Raises ShapeError: not [T, cells].
    """
    take = TaxelFaults(
        calibration.tare_counts,
        calibration.gain_counts_per_kpa,
        usable=calibration.state == OK,
        step=calibration.step,
        layout=layout,
    )
    for counts in pieces:
        take.add(calibration.taxels(counts).astype(np.float64))
    return take


def unusable_taxels(
    calibration: TactileCalibration, take: TaxelFaults
) -> UInt8[np.ndarray, " taxels"]:
    """Why each taxel of a take is unusable, index into `REASONS`; 0 if usable.

    Besides those that the calibration refuses: cells that are constant but not at their tare, also
    from some moment on (dead at zero, stuck elsewhere), random, those of another cell, mostly below
    the tare, the same within noise while those around them move, or NaN in more than a tenth of the
    samples. Raises InvalidInputError: more than half of the taxels are random, copied, dead, stuck
    or below their tare, some read more than any finger presses, or all more than their tare.
    """
    reasons = calibration.state.copy()
    if take.num_samples < MIN_SAMPLES_TO_JUDGE:
        return reasons
    _check_pressures(calibration, take)
    for fault, taxels in take.faults().items():
        reasons[(reasons == OK) & taxels] = REASONS.index(fault)
    for reason, what, advice in (
        (RANDOM, "have nothing to do with the ones before", "check cable, port and protocol"),
        (DEAD, "are zero throughout or from some moment on", "check cable and power"),
        (COPIED, "are those of others", "check cable and firmware"),
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


def _check_pressures(glove: TactileCalibration, take: TaxelFaults) -> None:
    """Refuse readings that no finger gives, as a gain per Pa or another tare make them."""
    highest_kpa = float(np.sort(take.highest_kpa()[glove.state == OK])[-3:].min())
    if highest_kpa > MAX_PRESSURE_KPA:
        raise InvalidInputError(
            f"{glove.side} glove: three taxels read {highest_kpa:.3g} kPa or more, expected at "
            f"most {MAX_PRESSURE_KPA:g} kPa; its gain looks like counts/Pa: calibrate it again",
            fault="unit",
        )
    zero_kpa = float(np.median(take.zero_kpa))
    if zero_kpa > MAX_ZERO_KPA:
        raise InvalidInputError(
            f"{glove.side} glove: even its least pressed taxels read {zero_kpa:.3g} kPa for most "
            f"of the time, expected at most {MAX_ZERO_KPA:g} kPa; tare the glove again (are "
            "readings inverted?)",
            fault="baseline",
        )
