"""Validation of array pairs before they are compared."""

import numpy as np
from jaxtyping import Float64

from dextouch.errors import NonFiniteError, ShapeError


def checked_pair(
    first: np.ndarray, second: np.ndarray, *, what: str, tail: tuple[int | None, ...]
) -> tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]:
    """Validate two arrays of equal shape and return them as float64.

    `tail` are the expected last axes; None stands for any length of at least one.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape:
        raise ShapeError(f"{what}: got shapes {a.shape} and {b.shape}, expected the same shape")
    fits = a.ndim >= len(tail) and all(
        want is None or got == want
        for got, want in zip(a.shape[a.ndim - len(tail) :], tail, strict=True)
    )
    if not fits or a.size == 0:
        expected = ", ".join("n" if n is None else str(n) for n in tail)
        raise ShapeError(f"{what}: got shape {a.shape}, expected [..., {expected}] and not empty")
    for side, values in (("first", a), ("second", b)):
        num_bad = int(np.count_nonzero(~np.isfinite(values)))
        if num_bad:
            raise NonFiniteError(
                f"{what}: {num_bad} values of the {side} array are NaN or infinite; "
                "leave them out before comparing",
                num_bad=num_bad,
            )
    return a, b
