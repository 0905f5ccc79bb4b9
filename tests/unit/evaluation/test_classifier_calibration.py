"""Calibration figures by hand, and temperatures that are known because we made the outcomes."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from services.evaluation.classifier_calibration import (
    brier,
    expected_calibration_error,
    final_endings,
    fit_calibration,
    fit_combination,
    undecided_band,
)
from services.evaluation.endings import Ending, EndingEpisode
from services.evaluation.scores import LEAST_DECIDED
from services.evaluation.success_classifier import Calibration, Combination, sigmoid
from services.evaluation.success_classifier_training import ClassifierSets

# Allowed share of wrong answers among what is decided.
RISK = 0.10


def test_expected_calibration_error_by_hand():
    # Bin 0.2 … 0.3: said 0.25 twice, came true once; bin 0.9 … 1: said 0.9 and 1.0, once.
    told, came = np.array([0.25, 0.25, 0.9, 1.0]), np.array([1, 0, 1, 0])
    by_hand = 0.5 * abs(0.25 - 0.5) + 0.5 * abs(0.95 - 0.5)
    assert expected_calibration_error(told, came) == pytest.approx(by_hand)
    assert brier(told, came) == pytest.approx((0.75**2 + 0.25**2 + 0.1**2 + 1) / 4)


def test_errors_in_one_bin_cancel_and_in_two_bins_do_not():
    assert expected_calibration_error(np.array([0.5, 0.5]), np.array([1, 0])) == 0
    assert expected_calibration_error(np.array([0.4, 0.6]), np.array([1, 0])) == pytest.approx(0.6)


@pytest.mark.long
def test_a_known_temperature_and_bias_are_found():
    rng = np.random.default_rng(1)
    honest = rng.normal(0.0, 2.0, 20_000)
    came = rng.random(len(honest)) < 1 / (1 + np.exp(-honest))
    # A judge three times too sure, and shifted.
    said = 3.0 * honest + 1.5
    found = fit_calibration(said, came)
    assert found.temperature == pytest.approx(3.0, rel=0.05)
    assert found.bias == pytest.approx(-0.5, abs=0.05)
    before, after = sigmoid(said), found.probabilities(said)
    assert expected_calibration_error(before, came) > 0.05
    assert expected_calibration_error(after, came) < 0.015
    assert brier(after, came) < brier(before, came)


def test_separable_endings_stay_finite():
    odds = np.array([-4.0, -3.0, 3.0, 5.0])
    found = fit_calibration(odds, odds > 0)
    assert 0.5 < found.temperature < 4
    told = found.probabilities(odds)
    assert (told > 0).all()
    assert (told < 1).all()


@pytest.mark.parametrize("confidence", [-5.0, 0.0, 5.0])
def test_a_judge_that_is_always_wrong_knows_nothing(confidence):
    odds = np.random.default_rng(2).normal(size=400)
    came, said = odds < 0, odds + confidence
    told = fit_calibration(said, came).probabilities(said)
    assert np.ptp(told) < 0.01
    assert told == pytest.approx(np.full(400, came.mean()), abs=0.02)
    both = sigmoid(np.stack([said, said]))
    joint = fit_combination(*both, came).probabilities(*both)
    assert joint == pytest.approx(np.full(400, came.mean()), abs=0.02)


def test_estimates_that_are_always_even_leave_the_base_rate():
    came = np.arange(40) % 4 == 0
    assert fit_calibration(np.zeros(40), came).probabilities(np.zeros(1)) < 0.4
    probe = np.where(came, 0.8, 0.3)
    joint = fit_combination(probe, np.full(40, 0.5), came)
    told = joint.probabilities(probe, np.full(40, 0.5))
    assert ((told > 0.5) == came).all()


def test_the_band_leaves_the_allowed_risk():
    # 98 sure endings, all right; four unsure ones, of which two are wrong.
    told = np.array([0.99] * 49 + [0.01] * 49 + [0.52, 0.55, 0.46, 0.45])
    came = np.array([1] * 49 + [0] * 49 + [0, 1, 0, 1])
    # All decided: (2 + 1) / 103. Beyond 0.02: (1 + 1) / 102. Beyond 0.05: (0 + 1) / 99.
    for risk, band in ((0.03, 0.0), (0.02, 0.02), (0.015, 0.05)):
        assert undecided_band(told, came, risk=risk) == pytest.approx(band)


def test_few_endings_promise_nothing():
    assert undecided_band(np.array([0.9, 0.1]), np.array([1, 0]), risk=0.05) == 0.45


def brute_force_band(told, came, risk):
    """The narrowest of all bands that keeps the risk, and 0.5 if none does."""
    for band in [0.0, *sorted(abs(told - 0.5))]:
        decided = abs(told - 0.5) > band if band else np.full(len(told), fill_value=True)
        wrong = sum((p >= 0.5) != y for p, y in zip(told[decided], came[decided], strict=True))
        if decided.any() and (wrong + 1) / (decided.sum() + 1) <= risk:
            return band
    return 0.5


@pytest.mark.parametrize("seed", range(8))
def test_the_band_is_the_narrowest_of_all_that_keep_the_risk(seed):
    rng = np.random.default_rng(seed)
    told = rng.random(120)
    came = rng.random(120) < told
    for risk in (0.02, 0.1, 0.2):
        found = undecided_band(told, came, risk=risk, widest=0.5)
        assert found == pytest.approx(brute_force_band(told, came, risk))


def estimates(rng, num, *, probe_noise, world_noise):
    """Outcomes, and probabilities of two judges who see the true log odds with noise."""
    true = rng.normal(0.0, 3.0, num)
    came = rng.random(num) < sigmoid(true)
    probe, world = (sigmoid(true + rng.normal(0, n, num)) for n in (probe_noise, world_noise))
    return probe, world, came


def decided_of(joint, probe, world, came):
    told = joint.probabilities(probe, world)
    decided = (abs(told - 0.5) > joint.band) & ~joint.contradictory(probe, world)
    wrong = ((told >= 0.5) != came)[decided].mean() if decided.any() else 0.0
    return decided.mean(), wrong


def test_judges_that_know_something_decide_most_and_err_within_the_risk():
    rng = np.random.default_rng(3)
    for noises in ((0.5, 0.5), (0.5, 3.0), (2.0, 0.5)):
        noise = dict(zip(("probe_noise", "world_noise"), noises, strict=True))
        joint = fit_combination(*estimates(rng, 300, **noise), risk=RISK)
        decided, wrong = decided_of(joint, *estimates(rng, 20_000, **noise))
        assert decided >= LEAST_DECIDED
        # Up to the error of a rate among some 200 development endings.
        assert wrong <= RISK + 0.03


def test_a_judge_that_is_too_sure_gets_a_band_and_its_risk():
    rng = np.random.default_rng(4)

    def too_sure(num):
        probe, world, came = estimates(rng, num, probe_noise=2.0, world_noise=2.0)
        probe, world = (p**5 / (p**5 + (1 - p) ** 5) for p in (probe, world))
        return probe, world, came

    joint = fit_combination(*too_sure(400), risk=RISK, margin=0.5)
    probe, world, came = too_sure(20_000)
    assert joint.band > 0
    assert decided_of(Combination(margin=0.5), probe, world, came)[1] > RISK + 0.03
    # With the risk itself too few would be decided.
    decided, wrong = decided_of(joint, probe, world, came)
    assert decided >= LEAST_DECIDED
    assert RISK < wrong <= 2 * RISK


def test_of_a_world_that_knows_nothing_the_probe_is_believed_and_of_two_nobody():
    rng = np.random.default_rng(5)
    probe, _, came = estimates(rng, 2000, probe_noise=0.5, world_noise=0.5)
    joint = fit_combination(probe, rng.random(2000), came, risk=RISK, margin=0.5)
    assert joint.world_weight < 0.1 * joint.probe_weight
    assert decided_of(joint, probe, rng.random(2000), came)[0] >= LEAST_DECIDED
    # Backwards is as bad as knowing nothing: it is left out, not believed the other way round.
    other, _, _ = estimates(rng, 2000, probe_noise=0.5, world_noise=0.5)
    backwards = np.where(came, np.minimum(other, 1 - other), np.maximum(other, 1 - other))
    joint = fit_combination(probe, backwards, came, margin=0.5)
    assert joint.world_weight == 0
    assert joint.probe_weight > 0.5
    blind = rng.random((2, 2000))
    assert fit_combination(*blind, came, margin=0.5).band >= 0.4
    assert decided_of(fit_combination(*blind, came), *blind, came)[0] < 0.02


def test_judges_who_always_contradict_each_other_decide_nothing():
    probe, world = np.full(20, 0.9), np.full(20, 0.1)
    assert fit_combination(probe, world, np.arange(20) % 2 == 0).band == 0.5


def test_two_probabilities_by_hand():
    # Mean log odds of 0.8 and 0.5 are ln 4 / 2 = ln 2, so 2 / 3. Certainty counts as 0.99: log odds
    # 4.595, halved, of which the sigmoid is 0.9087.
    told = Combination().probabilities(np.array([0.8, 1.0]), np.array([0.5, 0.5]))
    assert told == pytest.approx([2 / 3, 0.9087], abs=1e-4)
    probe, world = np.array([0.6, 0.6, 0.1, 0.3, 0.9]), np.array([0.4, 0.5, 0.2, 0.8, 0.35])
    opposite = Combination().contradictory(probe, world)
    assert opposite.tolist() == [True, False, False, True, True]
    tolerant = Combination(margin=0.17).contradictory(probe, world)
    assert tolerant.tolist() == [False, False, False, True, False]


def test_one_outcome_is_refused():
    with pytest.raises(InvalidInputError, match="both outcomes"):
        fit_calibration(np.ones(3), np.ones(3))
    with pytest.raises(InvalidInputError, match="at least one"):
        expected_calibration_error(np.array([]), np.array([]))


def test_no_calibration_is_the_plain_sigmoid():
    assert Calibration().probabilities(np.array([0.0, np.log(3)])) == pytest.approx([0.5, 0.75])


def test_true_endings_that_show_poses_alone_are_left_out():
    """A probe gets no poses of true endings, so that nothing would be left of them."""

    def episode(*, imagined, images):
        ending = Ending(images, np.zeros((3, 2, 320), np.float32), "t", poses, imagined)
        return EndingEpisode("e", "t", "do it", "s", not imagined, "d", 9, {9: ending}, "c")

    poses = np.zeros((3, 2, 7), np.float32)
    pictures = np.zeros((3, 8, 8, 3), np.uint8)
    episodes = [
        episode(imagined=False, images=None),
        episode(imagined=False, images=pictures),
        episode(imagined=True, images=None),
    ]
    true, success = final_endings(episodes, "t", "true")
    assert [one.images is pictures and one.object_poses is None for one in true] == [True]
    assert success.tolist() == [True]
    imagined, _ = final_endings(episodes, "t", "imagined")
    assert [one.object_poses is poses for one in imagined] == [True]
    held_out = [episodes[1], replace(episodes[0], success=False)]
    with pytest.raises(InvalidInputError, match="1 true takes of 't' that end with images"):
        ClassifierSets(episodes, [], held_out).check_measurable()
