"""Agreement of policy scores against every cell of the paper's tables, and the known traps."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from dextouch.errors import NonFiniteError, ShapeError, UnknownNameError
from dextouch.metrics import policy

PAPER = json.loads((Path(__file__).parent / "paper_scores.json").read_text(encoding="utf-8"))
PRINTED = 5e-4
CELLS = [(world, task) for world in PAPER["imagined"] for task in range(4)]


def scores(world: str, task: int) -> dict[str, np.ndarray]:
    return {
        "real": np.array(PAPER["real"][task]),
        "imagined": np.array(PAPER["imagined"][world][task]),
    }


@pytest.mark.parametrize(("world", "task"), CELLS)
def test_every_cell_of_the_paper(world, task):
    assert policy.pearson(**scores(world, task)) == pytest.approx(
        PAPER["pearson"][world][task], abs=PRINTED
    )
    for ties in policy.TIE_RULES:
        assert policy.mmrv(**scores(world, task), ties=ties) == pytest.approx(
            PAPER["mmrv"][world][task], abs=PRINTED
        )


def test_printed_score_misses_its_cell():
    printed = policy.pearson(
        real=np.array([0.725, 0.45, 0.5]), imagined=np.array([0.963, 0.9, 0.925])
    )
    assert abs(printed - 0.972) > PRINTED


@pytest.mark.parametrize("world", ["WM-Robot", "WM-Mix"])
def test_means_and_errors_of_the_text(world):
    cells = [scores(world, task) for task in range(4)]
    assert np.mean([policy.pearson(**c) for c in cells]) == pytest.approx(
        PAPER["mean_pearson"][world], abs=PRINTED
    )
    assert np.mean([policy.mmrv(**c) for c in cells]) == pytest.approx(
        PAPER["mean_mmrv"][world], abs=PRINTED
    )
    real, imagined = np.array(PAPER["real"]).ravel(), np.array(PAPER["imagined"][world]).ravel()
    assert policy.mean_absolute_error(real=real, imagined=imagined) == pytest.approx(
        PAPER["mean_absolute_error"][world], abs=PRINTED
    )
    assert policy.bias(real=real, imagined=imagined) > 0.1


def test_pooled_correlation_of_both_world_models():
    worlds = [np.array(PAPER["imagined"][w]).ravel() for w in ("WM-Robot", "WM-Mix")]
    assert policy.pearson(real=worlds[0], imagined=worlds[1]) == pytest.approx(0.925, abs=PRINTED)


def test_swapped_sides_give_another_mmrv():
    shoes, bottle = scores("WM-Robot", 0), scores("WM-Robot", 3)
    assert policy.mmrv(real=shoes["imagined"], imagined=shoes["real"]) == pytest.approx(
        0.23333, abs=1e-4
    )
    assert policy.mmrv(real=bottle["imagined"], imagined=bottle["real"]) == pytest.approx(
        0.46667, abs=1e-4
    )
    with pytest.raises(TypeError):
        policy.mmrv(shoes["real"], shoes["imagined"])


def test_ties_count_only_in_the_simpler_rule():
    tied = {"real": np.array([0.2, 0.8]), "imagined": np.array([0.5, 0.5])}
    assert policy.mmrv(**tied) == 0.0
    assert policy.mmrv(**tied, ties="simpler") == pytest.approx(0.30)
    with pytest.raises(UnknownNameError, match="paper, simpler"):
        policy.mmrv(**tied, ties="guess")


@pytest.mark.parametrize("measure", [policy.pearson, policy.spearman, policy.kendall])
@pytest.mark.parametrize(
    ("real", "imagined"),
    [
        ([0.5], [0.5]),
        ([0.1, 0.1, 0.1], [0.1, 0.2, 0.3]),
        ([1, 2], [3, 3]),
        # Two points always lie on a line: |r| is 1 whatever the scores.
        ([0.2, 0.8], [0.7, 0.1]),
        ([0.2, 0.8], [0.3, 0.31]),
        # Equal but for the order in which three shares were added.
        ([0.1, 0.5, 0.9], [0.1 + 0.2 + 0.3, 0.3 + 0.2 + 0.1, 0.6]),
    ],
)
def test_undefined_is_nan(measure, real, imagined):
    assert np.isnan(measure(real=np.array(real), imagined=np.array(imagined)))


def test_rounding_makes_no_rank():
    assert 0.1 + 0.2 + 0.3 != 0.3 + 0.2 + 0.1
    scores = {
        "real": np.array([0.2, 0.8, 1.0]),
        "imagined": np.array([0.1 + 0.2 + 0.3, 0.3 + 0.2 + 0.1, 0.9]),
    }
    # As with equal scores: one tie of three pairs, and SciPy's τ-b of (1, 2, 3) and (1, 1, 2).
    assert policy.kendall(**scores) == pytest.approx(stats.kendalltau([1, 2, 3], [1, 1, 2])[0])
    assert policy.mmrv(**scores) == 0.0
    assert policy.mmrv(**scores, ties="simpler") == pytest.approx(0.6 / 3)


def test_mmrv_of_one_policy_is_undefined():
    assert np.isnan(policy.mmrv(real=np.array([0.4]), imagined=np.array([0.6])))


@pytest.mark.parametrize(
    "measure",
    [
        policy.pearson,
        policy.spearman,
        policy.kendall,
        policy.mmrv,
        policy.bias,
        policy.mean_absolute_error,
    ],
)
def test_bad_scores_are_refused(measure):
    with pytest.raises(NonFiniteError, match="second array"):
        measure(real=np.array([0.1, 0.2]), imagined=np.array([0.1, np.nan]))
    with pytest.raises(ShapeError, match="same shape"):
        measure(real=np.array([0.1, 0.2]), imagined=np.array([0.1]))
    with pytest.raises(ShapeError, match="not empty"):
        measure(real=np.array([]), imagined=np.array([]))


def test_rank_measures_agree_with_scipy():
    rng = np.random.default_rng(3)
    for _ in range(50):
        real, imagined = rng.integers(0, 5, (2, 7)) / 4
        if np.ptp(real) == 0 or np.ptp(imagined) == 0:
            continue
        assert policy.spearman(real=real, imagined=imagined) == pytest.approx(
            stats.spearmanr(real, imagined).statistic
        )
        assert policy.kendall(real=real, imagined=imagined) == pytest.approx(
            stats.kendalltau(real, imagined).statistic
        )


def test_agreement_does_not_depend_on_the_order_of_the_policies():
    rng = np.random.default_rng(4)
    real, imagined = rng.random((2, 6))
    order = rng.permutation(6)
    for measure in (policy.pearson, policy.spearman, policy.kendall, policy.mmrv):
        assert measure(real=real, imagined=imagined) == pytest.approx(
            measure(real=real[order], imagined=imagined[order])
        )
