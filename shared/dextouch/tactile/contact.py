"""Contact of taxels, and normal forces on fingertips and palm, integrated from their pressures."""

from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.tactile.layout import FINGERS, NUM_TAXELS, split_pads, taxel_areas_m2

CONTACT_THRESHOLD_KPA = 2.0
PADS: Final = (*FINGERS, "palm")
_PASCAL_PER_KPA: Final = 1000.0


def in_contact(tactile_kpa: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Mask of taxels in contact: pressure of at least 2 kPa. NaN is not contact."""
    return np.asarray(tactile_kpa) >= CONTACT_THRESHOLD_KPA


def pad_forces_n(tactile_kpa: np.ndarray) -> Float64[np.ndarray, "time 6"]:
    """Normal force (N) on thumb … little fingertip and palm: pressure times area.

    Only taxels in contact count (`in_contact`), so that noise of the others does not add up.

    Args:
        tactile_kpa: [T, 320], anatomical order.

    Raises:
        ShapeError: not [T, 320].
        NonFiniteError: NaN or infinity; a taxel that was not measured is zero.
    """
    kpa = np.asarray(tactile_kpa, dtype=np.float64)
    if kpa.ndim != 2 or kpa.shape[1] != NUM_TAXELS:
        raise ShapeError(f"pad forces: got shape {kpa.shape}, expected [T, {NUM_TAXELS}]")
    if not np.isfinite(kpa).all():
        raise NonFiniteError("pad forces: taxels hold NaN or infinity; set unmeasured ones to zero")
    forces = np.where(in_contact(kpa), kpa, 0.0) * taxel_areas_m2() * _PASCAL_PER_KPA
    tips, palm = split_pads(forces)
    return np.concatenate([tips.sum(axis=(2, 3)), palm.sum(axis=(1, 2))[:, None]], axis=1)
