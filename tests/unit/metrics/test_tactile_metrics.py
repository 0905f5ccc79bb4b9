"""Taxel errors and contact agreement against counts made by hand."""

import numpy as np
import pytest

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.metrics import tactile

MEASURES = [
    tactile.mse,
    tactile.mae,
    tactile.psnr,
    tactile.ssim,
    tactile.contact_mae,
    tactile.contact_iou,
    tactile.contact_f1,
    tactile.pad_contact_f1,
]


def hands(**pressures: float) -> np.ndarray:
    """Two hands, one step; keys are taxel names t0, t1, … of the left hand."""
    taxels = np.zeros((1, 2, 320), dtype=np.float32)
    for name, value in pressures.items():
        taxels[0, 0, int(name[1:])] = value
    return taxels


def test_mean_errors():
    pair = {"predicted_kpa": hands(t0=4.0, t100=6.0), "true_kpa": hands(t0=8.0)}
    assert tactile.mse(**pair) == pytest.approx((16 + 36) / 640)
    assert tactile.mae(**pair) == pytest.approx(10 / 640)
    assert tactile.psnr(**pair) == pytest.approx(10 * np.log10(40**2 / (52 / 640)))
    assert tactile.psnr(**pair, peak_kpa=4.0) == pytest.approx(tactile.psnr(**pair) - 20)


def test_contact_counts():
    predicted = hands(t0=2.0, t1=1.99, t2=9.0, t90=3.0)
    true = hands(t0=5.0, t1=2.0, t2=7.0, t91=3.0)
    pair = {"predicted_kpa": predicted, "true_kpa": true}
    assert tactile.contact_iou(**pair) == pytest.approx(2 / 5)
    assert tactile.contact_f1(**pair) == pytest.approx(4 / 7)
    assert tactile.contact_mae(**pair) == pytest.approx((3.0 + 0.01 + 2.0 + 3.0) / 4, abs=1e-6)


def test_the_empty_union_is_agreement_and_no_contact_error():
    light = {"predicted_kpa": hands(t3=1.0), "true_kpa": hands(t5=1.5)}
    assert tactile.contact_iou(**light) == 1.0
    assert tactile.contact_f1(**light) == 1.0
    assert np.isnan(tactile.contact_mae(**light))


def test_pads_are_in_contact_wherever_they_are_touched():
    # Fingertips have 16 taxels each, thumb first; the palm has the 240 after them.
    predicted = hands(t0=5.0, t20=5.0, t300=5.0)
    true = hands(t15=5.0, t40=5.0, t90=5.0)
    pair = {"predicted_kpa": predicted, "true_kpa": true}
    # Thumb and palm are right, the index finger is wrong and the middle finger is missed.
    assert tactile.pad_contact_f1(**pair) == pytest.approx(4 / 6)
    assert tactile.contact_f1(**pair) == 0.0


def test_one_sided_contact_scores_zero():
    for pair in ((hands(), hands(t3=5.0)), (hands(t3=5.0), hands())):
        assert tactile.contact_iou(predicted_kpa=pair[0], true_kpa=pair[1]) == 0.0
        assert tactile.contact_f1(predicted_kpa=pair[0], true_kpa=pair[1]) == 0.0
        assert tactile.pad_contact_f1(predicted_kpa=pair[0], true_kpa=pair[1]) == 0.0


def test_everything_pools_over_samples():
    predicted = np.concatenate([hands(t0=5.0), hands(t0=5.0, t1=5.0)])
    true = np.concatenate([hands(t0=5.0), hands(t1=5.0, t2=5.0)])
    assert tactile.contact_iou(predicted_kpa=predicted, true_kpa=true) == pytest.approx(2 / 4)


def test_equal_pressures_are_perfect():
    taxels = np.random.default_rng(6).uniform(0, 60, (3, 2, 320)).astype(np.float32)
    assert tactile.ssim(predicted_kpa=taxels, true_kpa=taxels) == pytest.approx(1.0)
    assert tactile.psnr(predicted_kpa=taxels, true_kpa=taxels) == 100.0
    assert tactile.contact_mae(predicted_kpa=taxels, true_kpa=taxels) == 0.0


def test_ssim_weighs_every_pad_the_same_and_never_mixes_pads():
    true = np.zeros((1, 320))
    one_tip, palm = true.copy(), true.copy()
    one_tip[0, :16] = 1000.0
    palm[0, 80:] = 1000.0
    for predicted in (one_tip, palm):
        assert tactile.ssim(predicted_kpa=predicted, true_kpa=true) == pytest.approx(
            5 / 6, abs=1e-3
        )


def test_ssim_of_a_flat_tip_is_the_luminance_term():
    a, b, c1 = 10.0, 20.0, (0.01 * 40) ** 2
    first, second = np.zeros((1, 320)), np.zeros((1, 320))
    first[0, 16:32], second[0, 16:32] = a, b
    tip = (2 * a * b + c1) / (a * a + b * b + c1)
    assert tactile.ssim(predicted_kpa=first, true_kpa=second) == pytest.approx((5 + tip) / 6)


@pytest.mark.parametrize("measure", MEASURES)
def test_bad_taxels_are_refused(measure):
    good = hands(t0=3.0)
    with pytest.raises(ShapeError, match="320"):
        measure(predicted_kpa=good[..., :319], true_kpa=good[..., :319])
    with pytest.raises(ShapeError, match="same shape"):
        measure(predicted_kpa=good, true_kpa=good[:, :1])
    broken = good.copy()
    broken[0, 1, 7] = np.inf
    with pytest.raises(NonFiniteError, match="leave them out"):
        measure(predicted_kpa=good, true_kpa=broken)
