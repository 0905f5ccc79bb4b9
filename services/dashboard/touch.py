"""Touch panel: layout and colours of the taxel maps, and their live pressures as bytes."""

import numpy as np

from dextouch.tactile import CONTACT_THRESHOLD_KPA, colour, hand_canvas
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side

FULL_SCALE_KPA = 40.0
RAMP_STEPS = 128
TAXEL_MESSAGE = 1


def heatmap_layout() -> dict[str, object]:
    """Positions of the 320 taxels and the colour map, from `dextouch.tactile`."""
    taxels = np.arange(NUM_TAXELS, dtype=np.float32)
    canvases = {side: hand_canvas(taxels, side=side) for side in SIDES}
    rows, columns = canvases["right"].shape
    pressures_kpa = np.linspace(0.0, FULL_SCALE_KPA, RAMP_STEPS)
    return {
        "rows": rows,
        "columns": columns,
        # NaN sorts last: the first 320 are the cells of the taxels in their order.
        "cells": {s: np.argsort(c.ravel())[:NUM_TAXELS].tolist() for s, c in canvases.items()},
        "ramp": colour(pressures_kpa, full_scale_kpa=FULL_SCALE_KPA).tolist(),
        "full_scale_kpa": FULL_SCALE_KPA,
        "contact_kpa": CONTACT_THRESHOLD_KPA,
    }


def taxel_message(side: Side, pressures_kpa: np.ndarray) -> bytes:
    """Encode pressures: uint8 kind, uint8 side, uint16 count, then float32 kPa, little endian."""
    header = bytes([TAXEL_MESSAGE, SIDES.index(side)]) + len(pressures_kpa).to_bytes(2, "little")
    return header + np.ascontiguousarray(pressures_kpa, dtype="<f4").tobytes()
