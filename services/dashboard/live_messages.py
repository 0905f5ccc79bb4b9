"""Binary messages of live taxels and poses, and the layout by which the page draws them."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from pydantic_core import to_json

from dextouch.hands import CHAINS, WRIST_NODE, chain_indices
from dextouch.tactile import CONTACT_THRESHOLD_KPA, colour, hand_canvas
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, SIDES, Side, raw_indices

# Of the taxel maps.
FULL_SCALE_KPA = 40.0
RAMP_STEPS = 128
# First byte of a binary message.
TAXEL_MESSAGE, POSE_MESSAGE = 1, 2


def skeleton_bones() -> list[tuple[int, int]]:
    """Pairs of keypoints that a bone connects, from `dextouch.hands`."""
    chains = [[WRIST_NODE, *chain_indices(chain)] for chain in CHAINS]
    return [bone for chain in chains for bone in pairwise(chain)]


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
        "num_raw_cells": NUM_RAW_TAXELS,
        "raw_cells": {s: raw_indices(side=s).tolist() for s in SIDES},
        "ramp": colour(pressures_kpa, full_scale_kpa=FULL_SCALE_KPA).tolist(),
        "full_scale_kpa": FULL_SCALE_KPA,
        "contact_kpa": CONTACT_THRESHOLD_KPA,
    }


def taxel_message(side: Side, pressures_kpa: np.ndarray | None) -> bytes:
    """Encode pressures: uint8 kind, uint8 side, uint16 count, then float32 kPa, little endian.

    None, of a glove that is not heard, has the count 0: an old picture must not stay.
    """
    values = np.empty(0) if pressures_kpa is None else pressures_kpa
    header = bytes([TAXEL_MESSAGE, SIDES.index(side)]) + len(values).to_bytes(2, "little")
    return header + np.ascontiguousarray(values, dtype="<f4").tobytes()


def pose_message(ages_s: Mapping[str, float | None], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Encode poses: uint8 kind, uint8 0, uint16 length of a list in JSON, the list, float32 values.

    The list holds name, age and number of values of each stream; spaces make its length a multiple
    of 4. Streams without a pose at this moment have 0 values.
    """
    values = {name: np.ravel(arrays.get(name, ())).astype("<f4") for name in ages_s}
    rows = to_json([(name, age_s, values[name].size) for name, age_s in ages_s.items()])
    rows += b" " * (-len(rows) % 4)
    header = bytes([POSE_MESSAGE, 0]) + len(rows).to_bytes(2, "little")
    return header + rows + b"".join(part.tobytes() for part in values.values())
