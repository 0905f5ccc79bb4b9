"""Agreement of policies' scores between two worlds: figures, intervals and significance."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.metrics import policy
from services.evaluation.statistics import (
    Interval,
    MatchedScores,
    ScoreDraws,
    Z,
    bootstrap_scores,
    central_interval,
    known_mean,
    mmrv_of_draws,
    pearson_of_draws,
    posterior_scores,
    shortest_interval,
)


class Measure(NamedTuple):
    """A measure of agreement: its name in reports, and its function of `real` and `imagined`."""

    title: str
    compute: Callable[..., float]


# By their keys in report.json; reports and tables derive from this list.
FIGURES: Final[Mapping[str, Measure]] = {
    "pearson": Measure("Pearson", policy.pearson),
    "spearman": Measure("Spearman", policy.spearman),
    "kendall": Measure("Kendall", policy.kendall),
    "mmrv": Measure("MMRV, ties counted", partial(policy.mmrv, ties="simpler")),
    "mmrv_paper": Measure("MMRV, paper's rule", partial(policy.mmrv, ties="paper")),
    "bias": Measure("mean of imagined minus real", policy.bias),
    "mean_absolute_error": Measure("mean absolute error", policy.mean_absolute_error),
}
CORRELATIONS: Final = ("pearson", "spearman", "kendall")
# Up to this many assignments of policies are enumerated; otherwise this many are drawn.
MAX_PERMUTATIONS: Final = 50_000
_MAX_PAIRS: Final = 2_000_000  # chosen: arrays of 16 MB


@dataclass(frozen=True)
class Figure:
    """An agreement figure with its 95 % interval.

    `value` is NaN and `interval` None where it is undefined, as a correlation of two policies, or
    where all scores of a world are equal; `undefined_share` is the share of bootstrap draws in
    which it is. The interval is that of the true scores: noise biases an observed correlation
    towards zero, so the interval may lie above it.
    """

    value: float
    interval: Interval | None
    undefined_share: float


class Draws(NamedTuple):
    """Draws of one task's scores: from the posterior, for intervals, and of the bootstrap."""

    posterior: ScoreDraws
    bootstrap: ScoreDraws


@dataclass(frozen=True)
class Agreement:
    """Agreement of the policies of one task, or of all tasks together.

    `figures` has those of `FIGURES`; `without` is Pearson's r when one policy is left out, by
    policy; `chance` is the share of all assignments of imagined to real scores that correlate at
    least as well as the true one (1/6 at best with three policies), NaN where r is undefined.
    """

    figures: Mapping[str, Figure]
    without: Mapping[str, float]
    chance: float


@dataclass(frozen=True)
class Difference:
    """Mean score of one policy minus that of another over the same starts of one world.

    `p` is the exact or sampled p value of the sign-flip test, two-sided.
    """

    first: str
    second: str
    difference: float
    interval: Interval
    p: float


def task_agreement(
    policies: Sequence[str], scores: MatchedScores, generator: np.random.Generator
) -> tuple[Agreement, Draws]:
    """Agreement of one task, and the draws that its intervals are computed from.

    Scores are those of the named policies, at least two, from at least two starts.
    """
    draws = Draws(posterior_scores(scores, generator), bootstrap_scores(scores, generator))
    return pooled_agreement(policies, [scores], [draws], generator), draws


def pooled_agreement(
    policies: Sequence[str],
    tasks: Sequence[MatchedScores],
    draws: Sequence[Draws],
    generator: np.random.Generator,
) -> Agreement:
    """Agreement over all policies of all tasks at once, each pair one point.

    A pooled correlation also rewards separating easy from hard tasks; read it together with those
    of the tasks. It is undefined for fewer than three policies, since their tasks alone would
    decide it. Permutations assign policies within each task only, and `without` omits a policy in
    every task. `policies` are the same in every task, and `draws` those of `task_agreement`.
    """
    real = np.array([known_mean(scores.real, axis=1) for scores in tasks])
    imagined = np.array([known_mean(scores.imagined, axis=1) for scores in tasks])
    joined = Draws(
        *(
            ScoreDraws(*(np.concatenate(side, axis=1) for side in zip(*kind, strict=True)))
            for kind in zip(*draws, strict=True)
        )
    )
    without = {
        name: _value("pearson", np.delete(real, row, axis=1), np.delete(imagined, row, axis=1))
        for row, name in enumerate(policies)
    }
    chance = chance_of_correlation(list(real), list(imagined), generator)
    return Agreement(_figures(real, imagined, joined), without, chance)


def _value(name: str, real: np.ndarray, imagined: np.ndarray) -> float:
    """A figure over all scores [tasks, policies] at once; NaN where it is undefined."""
    if name in CORRELATIONS and real.shape[1] < policy.MIN_POLICIES:
        return math.nan
    return float(FIGURES[name].compute(real=real.ravel(), imagined=imagined.ravel()))


def _figures(real: np.ndarray, imagined: np.ndarray, draws: Draws) -> dict[str, Figure]:
    posterior, bootstrap = figures_of_draws(draws.posterior), figures_of_draws(draws.bootstrap)
    num_policies, found = real.shape[1], {}
    for name in FIGURES:
        value = _value(name, real, imagined)
        if name in CORRELATIONS and num_policies < policy.MIN_POLICIES:
            found[name] = Figure(value, None, 1.0)
            continue
        # Correlations crowd at their bound: the shortest interval contains it, quantiles do not.
        interval = shortest_interval if name in CORRELATIONS else central_interval
        drawn = posterior[name][np.isfinite(posterior[name])]
        found[name] = Figure(
            value,
            None if math.isnan(value) else interval(drawn),
            float(np.mean(~np.isfinite(bootstrap[name]))),
        )
    return found


def figures_of_draws(draws: ScoreDraws) -> dict[str, Float64[np.ndarray, " draws"]]:
    """Every figure of `FIGURES` in every draw; NaN where undefined."""
    # All pairs of policies of all tasks at once would not fit into memory.
    num_parts = -(-draws.real.size * draws.real.shape[1] // _MAX_PAIRS)
    sides = (np.array_split(side, num_parts) for side in (draws.real, draws.imagined))
    parts = [_figures_of_part(*part) for part in zip(*sides, strict=True)]
    return {name: np.concatenate([part[name] for part in parts]) for name in FIGURES}


def _figures_of_part(real: np.ndarray, imagined: np.ndarray) -> dict[str, np.ndarray]:
    orders = [np.sign(side[:, :, None] - side[:, None, :]) for side in (real, imagined)]
    gap = np.abs(real[:, :, None] - real[:, None, :])
    opposite = orders[0] * orders[1] < 0
    return {
        "pearson": pearson_of_draws(real, imagined),
        # Twice the mean ranks, but for a constant.
        "spearman": pearson_of_draws(*(order.sum(axis=2) for order in orders)),
        "kendall": pearson_of_draws(*(order.reshape(len(order), -1) for order in orders)),
        "mmrv": mmrv_of_draws(real, imagined),
        "mmrv_paper": np.asarray((gap * opposite).max(axis=2).mean(axis=1)),
        "bias": np.asarray((imagined - real).mean(axis=1)),
        "mean_absolute_error": np.asarray(np.abs(imagined - real).mean(axis=1)),
    }


def chance_of_correlation(
    real: Sequence[np.ndarray], imagined: Sequence[np.ndarray], generator: np.random.Generator
) -> float:
    """One-sided p value of Pearson's r over all assignments of policies, within each task.

    Exact up to `MAX_PERMUTATIONS` assignments; beyond, that many are drawn and the true one is
    counted among them. `real` and `imagined` are mean scores [policies] of each task; NaN where
    their correlation is undefined.
    """
    flat = np.concatenate(real)
    if min(map(len, real)) < policy.MIN_POLICIES:
        return math.nan
    observed = policy.pearson(real=flat, imagined=np.concatenate(imagined))
    if math.isnan(observed):
        return math.nan
    sizes = [len(task) for task in real]
    if math.prod(math.factorial(size) for size in sizes) <= MAX_PERMUTATIONS:
        orders = [list(itertools.permutations(task)) for task in imagined]
        shuffled = np.array([np.concatenate(one) for one in itertools.product(*orders)])
        counted = 0
    else:
        shuffled = np.concatenate(
            [generator.permuted(np.tile(task, (MAX_PERMUTATIONS, 1)), axis=1) for task in imagined],
            axis=1,
        )
        counted = 1
    found = pearson_of_draws(np.broadcast_to(flat, shuffled.shape), shuffled)
    # Assignments equal to the true one differ from it in the last bits.
    as_good = int(np.count_nonzero(found >= observed - 1e-9))
    return (as_good + counted) / (len(shuffled) + counted)


def paired_differences(
    policies: Sequence[str],
    rollouts: Float64[np.ndarray, "policies starts"],
    generator: np.random.Generator,
) -> list[Difference]:
    """Differences of mean scores of all pairs of policies over matched starts.

    A pair is compared over the starts that both have a score of, which is not NaN. The interval is
    that of Bonett and Price (2012) for paired rates, which adds one difference of +1 and one of −1;
    for graded scores in 0 … 1 the same two are added.
    """
    found = []
    for first, second in itertools.combinations(range(len(policies)), 2):
        paired = rollouts[first] - rollouts[second]
        paired = paired[np.isfinite(paired)]
        if len(paired) == 0:
            continue
        widened = np.concatenate([paired, [1.0, -1.0]])
        centre, half = widened.mean(), Z * widened.std() / math.sqrt(len(widened))
        interval = Interval(max(-1.0, float(centre - half)), min(1.0, float(centre + half)))
        found.append(
            Difference(
                policies[first],
                policies[second],
                float(paired.mean()),
                interval,
                sign_flip_p(paired, generator),
            )
        )
    return found


def sign_flip_p(differences: np.ndarray, generator: np.random.Generator) -> float:
    """Two-sided p value of a mean of paired differences [n] under random signs.

    Differences of one size count together: success rates have few sizes. Exact where their sums
    are at most `MAX_PERMUTATIONS`, as of all outcomes without repeats; 1 where all are zero.
    """
    # Shares of repeats that are equal may differ by rounding.
    rounded = np.round(differences, 12)
    sizes, counts = np.unique(np.abs(rounded[rounded != 0]), return_counts=True)
    least = abs(rounded.sum()) - 1e-9
    if math.prod((counts + 1).tolist()) > MAX_PERMUTATIONS:
        drawn = 2 * generator.binomial(counts, 0.5, (MAX_PERMUTATIONS, len(counts))) - counts
        as_large = int(np.count_nonzero(np.abs(drawn @ sizes) >= least))
        return (as_large + 1) / (MAX_PERMUTATIONS + 1)
    sums, chances = np.zeros(1), np.ones(1)
    for size, count in zip(sizes, counts.tolist(), strict=True):
        sums = np.add.outer(sums, size * np.arange(-count, count + 1, 2)).ravel()
        ways = [math.comb(count, positive) / 2**count for positive in range(count + 1)]
        chances = np.multiply.outer(chances, ways).ravel()
    return min(1.0, float(chances[np.abs(sums) >= least].sum()))
