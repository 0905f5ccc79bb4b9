"""Agreement of imagination with the twin about scripts with one kind of mistake each."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from benchmarks.evaluator.drawn import (
    POLICIES,
    Bound,
    Drawn,
    Rolled,
    Sampling,
    success_rates,
    undefined,
)
from dextouch.metrics.policy import mmrv, pearson
from services.evaluation.resampling import (
    area_under_roc_of_draws,
    mmrv_of_draws,
    pearson_of_draws,
    rates_of_draws,
)

TRUE, IMAGINED = "true verdict", "imagined verdict"
_WHAT: Final = "mistakes"
_BIAS: Final[Bound] = ("at most", 0.08)
_WRONG: Final[Bound] = ("at most", 0.10)
_DECIDED: Final[Bound] = ("at least", 0.60)
_DOUBT: Final[Bound] = ("at least", 0.80)


def kind_figures(sampling: Sampling, rollouts: Sequence[Rolled]) -> list[Drawn]:
    """Figures over all kinds of mistakes."""
    verdicts = [one.rows[IMAGINED] for one in rollouts]
    success = np.array([one.success for one in rollouts], dtype=bool)
    likely = np.array([row["likely_success"] for row in verdicts], dtype=bool)
    told = np.array([row["decision"] != "cannot tell" for row in verdicts], dtype=bool)
    decided = [one for one, yes in zip(rollouts, told, strict=True) if yes]
    off = sampling.mean("", likely.astype(float) - success, rollouts, _BIAS)
    bias = Drawn(f"{_WHAT}, bias of the success rate", abs(off.value), np.abs(off.draws),
                 off.num, _BIAS)  # fmt: skip
    wrong = (likely != success).astype(float)
    return [
        sampling.area(f"{_WHAT}, each rollout, AUC", IMAGINED, rollouts, 0.90, 0.85),
        sampling.balanced(f"{_WHAT}, each rollout, balanced accuracy", IMAGINED, rollouts, 0.80),
        *_policy_figures(sampling, rollouts),
        bias,
        sampling.mean(f"{_WHAT}, wrong among the decided", wrong[told], decided, _WRONG),
        sampling.mean(f"{_WHAT}, decided", told.astype(float), rollouts, _DECIDED),
        _doubt(sampling, rollouts, wrong > 0),
        sampling.area(f"{_WHAT}, judge on true endings, AUC", TRUE, rollouts, 0.95, None),
    ]


def _policy_figures(sampling: Sampling, rollouts: Sequence[Rolled]) -> list[Drawn]:
    names = (f"{POLICIES} ({_WHAT}), Pearson", f"{POLICIES} ({_WHAT}), MMRV with ties")
    bounds: tuple[Bound, Bound] = (("at least", 0.85), ("at most", 0.12))
    rates = success_rates(rollouts, sampling.seeds)
    if rates is None:
        return [undefined(*pair) for pair in zip(names, bounds, strict=True)]
    means = {"real": rates[0].mean(axis=1), "imagined": rates[1].mean(axis=1)}
    draws = [rates_of_draws(side, sampling.counts) for side in rates]
    num = len(rates[0])
    return [
        Drawn(names[0], pearson(**means), pearson_of_draws(*draws), num, bounds[0]),
        Drawn(names[1], mmrv(**means, ties="simpler"), mmrv_of_draws(*draws), num, bounds[1]),
    ]


def doubts(rollouts: Sequence[Rolled]) -> np.ndarray:
    """How doubtful each verdict is: 1 where it cannot tell, 0 where its probability is 0 or 1."""
    rows = [one.rows[IMAGINED] for one in rollouts]
    open_ones = np.array([row["decision"] == "cannot tell" for row in rows], dtype=float)
    probability = np.array([row["probability"] for row in rows], dtype=float)
    return np.maximum(open_ones, 1 - np.abs(2 * probability - 1))


def _doubt(sampling: Sampling, rollouts: Sequence[Rolled], wrong: np.ndarray) -> Drawn:
    """Area under the ROC curve of doubt against wrong verdicts."""
    what, bound = f"{_WHAT}, doubt against wrong verdicts, AUC", _DOUBT
    if wrong.all() or not wrong.any():
        return undefined(what, bound)
    starts, doubt = sampling.starts(rollouts), doubts(rollouts)
    own = np.ones((1, len(sampling.seeds)))
    value = area_under_roc_of_draws(doubt, wrong, starts, own)
    draws = area_under_roc_of_draws(doubt, wrong, starts, sampling.counts)
    return Drawn(what, float(value[0]), draws, len(rollouts), bound)


def kind_rows(task: str, by_seed: Sequence[Sequence[Rolled]]) -> list[dict[str, Any]]:
    """One row a kind: success rates, AUC and undecided rollouts, means over training seeds."""
    rows = []
    for policy in dict.fromkeys(one.policy for one in by_seed[0]):
        mine = [[one for one in seed if one.policy == policy] for seed in by_seed]
        success = np.array([one.success for one in mine[0]], dtype=bool)
        verdicts = [[one.rows[IMAGINED] for one in seed] for seed in mine]
        row: dict[str, Any] = {
            "task": task,
            "kind": policy.removeprefix("mistake: "),
            "starts": len(success),
            "real": float(success.mean()),
            "imagined": float(np.mean([[v["likely_success"] for v in s] for s in verdicts])),
        }
        if 0 < success.sum() < len(success):
            places, own = np.zeros(len(success), dtype=int), np.ones((1, 1))
            areas = [
                area_under_roc_of_draws(
                    np.array([v["probability"] for v in s]), success, places, own
                )[0]
                for s in verdicts
            ]
            row["auc"] = float(np.mean(areas))
        row["cannot_tell"] = float(
            np.mean([[v["decision"] == "cannot tell" for v in s] for s in verdicts])
        )
        rows.append(row)
    return rows
