"""Tactile errors (kPa) and contact agreement of predicted taxel pressures [..., taxels].

All given samples, hands and taxels are pooled. NaN is refused, but where `measured` is false: what
was not measured counts nowhere, or, in SSIM, as right; None: all was.
"""

import numpy as np
from jaxtyping import Bool

from dextouch.metrics.image import checked_pair, decibels, similarity
from dextouch.tactile import in_contact
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout

# Reference pressure of PSNR and SSIM: the full scale of the heat maps.
PEAK_KPA = 40.0
SSIM_WINDOW_TAXELS = 4


Measured = Bool[np.ndarray, "*batch taxels"] | None


def _pair(
    predicted: np.ndarray, true: np.ndarray, what: str, measured: Measured, layout: TactileLayout
) -> tuple[np.ndarray, np.ndarray]:
    """Both as float64, 0 where nothing was measured: no contact, and no error."""
    if measured is not None:
        predicted, true = (np.where(measured, one, 0.0) for one in (predicted, true))
    return checked_pair(predicted, true, what=f"{what} of taxels", tail=(layout.num_taxels,))


def _mean(errors: np.ndarray, measured: Measured) -> float:
    if measured is None:
        return float(np.mean(errors))
    return float(np.mean(errors[measured])) if measured.any() else float("nan")


def mse(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """Mean squared error in kPa²; NaN if nothing was measured."""
    a, b = _pair(predicted_kpa, true_kpa, "MSE", measured, layout)
    return _mean((a - b) ** 2, measured)


def mae(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """Mean absolute error in kPa; NaN if nothing was measured."""
    a, b = _pair(predicted_kpa, true_kpa, "MAE", measured, layout)
    return _mean(np.abs(a - b), measured)


def psnr(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    peak_kpa: float = PEAK_KPA,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """10 log10(peak² / MSE) in dB, at most 100, of the pooled MSE, as most samples are exact."""
    a, b = _pair(predicted_kpa, true_kpa, "PSNR", measured, layout)
    return float(decibels(np.float64(_mean((a - b) ** 2, measured)), peak=peak_kpa))


def ssim(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    peak_kpa: float = PEAK_KPA,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """Mean structural similarity of the pads of a hand, 1 for equal pads.

    Computed within pads only: uniform windows of 4×4 taxels (or as large as the pad, if that is
    smaller), K1 = 0.01, K2 = 0.03, range 0 … `peak_kpa`; each pad, a finger or the palm, has the
    same weight. An untouched pad predicted as untouched scores 1.
    """
    a, b = _pair(predicted_kpa, true_kpa, "SSIM", measured, layout)
    total = 0.0
    for stack_a, stack_b in zip(layout.split(a), layout.split(b), strict=True):
        total += stack_a.shape[-3] * float(np.mean(_pad_similarity(stack_a, stack_b, peak_kpa)))
    return total / len(layout.pads)


def _pad_similarity(a: np.ndarray, b: np.ndarray, peak: float) -> np.ndarray:
    """SSIM of every window of pads [..., rows, columns]."""
    size = tuple(min(SSIM_WINDOW_TAXELS, cells) for cells in a.shape[-2:])
    windows_a = np.lib.stride_tricks.sliding_window_view(a, size, axis=(-2, -1))
    windows_b = np.lib.stride_tricks.sliding_window_view(b, size, axis=(-2, -1))
    mean_a, mean_b = windows_a.mean((-2, -1)), windows_b.mean((-2, -1))
    covariance = (windows_a * windows_b).mean((-2, -1)) - mean_a * mean_b
    variances = windows_a.var((-2, -1)) + windows_b.var((-2, -1))
    return similarity((mean_a, mean_b), variances, covariance, peak=peak)


def contact_mae(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """Mean absolute error in kPa over the taxels in true contact; NaN if none is."""
    a, b = _pair(predicted_kpa, true_kpa, "contact MAE", measured, layout)
    touched = in_contact(b)
    return float(np.mean(np.abs(a - b)[touched])) if touched.any() else float("nan")


def contact_iou(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """Intersection over union of contact taxels; 1 when neither side has contact."""
    both, either = _overlap(predicted_kpa, true_kpa, "contact IoU", measured, layout)
    return both / either if either else 1.0


def contact_f1(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """2 TP / (2 TP + FP + FN) of contact taxels; 1 when neither side has contact."""
    return _f1(*_overlap(predicted_kpa, true_kpa, "contact F1", measured, layout))


def pad_contact_f1(
    *,
    predicted_kpa: np.ndarray,
    true_kpa: np.ndarray,
    measured: Measured = None,
    layout: TactileLayout = DEXTOUCH_V1,
) -> float:
    """F1 of pads in contact, six of each hand; 1 when neither side has contact.

    A pad is in contact if one of its taxels is: where exactly skin is pressed does not matter.
    """
    a, b = _pair(predicted_kpa, true_kpa, "contact F1 of pads", measured, layout)
    touched_a, touched_b = (layout.by_part(in_contact(kpa), np.any) for kpa in (a, b))
    return _f1(*_counted(touched_a, touched_b))


def _f1(both: int, either: int) -> float:
    return 2 * both / (both + either) if either else 1.0


def _overlap(
    predicted: np.ndarray, true: np.ndarray, what: str, measured: Measured, layout: TactileLayout
) -> tuple[int, int]:
    a, b = (in_contact(kpa) for kpa in _pair(predicted, true, what, measured, layout))
    return _counted(a, b)


def _counted(a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    return int(np.count_nonzero(a & b)), int(np.count_nonzero(a | b))
