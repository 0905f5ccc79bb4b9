"""Agreement figures against scipy, hand calculations, brute force and simulated studies."""

import itertools
import math
import tracemalloc

import numpy as np
import pytest
from scipy import stats

from services.evaluation.agreement import (
    FIGURES,
    MAX_PERMUTATIONS,
    chance_of_correlation,
    figures_of_draws,
    paired_differences,
    pooled_agreement,
    sign_flip_p,
    task_agreement,
)
from services.evaluation.statistics import (
    MatchedScores,
    ScoreDraws,
    bootstrap_scores,
    noise_covariance,
    posterior_scores,
)


def rng(seed=0):
    return np.random.default_rng(seed)


def binary(rates, num_starts, generator):
    return (generator.random((len(rates), num_starts)) < np.array(rates)[:, None]) * 1.0


def test_figures_of_draws_are_those_of_scipy():
    real, imagined = rng(1).integers(0, 6, (2, 40, 5)) / 5
    found = figures_of_draws(ScoreDraws(real, imagined))
    for row in range(len(real)):
        expected = {
            "pearson": stats.pearsonr(real[row], imagined[row])[0],
            "spearman": stats.spearmanr(real[row], imagined[row])[0],
            "kendall": stats.kendalltau(real[row], imagined[row])[0],
        }
        for name, value in expected.items():
            assert found[name][row] == pytest.approx(value, abs=1e-9)
        for name, measure in FIGURES.items():
            single = measure.compute(real=real[row], imagined=imagined[row])
            assert found[name][row] == pytest.approx(single, abs=1e-9)


def test_draws_of_many_policies_take_little_memory():
    draws = ScoreDraws(*rng(2).random((2, 1500, 100)))
    tracemalloc.start()
    found = figures_of_draws(draws)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # All pairs at once are 120 MB an array.
    assert peak_bytes < 120e6
    alone = figures_of_draws(ScoreDraws(draws.real[-1:], draws.imagined[-1:]))
    assert {name: values[-1] for name, values in found.items()} == {
        name: value for name, (value,) in alone.items()
    }


def test_three_policies_in_order_are_chance_once_in_six():
    scores = [np.array([0.1, 0.5, 0.9])]
    assert chance_of_correlation(scores, [np.array([0.2, 0.5, 1.0])], rng()) == pytest.approx(1 / 6)
    # Two tasks: one in 36.
    twice = [*scores, *scores]
    assert chance_of_correlation(twice, twice, rng()) == pytest.approx(1 / 36)
    assert math.isnan(chance_of_correlation(scores, [np.ones(3)], rng()))


@pytest.mark.long
@pytest.mark.parametrize("num_policies", [6, 10])
def test_chance_is_that_of_scipy(num_policies):
    real = rng(2).random(num_policies)
    imagined = 0.5 * real + 0.5 * rng(3).random(num_policies)
    oracle = stats.permutation_test(
        (imagined,),
        lambda x: stats.pearsonr(real, x)[0],
        permutation_type="pairings",
        alternative="greater",
        n_resamples=2000,
        rng=rng(4),
    )
    found = chance_of_correlation([real], [imagined], rng(5))
    assert found == pytest.approx(oracle.pvalue, abs=0.015)


@pytest.mark.parametrize("num_starts", [8, 30])
def test_sign_flips_are_those_of_scipy(num_starts):
    paired = rng(6).normal(0.3, 1, num_starts)
    oracle = stats.permutation_test(
        (paired,), np.mean, permutation_type="samples", n_resamples=20_000, rng=rng(7)
    )
    assert sign_flip_p(paired, rng(8)) == pytest.approx(oracle.pvalue, abs=0.01)
    assert sign_flip_p(np.zeros(5), rng()) == 1.0


def test_sign_flips_of_outcomes_are_the_exact_binomial_test():
    outcomes = binary([0.5, 0.42], 2000, rng(9))
    paired = outcomes[0] - outcomes[1]
    oracle = stats.binomtest(int((paired > 0).sum()), int((paired != 0).sum()))
    tracemalloc.start()
    found = sign_flip_p(paired, rng())
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found == pytest.approx(oracle.pvalue, rel=1e-9)
    # Signs of each start would be 400 MB.
    assert peak_bytes < 10e6


def test_sign_flips_of_shares_are_those_of_all_patterns():
    # 1/3 in four ways that differ by rounding: 2^12 patterns by brute force.
    paired = np.array([1, 2 / 3 - 1 / 3, 1 - 2 / 3, 1 / 3, 4 / 3 - 1, -2 / 3] * 2)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(paired))))
    expected = np.mean(np.abs(signs @ paired) >= abs(paired.sum()) - 1e-9)
    assert sign_flip_p(paired, rng()) == pytest.approx(expected, rel=1e-9)


def test_a_p_value_of_drawn_signs_is_never_zero():
    """Of 2^60 sign patterns none that is drawn is as large as the true one, which counts."""
    found = sign_flip_p(np.linspace(1.0, 2.0, 60), rng())
    assert found == pytest.approx(1 / (MAX_PERMUTATIONS + 1))


def test_paired_difference_by_hand():
    # Three starts of ten that only the first policy solves: p12 = 4/12, p21 = 1/12, so the centre
    # is 0.25 and the variance (5/12 - 0.0625) / 12.
    outcomes = np.array([[1, 1, 1, 1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 1, 0, 0, 0, 0, 0]]) * 1.0
    (found,) = paired_differences(["a", "b"], outcomes, rng())
    half = 1.959964 * math.sqrt((5 / 12 - 0.0625) / 12)
    assert found.difference == pytest.approx(0.3)
    assert (found.interval.low, found.interval.high) == pytest.approx((0.25 - half, 0.25 + half))
    # All three differences have one sign: twice one in eight.
    assert found.p == pytest.approx(0.25)


def test_always_against_never_is_not_certain():
    outcomes = np.stack([np.ones(10), np.zeros(10)])
    (found,) = paired_differences(["a", "b"], outcomes, rng())
    assert found.interval.low < 0.9 < found.interval.high == 1.0


def test_noise_of_ten_successes_by_hand():
    found = noise_covariance(np.array([np.ones(10), [1, 0] * 5]))
    assert found[0, 0] == pytest.approx((11 / 12) * (1 / 12) / 10, rel=1e-5)
    assert found[1, 1] == pytest.approx(0.25 / 10, rel=1e-5)
    assert found[0, 1] == 0


def test_correlations_of_few_starts_are_shrunk_by_hand():
    """By 1 - 4 / starts: to a third with six, to nothing with four and fewer."""
    six = np.array([[1.0, 1, 1, 0, 0, 1], [1, 0, 1, 0, 0, 1]])
    found = noise_covariance(six)
    correlation = found[0, 1] / math.sqrt(found[0, 0] * found[1, 1])
    assert correlation == pytest.approx(np.corrcoef(six)[0, 1] / 3, rel=1e-4)
    for num_starts in (2, 3, 4):
        assert noise_covariance(six[:, 1 : 1 + num_starts])[0, 1] == 0


def test_noise_shared_by_series_is_seen():
    generator = rng(9)
    luck = generator.random(5000)
    found = noise_covariance(np.stack([luck, luck, generator.random(5000)]))
    # Variance of a uniform number is 1/12.
    assert found[0, 0] == pytest.approx(1 / 12 / 5000, rel=0.05)
    assert found[0, 1] == pytest.approx(found[0, 0], rel=0.01)
    assert abs(found[0, 2]) < 0.05 * found[0, 0]


@pytest.mark.long
def test_posterior_is_that_of_importance_sampling():
    scores = MatchedScores(binary([0.2, 0.8], 10, rng(10)), binary([0.3, 0.7], 10, rng(11)))
    draws = posterior_scores(scores, rng(12), num_draws=20_000)
    generator, num = rng(13), 400_000
    grid = np.array([0.02, 0.04, 0.08, 0.12, 0.17, 0.23, 0.30, 0.40, 0.55])
    width = np.gradient(grid)
    spread = generator.choice(grid, (num, 2), p=width / width.sum())
    r = np.tanh(generator.choice(np.linspace(-3, 3, 25), num))
    mean = generator.uniform(-2, 3, (num, 2))
    normal = generator.standard_normal((2, num, 2))
    normal[1] = r[:, None] * normal[0] + np.sqrt(1 - r**2)[:, None] * normal[1]
    true = np.concatenate([mean[:, [k]] + spread[:, [k]] * normal[k] for k in (0, 1)], axis=1)
    rollouts = np.concatenate([scores.real, scores.imagined])
    weight = stats.multivariate_normal(rollouts.mean(axis=1), noise_covariance(rollouts)).pdf(true)
    weight /= weight.sum()
    true = np.clip(true, 0, 1)
    expected = weight @ true
    sigma = np.sqrt(weight @ (true - expected) ** 2)
    drawn = np.concatenate([draws.real, draws.imagined], axis=1)
    assert drawn.mean(axis=0) == pytest.approx(expected, abs=0.02)
    assert drawn.std(axis=0) == pytest.approx(sigma, rel=0.1)


@pytest.mark.slow
def test_intervals_hold_the_truth_where_a_bootstrap_does_not():
    generator, held = rng(14), {"posterior": 0, "bootstrap": 0}
    for _ in range(30):
        real = generator.uniform(0.05, 0.95, 6)
        imagined = np.clip(real + generator.normal(0, 0.05, 6), 0.02, 0.98)
        truth = np.corrcoef(real, imagined)[0, 1]
        scores = MatchedScores(binary(real, 10, generator), binary(imagined, 10, generator))
        agreement, draws = task_agreement("abcdef", scores, generator)
        interval = agreement.figures["pearson"].interval
        held["posterior"] += interval.low <= truth <= interval.high
        drawn = figures_of_draws(draws.bootstrap)["pearson"]
        low, high = np.nanquantile(drawn, [0.025, 0.975])
        held["bootstrap"] += low <= truth <= high
    assert held["posterior"] >= 26
    assert held["bootstrap"] <= 15


@pytest.mark.long
def test_many_starts_leave_little_doubt():
    rates = [0.2, 0.5, 0.8]
    scores = MatchedScores(binary(rates, 3000, rng(15)), binary(rates, 3000, rng(16)))
    agreement, _ = task_agreement("abc", scores, rng(17))
    interval = agreement.figures["pearson"].interval
    assert interval.low > 0.98
    assert agreement.figures["pearson"].undefined_share == 0


def test_bootstrap_spreads_as_starts_do():
    scores = rng(18).uniform(0, 1, (1, 50))
    drawn = bootstrap_scores(MatchedScores(scores, scores), rng(19), num_draws=4000).real
    assert drawn.var() == pytest.approx(scores.var() / 50, rel=0.1)
    assert drawn.mean() == pytest.approx(scores.mean(), abs=0.005)


def test_a_start_is_drawn_for_both_worlds():
    scores = binary([0.3, 0.6], 10, rng(26))
    draws = bootstrap_scores(MatchedScores(scores, scores), rng(27), num_draws=50)
    np.testing.assert_array_equal(draws.real, draws.imagined)


def test_a_world_without_spread_has_no_correlation():
    scores = MatchedScores(binary([0.2, 0.5, 0.8], 10, rng(28)), np.ones((3, 10)))
    agreement, _ = task_agreement("abc", scores, rng(29))
    pearson = agreement.figures["pearson"]
    assert math.isnan(pearson.value)
    assert (pearson.interval, pearson.undefined_share) == (None, 1.0)


@pytest.mark.long
def test_two_policies_have_no_correlation_also_over_several_tasks():
    """Two points lie on a line; four points of two policies only tell easy tasks from hard ones."""
    tasks = [
        MatchedScores(binary(rates, 20, rng(40)), binary(rates, 20, rng(41)))
        for rates in ([0.1, 0.3], [0.7, 0.9])
    ]
    alone, draws = zip(*(task_agreement("ab", scores, rng(42)) for scores in tasks), strict=True)
    for agreement in (*alone, pooled_agreement("ab", tasks, draws, rng(43))):
        for name in ("pearson", "spearman", "kendall"):
            figure = agreement.figures[name]
            assert math.isnan(figure.value)
            assert (figure.interval, figure.undefined_share) == (None, 1.0)
        assert all(math.isnan(r) for r in agreement.without.values())
        assert math.isnan(agreement.chance)
        # Ranks of two policies can be violated, and rates differ from real ones.
        for name in ("mmrv", "bias", "mean_absolute_error"):
            assert agreement.figures[name].interval is not None


def test_three_policies_without_one_are_two():
    tasks = [
        MatchedScores(*(binary([0.1, 0.5, 0.9], 20, rng(k)) for k in (s, s + 1))) for s in (44, 46)
    ]
    alone, draws = zip(*(task_agreement("abc", scores, rng(48)) for scores in tasks), strict=True)
    for agreement in (*alone, pooled_agreement("abc", tasks, draws, rng(49))):
        assert math.isfinite(agreement.figures["pearson"].value)
        assert all(math.isnan(r) for r in agreement.without.values())


def test_undecided_rollouts_are_missing():
    real, imagined = binary([0.2, 0.5, 0.8], 30, rng(50)), binary([0.3, 0.5, 0.7], 30, rng(51))
    imagined[0, :12], imagined[2, 20:] = np.nan, np.nan
    scores = MatchedScores(real, imagined)
    agreement, draws = task_agreement("abc", scores, rng(52))
    means = [side[np.isfinite(side)].mean() for side in imagined]
    assert agreement.figures["bias"].value == pytest.approx(np.mean(means) - real.mean())
    assert agreement.figures["pearson"].interval is not None
    # Of a policy with fewer decided rollouts less is known; its draws lie about its own rate.
    for drawn in (draws.posterior, draws.bootstrap):
        assert np.isfinite(drawn.imagined).all()
        assert drawn.imagined.mean(axis=0) == pytest.approx(means, abs=0.06)
    (pair, *_) = paired_differences("ab", imagined[:2], rng(53))
    assert pair.difference == pytest.approx((imagined[0, 12:] - imagined[1, 12:]).mean())
    never = np.array([[1.0, np.nan], [np.nan, 0.0]])
    assert paired_differences("ab", never, rng(54)) == []


def test_noise_of_missing_scores_is_that_of_the_known_ones():
    rollouts = rng(55).random((2, 4000))
    rollouts[1] = 0.5 * rollouts[0] + 0.5 * rollouts[1]
    kept = rollouts.copy()
    kept[0, :1000], kept[1, 3000:] = np.nan, np.nan
    found = noise_covariance(kept)
    # The covariance of two means over 3000 starts that share 2000 of them.
    expected = np.cov(rollouts)[0, 1] * 2000 / (3000 * 3000)
    assert found[0, 1] == pytest.approx(expected, rel=0.1)
    assert found[0, 0] == pytest.approx(noise_covariance(rollouts[:, 1000:])[0, 0])


def test_pooled_agreement_joins_tasks():
    tasks = [
        MatchedScores(binary(rates, 20, rng(22)), binary(rates, 20, rng(23)))
        for rates in ([0.1, 0.5, 0.9], [0.2, 0.4, 0.6])
    ]
    found = [task_agreement("abc", scores, rng(24)) for scores in tasks]
    pooled = pooled_agreement("abc", tasks, [draws for _, draws in found], rng(25))
    means = [[side.mean(axis=1) for side in (scores.real, scores.imagined)] for scores in tasks]
    real, imagined = (np.concatenate([pair[k] for pair in means]) for k in (0, 1))
    assert pooled.figures["pearson"].value == pytest.approx(np.corrcoef(real, imagined)[0, 1])
    assert set(pooled.without) == set("abc")
    assert pooled.chance <= 4 / 36
