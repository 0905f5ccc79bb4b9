"""PSNR (dB) and SSIM, means over 8-bit colour images, errors of depth, and the check of arrays."""

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError

PEAK = 255.0
# Cap for exact images, whose PSNR is infinite, so that means stay finite.
MAX_PSNR_DB = 100.0
SSIM_WINDOW_PX = 11
_SSIM_SIGMA_PX = 1.5


def checked_pair(
    first: np.ndarray, second: np.ndarray, *, what: str, tail: tuple[int | None, ...]
) -> tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]:
    """Two arrays of equal shape as float64; None in `tail`, the last axes, is any length."""
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


def psnr(*, predicted: np.ndarray, true: np.ndarray) -> float:
    """Mean over images of 10 log10(255² / MSE) in dB, each image capped at 100 dB.

    Images [..., h, w, 3] are in 0 … 255 (uint8, or a float that was not yet rounded). Raises
    ShapeError for different or other shapes, NonFiniteError for NaN or infinity.
    """
    a, b = checked_pair(predicted, true, what="PSNR of images", tail=(None, None, 3))
    mse = np.mean((a - b) ** 2, axis=(-3, -2, -1))
    return float(np.mean(decibels(mse, peak=PEAK)))


def decibels(mse: np.ndarray | np.floating, *, peak: float) -> Float64[np.ndarray, "*batch"]:
    """10 log10(peak² / MSE), at most 100 dB."""
    floor = peak**2 * 10 ** (-MAX_PSNR_DB / 10)
    return np.asarray(10 * np.log10(peak**2 / np.maximum(mse, floor)))


def ssim(*, predicted: np.ndarray, true: np.ndarray) -> float:
    """Mean structural similarity of images [..., h, w, 3] in 0 … 255, 1 for equal images.

    Wang et al. 2004: Gaussian window 11×11 with σ = 1.5 px, K1 = 0.01, K2 = 0.03, range 255, each
    channel separately, only where the whole window lies inside the image.

    Raises:
        ShapeError: different shapes, not [..., h, w, 3], or images smaller than the window.
        NonFiniteError: NaN or infinity.
    """
    a, b = checked_pair(predicted, true, what="SSIM of images", tail=(None, None, 3))
    if min(a.shape[-3:-1]) < SSIM_WINDOW_PX:
        raise ShapeError(
            f"SSIM of images: got {a.shape[-3]} by {a.shape[-2]} px, expected at least "
            f"{SSIM_WINDOW_PX} by {SSIM_WINDOW_PX}"
        )
    mean_a, mean_b = _smooth(a), _smooth(b)
    variances = _smooth(a * a) - mean_a**2 + (_smooth(b * b) - mean_b**2)
    covariance = _smooth(a * b) - mean_a * mean_b
    return float(np.mean(similarity((mean_a, mean_b), variances, covariance, peak=PEAK)))


def similarity(
    means: tuple[np.ndarray, np.ndarray],
    variances: np.ndarray,
    covariance: np.ndarray,
    *,
    peak: float,
) -> Float64[np.ndarray, "..."]:
    """Structural similarity of windows from their means, sums of variances, and covariances."""
    mean_a, mean_b = means
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    return (
        (2 * mean_a * mean_b + c1)
        * (2 * covariance + c2)
        / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    )


def _smooth(images: np.ndarray) -> np.ndarray:
    """Gaussian filter over rows and columns, valid region only."""
    offsets = np.arange(SSIM_WINDOW_PX) - SSIM_WINDOW_PX // 2
    kernel = np.exp(-0.5 * (offsets / _SSIM_SIGMA_PX) ** 2)
    kernel /= kernel.sum()
    for axis in (-3, -2):
        windows = np.lib.stride_tricks.sliding_window_view(images, SSIM_WINDOW_PX, axis=axis)
        images = windows @ kernel
    return images


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
