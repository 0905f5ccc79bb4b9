"""Tactile errors (kPa) and contact agreement of predicted taxel pressures [..., 320].

Everything pools over all given samples, hands and taxels (micro average). Contact is pressure of
at least 2 kPa (`dextouch.tactile.layout`). NaN is refused: take `measured_hands` before calling.
"""

import numpy as np
from jaxtyping import Bool

from dextouch.metrics.image import checked_pair, decibels, similarity
from dextouch.tactile import in_contact
from dextouch.tactile.layout import NUM_TAXELS, split_pads

# Reference pressure of PSNR and SSIM: the full scale of the heat maps.
PEAK_KPA = 40.0
SSIM_WINDOW_TAXELS = 4


def _pair(predicted: np.ndarray, true: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    return checked_pair(predicted, true, what=f"{what} of taxels", tail=(NUM_TAXELS,))


def measured_hands(
    *, predicted_kpa: np.ndarray, true_kpa: np.ndarray, measured: Bool[np.ndarray, "*batch 320"]
) -> dict[str, np.ndarray]:
    """Arguments of the metrics here: hands of which some taxel was measured, others left out.

    Unmeasured taxels of these are 0 in both: no contact, and no error. All are [..., 320].
    """
    hands = measured.any(axis=-1)
    known = measured[hands]
    return {
        "predicted_kpa": np.where(known, predicted_kpa[hands], 0.0),
        "true_kpa": np.where(known, true_kpa[hands], 0.0),
    }


def mse(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """Mean squared error in kPa²."""
    a, b = _pair(predicted_kpa, true_kpa, "MSE")
    return float(np.mean((a - b) ** 2))


def mae(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """Mean absolute error in kPa."""
    a, b = _pair(predicted_kpa, true_kpa, "MAE")
    return float(np.mean(np.abs(a - b)))


def psnr(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray, peak_kpa: float = PEAK_KPA) -> float:
    """10 log10(peak² / MSE) in dB of the pooled MSE, at most 100 dB.

    Pooled, since samples of an untouched hand are mostly exact: the cap would dominate a mean.
    """
    a, b = _pair(predicted_kpa, true_kpa, "PSNR")
    return float(decibels(np.mean((a - b) ** 2), peak=peak_kpa))


def ssim(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray, peak_kpa: float = PEAK_KPA) -> float:
    """Mean structural similarity of the six pads of a hand, 1 for equal pads.

    Computed within pads only: uniform windows of 4×4 taxels (one fingertip) inside each pad, K1 =
    0.01, K2 = 0.03, range 0 … `peak_kpa`; each of the five fingertips and the palm has the same
    weight. An untouched pad predicted as untouched scores 1.
    """
    a, b = _pair(predicted_kpa, true_kpa, "SSIM")
    tips_a, palm_a = split_pads(a)
    tips_b, palm_b = split_pads(b)
    tips = _pad_similarity(tips_a, tips_b, peak_kpa)
    palm = _pad_similarity(palm_a, palm_b, peak_kpa)
    return float((tips_a.shape[-3] * np.mean(tips) + np.mean(palm)) / (tips_a.shape[-3] + 1))


def _pad_similarity(a: np.ndarray, b: np.ndarray, peak: float) -> np.ndarray:
    """SSIM of every 4×4 window of pads [..., rows, columns]."""
    size = (SSIM_WINDOW_TAXELS, SSIM_WINDOW_TAXELS)
    windows_a = np.lib.stride_tricks.sliding_window_view(a, size, axis=(-2, -1))
    windows_b = np.lib.stride_tricks.sliding_window_view(b, size, axis=(-2, -1))
    mean_a, mean_b = windows_a.mean((-2, -1)), windows_b.mean((-2, -1))
    covariance = (windows_a * windows_b).mean((-2, -1)) - mean_a * mean_b
    variances = windows_a.var((-2, -1)) + windows_b.var((-2, -1))
    return similarity((mean_a, mean_b), variances, covariance, peak=peak)


def contact_mae(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """Mean absolute error in kPa over the taxels in true contact.

    NaN when no taxel is in true contact.
    """
    a, b = _pair(predicted_kpa, true_kpa, "contact MAE")
    touched = in_contact(b)
    return float(np.mean(np.abs(a - b)[touched])) if touched.any() else float("nan")


def contact_iou(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """Intersection over union of contact taxels; 1 when neither side has contact."""
    both, either = _overlap(predicted_kpa, true_kpa, "contact IoU")
    return both / either if either else 1.0


def contact_f1(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """2 TP / (2 TP + FP + FN) of contact taxels; 1 when neither side has contact."""
    return _f1(*_overlap(predicted_kpa, true_kpa, "contact F1"))


def pad_contact_f1(*, predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> float:
    """F1 of pads in contact, six of each hand; 1 when neither side has contact.

    A fingertip or palm is in contact if one of its taxels is. Where exactly skin is pressed does
    not matter, which differs between people and robots.
    """
    a, b = _pair(predicted_kpa, true_kpa, "contact F1 of pads")
    return _f1(*_counted(_pads_in_contact(a), _pads_in_contact(b)))


def _pads_in_contact(kpa: np.ndarray) -> np.ndarray:
    tips, palm = split_pads(np.asarray(in_contact(kpa)))
    return np.concatenate([tips.any((-1, -2)), np.expand_dims(palm.any((-1, -2)), -1)], axis=-1)


def _f1(both: int, either: int) -> float:
    return 2 * both / (both + either) if either else 1.0


def _overlap(predicted: np.ndarray, true: np.ndarray, what: str) -> tuple[int, int]:
    a, b = (in_contact(kpa) for kpa in _pair(predicted, true, what))
    return _counted(a, b)


def _counted(a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    return int(np.count_nonzero(a & b)), int(np.count_nonzero(a | b))
