"""Lines that compare imagination and touch with baselines that judge the same rollouts."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from benchmarks.evaluator.drawn import (
    Drawn,
    Rolled,
    Sampling,
    having,
    lines_over_seeds,
    probabilities,
    undefined,
)

# Names of the judges in tables, by the kind of row.
JUDGES: Final = {
    "imagined verdict": "imagined ending",
    "verdict without touch": "imagined ending, touch at zero",
    "verdict of a world without touch": "world trained without touch",
    "direct verdict": "direct judge",
}
SCRIPTS, OTHERS = "scripts", "other policies"
_DIRECT, _TOUCHLESS = "direct verdict", "verdict without touch"
_UNTOUCHED = "verdict of a world without touch"
_LESS: Final = {
    _DIRECT: "the direct judge's",
    _TOUCHLESS: "those with touch at zero",
    _UNTOUCHED: "those of a world trained without touch",
}


def rival_figures(
    sampling: Sampling, scripts: Sequence[Rolled], others: Sequence[Rolled]
) -> list[Drawn]:
    """Difference of AUC between imagined endings and each available baseline."""
    found = []
    for kind, rollouts, where in (
        (_DIRECT, scripts, SCRIPTS),
        (_DIRECT, others, OTHERS),
        (_TOUCHLESS, scripts, SCRIPTS),
        (_UNTOUCHED, scripts, SCRIPTS),
    ):
        mine = having(kind, rollouts)[0]
        if not mine:
            continue
        what = f"AUC of imagined endings less {_LESS[kind]}, {where}"
        if np.array_equal(probabilities(mine, "imagined verdict"), probabilities(mine, kind)):
            # Equal probabilities: the baseline got the same input, so there is nothing to compare.
            found.append(undefined(what, ("at least", 0.0)))
            continue
        ours, theirs = (
            sampling.area("", each, mine, 0.0, None) for each in ("imagined verdict", kind)
        )
        found.append(ours.less(theirs, what, 0.0))
    return found


def rival_rows(
    task: str,
    sampling: Sampling,
    scripts_by_seed: Sequence[Sequence[Rolled]],
    others_by_seed: Sequence[Sequence[Rolled]],
) -> list[dict[str, Any]]:
    """AUC with its interval of every judge over scripts and over other policies.

    `called_success` is the share of rollouts that the judge considers likely successes, next to
    the share that succeeded.
    """
    rows = []
    for where, seeds in ((SCRIPTS, scripts_by_seed), (OTHERS, others_by_seed)):
        for kind, name in JUDGES.items():
            mine = [having(kind, rollouts)[0] for rollouts in seeds]
            if not all(mine):
                continue
            areas = [[sampling.area(name, kind, rollouts, 0.0, None)] for rollouts in mine]
            line = lines_over_seeds(task, areas)[0]
            called = [[one.rows[kind]["likely_success"] for one in rollouts] for rollouts in mine]
            rows.append(
                {
                    "task": task,
                    "judge": name,
                    "policies": where,
                    "auc": line.value,
                    "low": line.interval[0] if line.interval else None,
                    "high": line.interval[1] if line.interval else None,
                    "called_success": float(np.mean(called)),
                    "succeeded": float(np.mean([one.success for one in mine[0]])),
                }
            )
    return rows
