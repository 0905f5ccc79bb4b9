"""Kept rows as the lines of the evaluator's table: figure, interval over starts, bound."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.metrics.policy import mmrv, pearson
from services.cli.bench.evaluator.plan import IDLE
from services.cli.bench.figures import Requirement, Sense
from services.evaluation.calibration import expected_calibration_error
from services.evaluation.resampling import (
    area_under_roc_of_draws,
    balanced_accuracy_of_draws,
    mean_of_draws,
    mmrv_of_draws,
    pearson_of_draws,
    rates_of_draws,
    start_counts,
)
from services.evaluation.statistics import interval_of_draws

NUM_DRAWS: Final = 1000
# Least AUC and balanced accuracy of imagined against real success, by task where it is easier.
_PER_ROLLOUT: Final = {"stand_bottle": (0.96, 0.90)}
_PER_ROLLOUT_ELSEWHERE: Final = (0.93, 0.84)


@dataclass(frozen=True)
class Line:
    """One line of the table; `value` is None where it is not defined, or nothing was rolled out.

    `interval` is the 95 % bootstrap interval over the starts.
    """

    task: str
    what: str
    value: float | None
    interval: tuple[float, float] | None
    num: int
    sense: Sense
    bound: float
    unit: str = ""

    def requirement(self) -> Requirement:
        """The line as a promise that is kept or not."""
        what = f"{self.task}: {self.what}"
        return Requirement(what, self.value, self.sense, self.bound, self.unit)


@dataclass(frozen=True)
class Rolled:
    """One policy from one start, with everything that is kept of it."""

    policy: str
    seed: int
    success: bool
    truth: Mapping[str, Any]
    imagined: Mapping[str, Any]
    chunks: Mapping[str, Any]


class TaskFigures:
    """All figures of one task.

    Args:
        task: its name.
        rollouts: that ended in both worlds.
        scripts: names of the scripted policies.
    """

    def __init__(self, task: str, rollouts: Sequence[Rolled], scripts: Sequence[str]) -> None:
        self._task, self._all = task, list(rollouts)
        self._scripts = [one for one in rollouts if one.policy in scripts]
        self._seeds = sorted({one.seed for one in rollouts})
        generator = np.random.default_rng(0)
        self._counts = start_counts(max(1, len(self._seeds)), generator, num_draws=NUM_DRAWS)

    def lines(self) -> list[Line]:
        """Every line of the table."""
        return [
            *self._judge_lines(),
            *self._rollout_lines(),
            *self._policy_lines(),
            *self._idle_lines(),
            *self._chunk_lines(),
        ]

    def _judge_lines(self) -> list[Line]:
        told = partial(_probabilities, kind="truth")
        what = "judge on true endings"
        return [
            self._area(f"{what}, AUC", told, 0.97),
            self._balanced(f"{what}, balanced accuracy", "truth", 0.90),
            self._calibration("calibration error of true endings", "truth"),
            self._calibration("calibration error of imagined endings", "imagined"),
        ]

    def _rollout_lines(self) -> list[Line]:
        area, balanced = _PER_ROLLOUT.get(self._task, _PER_ROLLOUT_ELSEWHERE)
        told = partial(_probabilities, kind="imagined")
        what = "imagined against real, each rollout"
        return [
            self._area(f"{what}, AUC", told, area),
            self._balanced(f"{what}, balanced accuracy", "imagined", balanced),
        ]

    def _policy_lines(self) -> list[Line]:
        lines = []
        for name, rollouts, worst in (("scripts", self._scripts, 0.03), ("all", self._all, 0.08)):
            rates = _rates(rollouts, self._seeds)
            if rates is None:
                continue
            real, imagined = rates
            means = {"real": real.mean(axis=1), "imagined": imagined.mean(axis=1)}
            draws = [rates_of_draws(side, self._counts) for side in rates]
            lines += [
                self._line(
                    f"policies ({name}), Pearson", pearson(**means),
                    pearson_of_draws(*draws), len(real), ("at least", 0.93),
                ),
                self._line(
                    f"policies ({name}), MMRV with ties", mmrv(**means, ties="simpler"),
                    mmrv_of_draws(*draws), len(real), ("at most", worst),
                ),
            ]  # fmt: skip
        return lines

    def _idle_lines(self) -> list[Line]:
        """Imagined success of what failed in reality: chance may let other actions succeed."""
        lines = []
        for policy in IDLE:
            mine = [one for one in self._all if one.policy == policy and not one.success]
            values = np.array([one.imagined["likely_success"] for one in mine], dtype=float)
            draws = mean_of_draws(values, self._starts(mine), self._counts)
            value = float(values.mean()) if len(values) else math.nan
            what = f"imagined success of {policy}"
            lines.append(self._line(what, value, draws, len(mine), ("at most", 0.05)))
        return lines

    def _chunk_lines(self) -> list[Line]:
        """Of scripts alone: where nothing moves, a copy is as good as the truth."""
        if not self._scripts:
            return []
        counts = self._contact_counts()
        margins = f1(counts[0].sum(axis=0)) - f1(counts[1].sum(axis=0))
        starts = self._starts(self._scripts)
        drawn = [np.tensordot(self._counts[:, starts], each, axes=1) for each in counts]
        over_draws = (f1(drawn[0]) - f1(drawn[1]))[:, :4].min(axis=1)
        num = len(self._scripts)
        what = "chained contact F1 less copy, worst of chunks 1 to 4"
        lines = [self._line(what, float(margins[:4].min()), over_draws, num, ("at least", 0.0))]
        for name, what, bound in (
            ("psnr", "chained image less warped start, worst of chunks 2 to 5", 1.0),
            ("psnr_of_objects", "the same where objects are or were", 0.0),
        ):
            whole, both = self._image_figures(name)
            if not whole:
                continue
            gains = both[..., 0] - both[..., 1]
            draws = np.stack(
                [mean_of_draws(gain, self._starts(whole), self._counts) for gain in gains.T[1:]]
            ).min(axis=0)
            value = float(gains.mean(axis=0)[1:].min())
            lines.append(self._line(what, value, draws, len(whole), ("at least", bound), "dB"))
        return lines

    def _contact_counts(self) -> list[np.ndarray]:
        """Counts [rollouts, chunks, 3] of the imagined touch and of the copied one."""
        names = ("contact", "contact_of_copy")
        return [np.array([one.chunks[name] for one in self._scripts]) for name in names]

    def _image_figures(self, name: str) -> tuple[list[Rolled], np.ndarray]:
        """Scripts whose every chunk has this figure, and PSNR [rollouts, chunks, 2] of them."""
        whole = [r for r in self._scripts if len(r.chunks[name]) == len(r.chunks["psnr"])]
        return whole, np.array([one.chunks[name] for one in whole])

    def policy_rows(self) -> list[dict[str, Any]]:
        """Success rates of every policy, and how many of its rollouts the judge cannot tell."""
        rows = []
        for policy in dict.fromkeys(one.policy for one in self._all):
            mine = [one for one in self._all if one.policy == policy]
            undecided = [one.imagined["decision"] == "cannot tell" for one in mine]
            rows.append(
                {
                    "task": self._task,
                    "policy": policy,
                    "starts": len(mine),
                    "real": float(np.mean([one.success for one in mine])),
                    "imagined": float(np.mean([one.imagined["likely_success"] for one in mine])),
                    "cannot_tell": float(np.mean(undecided)),
                }
            )
        return rows

    def chunk_rows(self) -> list[dict[str, Any]]:
        """Chained contact F1 and PSNR of every chunk of the scripts, each beside its rival."""
        if not self._scripts:
            return []
        contact, copied = (f1(each.sum(axis=0)) for each in self._contact_counts())
        rows: list[dict[str, Any]] = [
            {"task": self._task, "chunk": 1 + chunk, "f1": told, "f1_of_copy": copy}
            for chunk, (told, copy) in enumerate(
                zip(contact.tolist(), copied.tolist(), strict=True)
            )
        ]
        for name in ("psnr", "psnr_of_objects"):
            whole, both = self._image_figures(name)
            for row, pair in zip(rows, both.mean(axis=0) if whole else [], strict=False):
                row[name], row[f"{name}_of_warped_start"] = (float(value) for value in pair)
        return rows

    def _starts(self, rollouts: Iterable[Rolled]) -> np.ndarray:
        return np.array([self._seeds.index(one.seed) for one in rollouts], dtype=int)

    def _area(
        self, what: str, told: Callable[[Iterable[Rolled]], np.ndarray], bound: float
    ) -> Line:
        scores, success = told(self._scripts), _successes(self._scripts)
        if success.all() or not success.any():
            return self._line(what, math.nan, np.array([math.nan]), 0, ("at least", bound))
        own = np.ones((1, len(self._seeds)))
        starts = self._starts(self._scripts)
        value = float(area_under_roc_of_draws(scores, success, starts, own)[0])
        draws = area_under_roc_of_draws(scores, success, starts, self._counts)
        return self._line(what, value, draws, len(scores), ("at least", bound))

    def _balanced(self, what: str, kind: str, bound: float) -> Line:
        success = _successes(self._scripts)
        likely = np.array([getattr(one, kind)["likely_success"] for one in self._scripts], bool)
        if success.all() or not success.any():
            return self._line(what, math.nan, np.array([math.nan]), 0, ("at least", bound))
        starts = self._starts(self._scripts)
        own = np.ones((1, len(self._seeds)))
        value = float(balanced_accuracy_of_draws(likely, success, starts, own)[0])
        draws = balanced_accuracy_of_draws(likely, success, starts, self._counts)
        return self._line(what, value, draws, len(success), ("at least", bound))

    def _calibration(self, what: str, kind: str) -> Line:
        told, came = _probabilities(self._scripts, kind=kind), _successes(self._scripts)
        if len(told) == 0:
            return self._line(what, math.nan, np.array([math.nan]), 0, ("at most", 0.1))
        starts = self._starts(self._scripts)
        draws = []
        for row in self._counts[:200]:
            chosen = np.repeat(np.arange(len(told)), row[starts].astype(int))
            draws.append(expected_calibration_error(told[chosen], came[chosen]))
        value = expected_calibration_error(told, came)
        return self._line(what, value, np.array(draws), len(told), ("at most", 0.1))

    def _line(
        self,
        what: str,
        value: float,
        draws: np.ndarray,
        num: int,
        bound: tuple[Sense, float],
        unit: str = "",
    ) -> Line:
        found = interval_of_draws(draws).interval if num else None
        interval = None if found is None else (found.low, found.high)
        shown = value if math.isfinite(value) else None
        return Line(self._task, what, shown, interval, num, bound[0], bound[1], unit)


def f1(counts: np.ndarray) -> Float64[np.ndarray, "*batch"]:
    """F1 of contact counts [..., 3]: in both, predicted, true; 1 where nothing touches at all."""
    both, total = counts[..., 0], counts[..., 1] + counts[..., 2]
    return np.asarray(np.where(total > 0, 2 * both / np.maximum(total, 1), 1.0))


def _successes(rollouts: Iterable[Rolled]) -> np.ndarray:
    return np.array([one.success for one in rollouts], dtype=bool)


def _probabilities(rollouts: Iterable[Rolled], *, kind: str) -> np.ndarray:
    return np.array([getattr(one, kind)["probability"] for one in rollouts], dtype=float)


def _rates(
    rollouts: Sequence[Rolled], seeds: Sequence[int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Real and imagined outcomes [policies, starts] of the policies that have every start."""
    found = {(one.policy, one.seed): one for one in rollouts}
    names = [
        name
        for name in dict.fromkeys(one.policy for one in rollouts)
        if all((name, seed) in found for seed in seeds)
    ]
    if len(names) < 2:
        return None
    grid = [[found[name, seed] for seed in seeds] for name in names]
    real = np.array([[one.success for one in row] for row in grid], dtype=float)
    told = [[one.imagined["likely_success"] for one in row] for row in grid]
    return real, np.array(told, dtype=float)
