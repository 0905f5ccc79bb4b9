"""Complete calibration of one glove: tare, gain and taxel states, as recordings carry them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.tactile.layout import (
    FINGERS,
    NUM_RAW_TAXELS,
    NUM_TAXELS,
    NUM_TIP_TAXELS,
    expand_taxels,
    raw_indices,
)
from services.alignment.calibration.tactile_faults import FULL_SCALE_COUNTS, OK, STATES
from services.alignment.calibration.tactile_gain import TaxelGain, TaxelPress, fit_gain
from services.alignment.calibration.tactile_tare import TaxelTare

# More faulty taxels than this, and the glove needs a repair, not a calibration.
MAX_FAULTY = 0.25
PADS = (*FINGERS, "palm")
_PADS = [slice(start, start + 16) for start in range(0, NUM_TIP_TAXELS, 16)] + [
    slice(NUM_TIP_TAXELS, NUM_TAXELS)
]


@dataclass(frozen=True)
class GloveCalibration:
    """Calibration of one glove; `gain` is None if only the tare was measured."""

    tare: TaxelTare
    gain: TaxelGain | None

    def matrices(self) -> dict[str, Float64[np.ndarray, "1 360"]]:
        """Matrices by their names in recordings; all in scan order.

        A taxel whose gain was refused gets the median gain of its pad, so that counts of a faulty
        taxel stay finite; `…_state` says which ones (index into `tactile_faults.STATES`). Cells
        without a taxel get the median of all.
        """
        side = self.tare.side
        found = {
            f"tactile_{side}_tare_counts": self.tare.level.mean_counts,
            f"tactile_{side}_tare_sigma_counts": self.tare.level.sigma_counts,
            f"tactile_{side}_noise_counts": self.tare.level.noise_counts,
        }
        if self.gain is not None:
            filled = filled_gain(self.gain)
            raw = np.full(NUM_RAW_TAXELS, np.median(filled))
            raw[raw_indices(side=side)] = filled
            sigma = expand_taxels(self.gain.sigma_counts_per_kpa, side=side)
            state = expand_taxels(self.gain.state, side=side)
            found |= {
                f"tactile_{side}_gain_counts_per_kpa": raw,
                f"tactile_{side}_gain_sigma_counts_per_kpa": sigma,
                f"tactile_{side}_taxel_state": state.astype(np.float64),
            }
        return {name: np.asarray(row, dtype=np.float64)[None] for name, row in found.items()}

    def num_by_state(self) -> dict[str, int]:
        """Number of taxels in each state that occurs."""
        if self.gain is None:
            return {}
        counts = np.bincount(self.gain.state, minlength=len(STATES))
        return {name: int(n) for name, n in zip(STATES, counts, strict=True) if n}


def calibrate_glove(
    tare: TaxelTare,
    presses: Sequence[TaxelPress],
    *,
    full_scale_counts: float = FULL_SCALE_COUNTS,
) -> GloveCalibration:
    """Gain and fault map of a glove, beside its tare; without presses the tare alone.

    Raises:
        InvalidInputError: as `fit_gain`, or more than a quarter of the taxels is faulty or
            was not pressed.
    """
    if not presses:
        return GloveCalibration(tare, None)
    found = GloveCalibration(tare, fit_gain(tare, presses, full_scale_counts=full_scale_counts))
    counted = found.num_by_state()
    if 1 - counted.get("ok", 0) / NUM_TAXELS > MAX_FAULTY:
        told = ", ".join(f"{number} {name}" for name, number in counted.items())
        raise InvalidInputError(
            f"glove {tare.side}: of 320 taxels {told}; expected at most {MAX_FAULTY:.0%} not ok. "
            "Unproven: press them too. Imprecise: press harder, at least 5 kPa. Saturated: press "
            "less. Nonlinear: let each press settle. Dead or stuck: repair the glove",
            num_by_state=counted,
        )
    return found


def filled_gain(gain: TaxelGain) -> Float64[np.ndarray, "320"]:
    """Gains in which refused taxels have the median of their pad, or of the glove.

    Raises:
        InvalidInputError: not one gain is known.
    """
    known = gain.state == OK
    if not known.any():
        raise InvalidInputError("glove: the gain of no taxel is known")
    filled = gain.gain_counts_per_kpa.copy()
    usual_of_all = np.median(gain.gain_counts_per_kpa[known])
    for pad in _PADS:
        mine = known[pad]
        usual = np.median(gain.gain_counts_per_kpa[pad][mine]) if mine.any() else usual_of_all
        filled[pad] = np.where(mine, filled[pad], usual)
    return filled


def pad_taxels(names: str) -> Bool[np.ndarray, "320"]:
    """Which taxels belong to pads, named with + between them, such as `thumb+index`, or `all`.

    Raises:
        UnknownNameError: no such pad.
    """
    taxels = np.zeros(NUM_TAXELS, dtype=np.bool_)
    for name in names.split("+"):
        if name == "all":
            taxels[:] = True
        elif name in PADS:
            taxels[_PADS[PADS.index(name)]] = True
        else:
            raise UnknownNameError("pad", name, [*PADS, "all"])
    return taxels
