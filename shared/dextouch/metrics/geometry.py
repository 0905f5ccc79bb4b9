"""Errors of predicted depth images."""

import numpy as np

from dextouch.errors import InvalidInputError, ShapeError


def depth_error(*, predicted_m: np.ndarray, true_m: np.ndarray) -> float:
    """AbsRel after alignment of the scale: mean of abs(s p - t) / t, s = median(t) / median(p).

    One scale for all depths [..., h, w] together. Pixels without depth on either side (infinite) do
    not count.

    Raises:
        ShapeError: different shapes.
        InvalidInputError: no pixel with two positive depths.
    """
    p, t = np.asarray(predicted_m, dtype=np.float64), np.asarray(true_m, dtype=np.float64)
    if p.shape != t.shape:
        raise ShapeError(f"depths: got shapes {p.shape} and {t.shape}, expected the same")
    valid = np.isfinite(p) & np.isfinite(t)
    if not valid.any() or p[valid].min() <= 0 or t[valid].min() <= 0:
        raise InvalidInputError("depths: expected at least one pixel, and positive depths (m)")
    p, t = p[valid], t[valid]
    scale = np.median(t) / np.median(p)
    return float(np.mean(np.abs(scale * p - t) / t))
