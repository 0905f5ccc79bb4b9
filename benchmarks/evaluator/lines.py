"""Kept rows as the lines of the evaluator's table: figure, interval over starts, bound."""

import math
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from benchmarks.evaluator.chunk_lines import chunk_figures_drawn, chunk_rows
from benchmarks.evaluator.drawn import (
    POLICIES,
    Drawn,
    Line,
    Rolled,
    Sampling,
    lines_over_seeds,
    undefined,
)
from benchmarks.evaluator.kind_lines import IMAGINED, TRUE, KindFigures, policy_figures
from benchmarks.evaluator.plan import IDLE
from benchmarks.evaluator.rival_lines import rival_figures, rival_rows
from services.evaluation.settings import RISK_OF_DECIDED
from services.twin.scripted_actions import mistake_of

_LAST_IMAGE = "verdict of the last image"


class TaskFigures:
    """All figures of one task.

    The rollouts were completed in both worlds; they are the same ones for every training seed, in
    the same order. `kinds` is the name of the set of kinds of mistakes.
    """

    def __init__(
        self,
        task: str,
        by_seed: Sequence[Sequence[Rolled]],
        scripts: Sequence[str],
        kinds: str = "",
    ) -> None:
        self._task, self._by_seed = task, by_seed
        mistaken = [[one for one in mine if mistake_of(one.policy) is not None] for mine in by_seed]
        self._scripts = [[one for one in mine if one.policy in scripts] for mine in by_seed]
        self._others = [
            [one for one in mine if one.policy not in scripts and mistake_of(one.policy) is None]
            for mine in by_seed
        ]
        self._sampling = Sampling(by_seed[0])
        self._kinds = KindFigures(task, kinds, mistaken, self._scripts) if mistaken[0] else None

    def lines(self) -> list[Line]:
        """Every line of the table."""
        lines = [] if self._kinds is None else self._kinds.lines()
        if self._scripts[0]:
            pairs = zip(self._scripts, self._others, strict=True)
            lines += lines_over_seeds(self._task, [self._drawn(*pair) for pair in pairs])
        return lines

    def kind_rows(self) -> list[dict[str, Any]]:
        """Figures of the ladder of scripts, and of every kind of mistake beside it."""
        return [] if self._kinds is None else self._kinds.rows()

    def _drawn(self, scripts: Sequence[Rolled], others: Sequence[Rolled]) -> list[Drawn]:
        sampling, everything = self._sampling, [*scripts, *others]
        return [
            *_single_figures(sampling, scripts),
            *_decision_figures(sampling, scripts),
            *_policy_figures(sampling, scripts, everything),
            *_idle_figures(sampling, everything),
            *chunk_figures_drawn(sampling, scripts),
            *_wrong_action_figures(sampling, everything),
            *_still_figures(sampling, everything),
            *rival_figures(sampling, scripts, others),
        ]

    def policy_rows(self) -> list[dict[str, Any]]:
        """Success rates of every policy, and the number of its undecided rollouts."""
        rows = []
        for policy in dict.fromkeys(one.policy for one in self._by_seed[0]):
            mine = [[one for one in seed if one.policy == policy] for seed in self._by_seed]
            verdicts = [[one.rows[IMAGINED] for one in seed] for seed in mine]
            rates = [float(np.mean([v["likely_success"] for v in seed])) for seed in verdicts]
            undecided = [v["decision"] == "cannot tell" for seed in verdicts for v in seed]
            row = {
                "task": self._task,
                "policy": policy,
                "starts": len(mine[0]),
                "real": float(np.mean([one.success for one in mine[0]])),
                "imagined": float(np.mean(rates)),
                "cannot_tell": float(np.mean(undecided)),
            }
            several = {f"imagined_{number}": rate for number, rate in enumerate(rates, 1)}
            rows.append(row | (several if len(rates) > 1 else {}))
        return rows

    def rival_rows(self) -> list[dict[str, Any]]:
        """AUC and successes of every judge, over scripts and over all other policies."""
        return rival_rows(self._task, self._sampling, self._scripts, self._others)

    def chunk_rows(self) -> list[dict[str, Any]]:
        """Figures of every chunk of the scripts, by training seed where there are several."""
        several = len(self._scripts) > 1
        return [
            ({"training_seed": number} if several else {}) | row
            for number, scripts in enumerate(self._scripts, 1)
            for row in chunk_rows(self._task, scripts)
        ]


def _single_figures(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """The judge on true endings, and imagined against real success of single rollouts."""
    judge, what = "judge on true endings", "imagined against real, each rollout"
    image = "judge of the last imagined image alone"
    return [
        sampling.area(f"{judge}, AUC", TRUE, scripts, 0.97, None),
        sampling.balanced(f"{judge}, balanced accuracy", TRUE, scripts, 0.90),
        sampling.calibration("calibration error of true endings", TRUE, scripts, 0.08),
        sampling.calibration("calibration error of imagined endings", IMAGINED, scripts, 0.08),
        sampling.area(f"{what}, AUC", IMAGINED, scripts, 0.93, 0.87),
        sampling.balanced(f"{what}, balanced accuracy", IMAGINED, scripts, 0.83),
        sampling.area(f"{image}, AUC", _LAST_IMAGE, scripts, 0.93, None),
        sampling.balanced(f"{image}, balanced accuracy", _LAST_IMAGE, scripts, 0.80),
    ]


def _decision_figures(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """Share of wrong decisions; the judge's undecided band is chosen for one in twenty."""
    found = []
    for name, kind in (("true", TRUE), ("imagined", IMAGINED)):
        mine = [one for one in scripts if one.rows[kind]["decision"] != "cannot tell"]
        wrong = np.array(
            [(one.rows[kind]["decision"] == "success") != one.success for one in mine], dtype=float
        )
        what = f"wrong among the decided {name} endings"
        found.append(sampling.mean(what, wrong, mine, ("at most", RISK_OF_DECIDED)))
    return found


def _policy_figures(
    sampling: Sampling, scripts: Sequence[Rolled], everything: Sequence[Rolled]
) -> list[Drawn]:
    """Agreement of success rates over the policies that have every start."""
    figures = []
    for name, rollouts, bounds in (
        ("scripts", scripts, (0.93, 0.05)),
        ("all", everything, (0.90, 0.08)),
    ):
        starts = Counter(one.policy for one in rollouts)
        whole = [one for one in rollouts if starts[one.policy] == len(sampling.seeds)]
        what = f"{POLICIES} ({name})"
        figures += policy_figures(sampling, what, whole, attrgetter("policy"), bounds)
    return figures


def _idle_figures(sampling: Sampling, everything: Sequence[Rolled]) -> list[Drawn]:
    """Imagined success of rollouts that failed in the twin; wrong actions may succeed by chance."""
    found = []
    for policy in IDLE:
        mine = [one for one in everything if one.policy == policy and not one.success]
        values = np.array([one.rows[IMAGINED]["likely_success"] for one in mine], dtype=float)
        what = f"imagined success of {policy}"
        found.append(sampling.mean(what, values, mine, ("at most", 0.05)))
    return found


def _wrong_action_figures(sampling: Sampling, everything: Sequence[Rolled]) -> list[Drawn]:
    """Effect of another episode's commands: if the error is the same, commands are not used."""
    touch = "touch error with another episode's actions over that with their own"
    image = "chained image with their own actions less that with another episode's"
    mine = [one for one in everything if "wrong actions" in one.rows]
    if not mine:
        return [undefined(touch, ("at least", 2.0)), undefined(image, ("at least", 2.0))]
    rows = [one.rows["wrong actions"] for one in mine]
    errors = sampling.sums(np.array([row["touch_error"] for row in rows]), mine)
    ratios = [total[..., 1] / np.maximum(total[..., 0], 1e-9) for total in errors]
    psnr = np.array([row["psnr"] for row in rows]).mean(axis=1)
    gain = sampling.mean(image, psnr[:, 0] - psnr[:, 1], mine, ("at least", 2.0))
    return [
        Drawn(touch, float(ratios[0]), ratios[1], len(mine), ("at least", 2.0), "times"),
        Drawn(image, gain.value, gain.draws, len(mine), gain.bound, "dB"),
    ]


def _still_figures(sampling: Sampling, everything: Sequence[Rolled]) -> list[Drawn]:
    """Worst of the starts that were held still; there is no interval over starts."""
    touch, image = "still hands over 1000 steps, greatest pressure", "the same, image less copy"
    mine = [one.rows["held still"] for one in everything if "held still" in one.rows]
    if not mine:
        return [undefined(touch, ("at most", 2.0)), undefined(image, ("at least", -1.0))]
    pressure = max(float(row["greatest_kpa"]) for row in mine)
    psnr = np.array([row["psnr"] for row in mine]).mean(axis=1)
    gain = float((psnr[:, 0] - psnr[:, 1]).min())
    none = np.array([math.nan])
    return [
        Drawn(touch, pressure, none, len(mine), ("at most", 2.0), "kPa"),
        Drawn(image, gain, none, len(mine), ("at least", -1.0), "dB"),
    ]
