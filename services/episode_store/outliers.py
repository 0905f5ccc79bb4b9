"""Outliers among items of the same task, by robust z-scores of their figures.

The score is 0.6745 (x − median) / MAD, and items above 3.5 are outliers (Iglewicz and Hoaglin, How
to Detect and Handle Outliers, 1993).
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.schemas import Finding
from services.episode_store.figures import FIGURES, Figure

# MAD of a normal distribution with standard deviation 1 (Iglewicz and Hoaglin, section 3.3).
MAD_OF_SIGMA: Final = 0.6745
MAX_SCORE: Final = 3.5
# Median and MAD of fewer values say little about what is usual.
MIN_ITEMS: Final = 8


def robust_scores(
    values: Float64[np.ndarray, " n"], *, resolution: float
) -> Float64[np.ndarray, " n"]:
    """Deviations from the median in robust standard deviations, at least `resolution` each."""
    deviations = values - np.median(values)
    sigma = float(np.median(np.abs(deviations))) / MAD_OF_SIGMA
    return deviations / max(sigma, resolution)


def find_outliers(items: Sequence[Mapping[str, float]]) -> list[list[Finding]]:
    """Findings of each item of one task; none where fewer than MIN_ITEMS have a figure."""
    found: list[list[Finding]] = [[] for _ in items]
    for figure in FIGURES:
        owners = [place for place, figures in enumerate(items) if figure.name in figures]
        if len(owners) < MIN_ITEMS:
            continue
        values = np.array([items[place][figure.name] for place in owners])
        scores = robust_scores(values, resolution=figure.resolution)
        for place, value, score in zip(owners, values.tolist(), scores.tolist(), strict=True):
            if _is_outlier(figure, score):
                found[place].append(_finding(figure, value, float(np.median(values)), score))
    return found


def _is_outlier(figure: Figure, score: float) -> bool:
    if figure.bad == "both":
        return abs(score) > MAX_SCORE
    return (score if figure.bad == "high" else -score) > MAX_SCORE


def _finding(figure: Figure, value: float, median: float, score: float) -> Finding:
    text = f"{figure.label} {figure.text(value)}, usually {figure.text(median)}"
    return Finding(
        code="outlier", message=text, figure=figure.name, value=value, median=median, score=score
    )
