"""Share of the neighbours of pressure cells for which something holds, on pads and grids."""

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.tactile.layout import join_pads, split_pads


def neighbour_share(moved: Bool[np.ndarray, "320"]) -> Float64[np.ndarray, "320"]:
    """Share of the up to 8 neighbours on its pad that moved, for each taxel."""
    tips, palm = (share_around(pads, np.ones_like(pads)) for pads in split_pads(moved))
    return join_pads(tips, palm)


def share_around(moved: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Share of the up to 8 existing neighbours that moved, of each cell [..., rows, columns].

    A cell that moved exists.
    """
    edges = [(0, 0)] * (moved.ndim - 2) + [(1, 1), (1, 1)]
    padded = np.pad(np.stack([moved, exists]).astype(np.float64), [(0, 0), *edges])
    blocks = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(-2, -1))
    num_moved, num = blocks.sum(axis=(-2, -1)) - blocks[..., 1, 1]
    return num_moved / np.maximum(num, 1.0)
