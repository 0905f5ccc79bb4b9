"""Test of residuals for structure that a fitted model leaves, such as a trend over the image.

Independent errors leave as much in any direction of the residuals as in any other. A model that
does not fit leaves more in those of a few smooth functions, of the place in the image for instance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.special import fdtrc

# Directions of which the fitted unknowns leave less than this say nothing of their own.
MIN_INDEPENDENCE = 1e-4
# Fitted unknowns may be nearly the same, of which a fit makes use to the last digit.
MIN_INDEPENDENCE_OF_FITTED = 1e-10


class Structure(NamedTuple):
    """How much of the residuals some functions explain.

    Attributes:
        ratio: mean square of what they explain over that of the rest, both by degree of freedom;
            about 1 for independent errors (an F statistic).
        p_value: how probable so large a ratio is for independent Gaussian errors.
        explained: sum of squares that they explain.
        rest: mean square of what they do not, by each of its `freedom` degrees of freedom.
        coefficients: of the functions, by least squares.
        remaining: residuals that they do not explain.
    """

    ratio: float
    p_value: float
    explained: float
    rest: float
    freedom: int
    coefficients: Float64[np.ndarray, " m"]
    remaining: Float64[np.ndarray, " n"]


def structure(
    residuals: Float64[np.ndarray, " n"],
    fitted: Float64[np.ndarray, "n p"],
    functions: Float64[np.ndarray, "n m"],
    *,
    num_others: int = 0,
    num_together: float = 1.0,
) -> Structure:
    """Test whether functions explain residuals of a fit better than chance.

    Args:
        residuals: of one size of error each (whitened).
        fitted: how the residuals change with the unknowns that were fitted.
        functions: what the residuals might follow.
        num_others: unknowns that were fitted, too, and of which nothing is left in all three.
        num_together: how many errors in turn are alike, and count as one.
    """
    U, s, _ = np.linalg.svd(fitted / _lengths(fitted), full_matrices=False)
    Q = U[:, s > MIN_INDEPENDENCE_OF_FITTED]
    lengths = _lengths(functions)
    own = functions / lengths
    own, left = own - Q @ (Q.T @ own), residuals - Q @ (Q.T @ residuals)
    U, s, Vt = np.linalg.svd(own, full_matrices=False)
    U, s, Vt = (part[s > MIN_INDEPENDENCE] for part in (U.T, s, Vt))
    along = U @ left
    explained, num = float(along @ along), len(s)
    freedom = max(len(residuals) - num_others - Q.shape[1] - num, 1)
    rest = max(float(left @ left) - explained, np.finfo(float).tiny) / freedom
    ratio = explained / max(num, 1) / rest / num_together
    p_value = float(fdtrc(max(num, 1), freedom / num_together, ratio))
    return Structure(
        ratio, p_value, explained, rest, freedom, (Vt.T @ (along / s)) / lengths, left - U.T @ along
    )


def _lengths(columns: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
