"""An episode's calibration in, which of its taxels were measured out."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from dextouch.errors import ShapeError
from dextouch.tactile.layout import NUM_TAXELS, SIDES


def measured_taxels(
    calibration: Mapping[str, Sequence[Sequence[float]]],
) -> Bool[np.ndarray, "2 320"]:
    """Taxels whose pressures were measured, left hand then right; the others read zero throughout.

    Alignment writes `tactile_<side>_refused_taxels`, 1 × 320 in anatomical order: 0, or the reason
    why the taxel is not measured. Episodes without it (of the twin, imagined ones) know all.

    Raises:
        ShapeError: a matrix that is not 1 × 320.
    """
    measured = np.ones((len(SIDES), NUM_TAXELS), dtype=np.bool_)
    for row, side in zip(measured, SIDES, strict=True):
        name = f"tactile_{side}_refused_taxels"
        if name in calibration:
            refused = np.array(calibration[name], dtype=np.float64)
            if refused.shape != (1, NUM_TAXELS):
                raise ShapeError(f"{name}: got {refused.shape}, expected (1, {NUM_TAXELS})")
            row[:] = refused[0] == 0
    return measured
