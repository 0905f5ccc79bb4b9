"""Stress of metrics and statistics: figures must be correct, or NaN if undefined."""

from functools import partial

import numpy as np

from benchmarks.stress.cells import Check, StageCells
from dextouch.errors import NonFiniteError
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.metrics import image, policy, tactile
from services.evaluation.statistics import area_under_roc, bootstrap_mean_interval, wilson_interval

STAGE = StageCells("metrics")


@STAGE.cell("rotations", "errors of 0, 1e-12, 1e-8, π - 1e-8 and π about a skew axis")
def _rotations(check: Check) -> None:
    base = rotation_from_vector(np.array([0.3, -2.0, 1.0]))
    for angle in (0.0, 1e-12, 1e-8, 1.0, np.pi - 1e-8, np.pi):
        turned = base @ rotation_from_vector(angle * np.array([0.48, -0.6, 0.64]))
        got = float(rotation_angle(base.T @ turned))
        check.at_most("angle off", abs(got - angle), 1e-7, "rad")


@STAGE.cell("non_finite", "NaN and infinity on either side of every metric; images of 1e-300")
def _non_finite(check: Check) -> None:
    good = np.ones((2, 320))
    for bad in (np.nan, np.inf):
        broken = good.copy()
        broken[1, 7] = bad
        for measure in (tactile.mse, tactile.mae, tactile.psnr, tactile.ssim, tactile.contact_f1):
            name = f"{measure.__name__} {bad}"
            check.refused(name, measure, kind=NonFiniteError, predicted_kpa=broken, true_kpa=good)
            check.refused(name, measure, kind=NonFiniteError, predicted_kpa=good, true_kpa=broken)
        scores = np.array([0.1, bad, 0.3])
        for agreement in (policy.pearson, policy.spearman, policy.kendall, policy.mmrv):
            call = partial(agreement, real=scores, imagined=np.zeros(3))
            check.refused(f"{agreement.__name__} {bad}", call, kind=NonFiniteError)
    tiny = np.full((1, 16, 16, 3), 1e-300)
    check.at_most(
        "PSNR of equal images off 100", abs(image.psnr(predicted=tiny, true=tiny) - 100), 0.0
    )
    check.at_most(
        "SSIM of equal images off 1", abs(image.ssim(predicted=tiny, true=tiny) - 1), 1e-12
    )
    spread = np.array([1e-200, 2e-200, 3e-200])
    got = policy.pearson(real=spread, imagined=spread)
    check.true(
        "correlation of 1e-200 is 1, or told as undefined", np.isnan(got) or abs(got - 1) < 1e-9
    )


@STAGE.cell("touch", "no touch on both sides, on one; 650 kPa against 0; all the same")
def _touch(check: Check) -> None:
    none, full = np.zeros((4, 2, 320)), np.full((4, 2, 320), 650.0)
    check.true(
        "nothing predicted as nothing: F1, IoU and SSIM 1",
        tactile.contact_f1(predicted_kpa=none, true_kpa=none) == 1
        and tactile.contact_iou(predicted_kpa=none, true_kpa=none) == 1
        and abs(tactile.ssim(predicted_kpa=none, true_kpa=none) - 1) < 1e-12,
    )
    check.true(
        "error of taxels in contact is NaN where none is",
        np.isnan(tactile.contact_mae(predicted_kpa=full, true_kpa=none)),
    )
    exact = tactile.psnr(predicted_kpa=full, true_kpa=full)
    check.at_most("PSNR of exact touch off 100 dB", abs(exact - 100), 0.0)
    got = tactile.psnr(predicted_kpa=full, true_kpa=none)
    check.at_most("PSNR of 650 against 0 off", abs(got - 20 * np.log10(40 / 650)), 1e-12, "dB")
    mae_kpa = tactile.mae(predicted_kpa=full, true_kpa=none)
    check.at_most("MAE of 650 against 0 off", abs(mae_kpa - 650), 0.0, "kPa")


@STAGE.cell("ends", "rates of 0 and 1 of 1 … 10^6 trials; scores that all tie; one outcome only")
def _ends(check: Check) -> None:
    for trials in (1, 20, 10**6):
        for wins in (0, trials):
            found = wilson_interval(wins, trials)
            check.true(
                "Wilson's interval inside 0 … 1 and holds the rate",
                0 <= found.low <= wins / trials <= found.high <= 1,
            )
    # Wilson's upper bound for 0 successes of n: z² / (n + z²).
    z2 = 1.959963984540054**2
    check.at_most("bound of 0 of 20 off", abs(wilson_interval(0, 20).high - z2 / (20 + z2)), 1e-12)
    ties = np.full(5, 0.5)
    check.true(
        "correlation of ties is NaN", np.isnan(policy.pearson(real=ties, imagined=np.arange(5)))
    )
    check.true("AUC of ties is 0.5", area_under_roc(np.ones(6), np.arange(6) > 2) == 0.5)
    check.refused("AUC of successes only", area_under_roc, np.ones(3), np.ones(3, dtype=bool))
    same = bootstrap_mean_interval(np.ones(4), np.random.default_rng(0))
    check.true("interval of equal values is that value", same.low == same.high == 1.0)
    check.refused("no trial", wilson_interval, 0, 0)


@STAGE.cell("precision", "float16, float32 and uint8 against float64; small spreads on large means")
def _precision(check: Check) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 40, (2, 64, 320)).astype(np.float16)
    exact = np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2)
    got = tactile.mse(predicted_kpa=a, true_kpa=b)
    check.at_most("MSE of float16 off", abs(got / exact - 1), 1e-12)
    images = rng.integers(0, 256, (2, 3, 16, 16, 3), dtype=np.uint8)
    mse = np.mean((images[0].astype(int) - images[1]) ** 2, axis=(1, 2, 3))
    expected = np.mean(20 * np.log10(255) - 10 * np.log10(mse))
    off = abs(image.psnr(predicted=images[0], true=images[1]) - expected)
    check.at_most("PSNR of uint8 off", off, 1e-9, "dB")
    x, y = rng.normal(size=(2, 30))
    plain, moved = policy.pearson(real=x, imagined=y), policy.pearson(real=x + 1e6, imagined=y)
    check.at_most("correlation on a mean of 1e6 off", abs(plain - moved), 1e-8)


@STAGE.cell("long_run", "figures of 1008 steps at once and as means of 63 chunks")
def _long_run(check: Check) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 40, (2, 1008, 320))
    chunks = [
        tactile.mse(predicted_kpa=a[k : k + 16], true_kpa=b[k : k + 16]) for k in range(0, 1008, 16)
    ]
    whole = tactile.mse(predicted_kpa=a, true_kpa=b)
    check.at_most("MSE differs", abs(np.mean(chunks) / whole - 1), 1e-12)


@STAGE.cell("batch", "images and rotations one by one and together")
def _batch(check: Check) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 8, 16, 16, 3), dtype=np.uint8)
    for measure in (image.psnr, image.ssim):
        alone = [measure(predicted=a[k], true=b[k]) for k in range(8)]
        check.at_most(
            f"{measure.__name__} differs", abs(np.mean(alone) - measure(predicted=a, true=b)), 1e-12
        )


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="figures know no times",
    device="numpy arrays live in the host's memory",
)
