"""Heat map of one hand's taxels, seen from the palm side."""

import numpy as np
from jaxtyping import Float32, UInt8

from dextouch.tactile.layout import PALM_SHAPE, Side, split_pads

# Top-left cell of each pad for a right hand seen from its palm: fingers up, thumb to the right.
_CANVAS_SHAPE = (28, 26)
_PALM_ORIGIN = (13, 0)
_TIP_ORIGINS = ((8, 21), (3, 13), (0, 9), (2, 5), (5, 0))
# Colour map: dark blue, violet, orange, pale yellow.
_RAMP = np.array([(13, 17, 40), (92, 32, 110), (226, 92, 44), (255, 240, 170)], dtype=np.float64)
_EMPTY = np.array((247, 247, 245), dtype=np.uint8)


def hand_canvas(taxels: np.ndarray, *, side: Side) -> Float32[np.ndarray, "28 26"]:
    """Taxels [320] laid out as a hand on a 28×26 grid; cells without a taxel are NaN."""
    tips, palm = split_pads(np.asarray(taxels, dtype=np.float32))
    canvas = np.full(_CANVAS_SHAPE, np.nan, dtype=np.float32)
    # Radial is on the right of a right palm, while arrays run from radial to ulnar.
    row, column = _PALM_ORIGIN
    canvas[row : row + PALM_SHAPE[0], column : column + PALM_SHAPE[1]] = palm[:, ::-1]
    for tip, (row, column) in zip(tips, _TIP_ORIGINS, strict=True):
        canvas[row : row + 4, column : column + 4] = tip[:, ::-1]
    return canvas if side == "right" else canvas[:, ::-1]


def colour(values_kpa: np.ndarray, *, full_scale_kpa: float = 40.0) -> UInt8[np.ndarray, "*s 3"]:
    """Map pressures to RGB on a square-root scale, which shows light touch; NaN is background."""
    values = np.asarray(values_kpa, dtype=np.float64)
    level = np.sqrt(np.clip(np.nan_to_num(values) / full_scale_kpa, 0.0, 1.0)) * (len(_RAMP) - 1)
    left = np.minimum(level.astype(int), len(_RAMP) - 2)
    weight = (level - left)[..., None]
    rgb = ((1 - weight) * _RAMP[left] + weight * _RAMP[left + 1]).astype(np.uint8)
    rgb[np.isnan(values)] = _EMPTY
    return rgb
