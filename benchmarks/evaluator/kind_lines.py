"""Lines and rows of scripts with mistakes: one group over all kinds, and one for each."""

import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, Final

import numpy as np

from benchmarks.evaluator.drawn import (
    POLICIES,
    Bound,
    Drawn,
    Line,
    Rolled,
    Sampling,
    lines_over_seeds,
    undefined,
)
from benchmarks.evaluator.resampling import rates_of_draws
from dextouch.metrics.policy import mmrv, pearson
from services.evaluation.statistics import mmrv_of_draws, pearson_of_draws
from services.twin.scripted_actions import mistake_of

# Rows of a rollout that has no others than these.
VERDICTS: Final = ("real", "true verdict", "imagined verdict")
TRUE, IMAGINED = VERDICTS[1:]
_OF_DRAWS: Final = (pearson_of_draws, mmrv_of_draws)
_LADDER: Final = "position (ladder)"
BySeed = Sequence[Sequence[Rolled]]


class KindFigures:
    """Figures of one task about scripts with mistakes of a set of kinds.

    The rollouts are the same ones for every training seed, in the same order; beside them stand
    those of the scripts that err in position only, the ladder.
    """

    def __init__(self, task: str, name: str, by_seed: BySeed, ladder: BySeed) -> None:
        self._task, self._name, self._by_seed, self._ladder = task, name, by_seed, ladder
        self._sampling = Sampling([*by_seed[0], *ladder[0]])

    def lines(self) -> list[Line]:
        """The figures over all kinds."""
        return lines_over_seeds(self._task, [self._drawn(mine) for mine in self._by_seed])

    def _drawn(self, rollouts: Sequence[Rolled]) -> list[Drawn]:
        what = f"mistakes ({self._name})"
        policies: dict[str, Callable[[Rolled], str]] = {
            "kinds and strengths": attrgetter("policy"),
            "kinds": kind_of,
        }
        return [
            *group_figures(self._sampling, what, rollouts),
            *(
                figure
                for name, policy_of in policies.items()
                for figure in policy_figures(
                    self._sampling,
                    f"{POLICIES} ({self._name} {name})",
                    rollouts,
                    policy_of,
                    (0.85, 0.12),
                )
            ),
        ]

    def rows(self) -> list[dict[str, Any]]:
        """Means over the training seeds for the ladder, all kinds, and each kind.

        With several training seeds also the least and the greatest AUC.
        """
        groups: dict[str, BySeed] = {_LADDER: self._ladder, f"all {self._name}": self._by_seed}
        groups |= {
            kind: [[one for one in seed if kind_of(one) == kind] for seed in self._by_seed]
            for kind in dict.fromkeys(map(kind_of, self._by_seed[0]))
        }
        return [
            {"task": self._task, "mistakes": name} | self._row(mine)
            for name, mine in groups.items()
            if mine[0]
        ]

    def _row(self, by_seed: BySeed) -> dict[str, Any]:
        found = [group_figures(self._sampling, "", seed) for seed in by_seed]
        means = [float(np.mean([one.value for one in same])) for same in zip(*found, strict=True)]
        first = by_seed[0]
        told = [[one.rows[IMAGINED]["likely_success"] for one in seed] for seed in by_seed]
        row: dict[str, Any] = {
            "rollouts": len(first),
            "real": float(np.mean([one.success for one in first])),
            "imagined": float(np.mean(told)),
            **{
                name: mean if math.isfinite(mean) else None
                for name, mean in zip(_COLUMNS, means, strict=True)
            },
        }
        areas = [seed[0].value for seed in found]
        if len(areas) > 1 and np.isfinite(areas).all():
            row |= {"auc_least": min(areas), "auc_greatest": max(areas)}
        return row


# Names of `group_figures` in rows.
_COLUMNS: Final = (
    "auc", "balanced_accuracy", "bias", "wrong_of_decided", "decided", "auc_of_uncertainty",
    "auc_of_true_endings",
)  # fmt: skip


def group_figures(sampling: Sampling, what: str, rollouts: Sequence[Rolled]) -> list[Drawn]:
    """Figures of single rollouts of one training seed, in the order of the table's columns."""
    each = f"{what}, imagined against real, each rollout"
    success = np.array([one.success for one in rollouts], dtype=bool)
    verdicts = [one.rows[IMAGINED] for one in rollouts]
    likely = np.array([verdict["likely_success"] for verdict in verdicts], dtype=bool)
    decided = np.array([_is_decided(verdict) for verdict in verdicts], dtype=bool)
    wrong = likely != success
    told = [one for one, sure in zip(rollouts, decided, strict=True) if sure]
    uncertainty = np.array([uncertainty_of(verdict) for verdict in verdicts])
    too_many: Bound = ("at most", 0.08)
    off = sampling.mean(
        f"{what}, bias of the success rate", likely.astype(float) - success, rollouts, too_many
    )
    return [
        sampling.area(f"{each}, AUC", IMAGINED, rollouts, 0.90, 0.85),
        sampling.balanced(f"{each}, balanced accuracy", IMAGINED, rollouts, 0.80),
        Drawn(off.what, abs(off.value), abs(off.draws), off.num, off.bound),
        sampling.mean(
            f"{what}, wrong among the decided", wrong[decided].astype(float), told,
            ("at most", 0.10),
        ),
        sampling.mean(f"{what}, decided", decided.astype(float), rollouts, ("at least", 0.60)),
        sampling.area_of(
            f"{what}, uncertainty of wrong verdicts, AUC",
            (uncertainty, wrong),
            rollouts,
            ("at least", 0.80),
        ),
        sampling.area(f"{what}, judge on true endings, AUC", TRUE, rollouts, 0.95, None),
    ]  # fmt: skip


def policy_figures(
    sampling: Sampling,
    what: str,
    rollouts: Sequence[Rolled],
    policy_of: Callable[[Rolled], str],
    bounds: tuple[float, float],
) -> list[Drawn]:
    """Agreement of success rates over policies, each from its own starts.

    `bounds` are the least correlation and the greatest MMRV.
    """
    names = list(dict.fromkeys(map(policy_of, rollouts)))
    shape = (len(names), len(sampling.seeds))
    count, real, told = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for one, start in zip(rollouts, sampling.starts(rollouts), strict=True):
        at = names.index(policy_of(one)), start
        count[at] += 1
        real[at] += one.success
        told[at] += one.rows[IMAGINED]["likely_success"]
    about: tuple[tuple[str, Bound], ...] = (
        (f"{what}, Pearson", ("at least", bounds[0])),
        (f"{what}, MMRV with ties", ("at most", bounds[1])),
    )
    if len(names) < 2:
        return [undefined(*each) for each in about]
    sides = {"real": real, "imagined": told}
    means = {name: rates_of_draws(side, count, sampling.own)[0] for name, side in sides.items()}
    draws = [rates_of_draws(side, count, sampling.counts) for side in sides.values()]
    values = (pearson(**means), mmrv(**means, ties="simpler"))
    # A draw may lack all starts of a policy: its figures are undefined.
    whole = np.isfinite(draws[0]).all(axis=1)
    drawn = np.full((2, len(whole)), np.nan)
    drawn[:, whole] = [of(*(side[whole] for side in draws)) for of in _OF_DRAWS]
    return [
        Drawn(title, value, each, len(names), bound)
        for (title, bound), value, each in zip(about, values, drawn, strict=True)
    ]


def kind_of(one: Rolled) -> str:
    """The kind of mistake of a rollout.

    Raises:
        ValueError: a policy without a mistake.
    """
    mistake = mistake_of(one.policy)
    if mistake is None:
        raise ValueError(f"got policy {one.policy!r}, expected one with a mistake")
    return mistake.kind


def uncertainty_of(verdict: Mapping[str, Any]) -> float:
    """How unreliable a verdict is: more than 1 if it is left open, otherwise by its probability."""
    return float(not _is_decided(verdict)) + 1 - abs(2 * float(verdict["probability"]) - 1)


def _is_decided(verdict: Mapping[str, Any]) -> bool:
    return bool(verdict["decision"] != "cannot tell")
