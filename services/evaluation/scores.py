"""Success rates of policies, their agreement between two worlds, and sentences about both."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.metrics.policy import MIN_POLICIES
from services.evaluation.agreement import (
    FIGURES,
    Agreement,
    Draws,
    paired_differences,
    pooled_agreement,
    task_agreement,
)
from services.evaluation.rendering import UNDEFINED, rendered
from services.evaluation.statistics import MatchedScores, known_mean, wilson_interval

# Endings that should be decided where classifier and world are good enough.
LEAST_DECIDED: Final = 0.60
REAL = "real"
# Smaller mean differences of success are not mentioned.
NOTABLE_BIAS = 0.05
# Changes of a correlation by one policy below this are not mentioned.
NOTABLE_INFLUENCE = 0.1
# A correlation that may be below this is not shown to be good.
VAGUE_R = 0.5
_SEED = 0
_RUBRIC_FIGURES: Final = ("pearson", "mmrv")
# Policies of one task that are compared, for the agreement over all tasks.
_Compared = tuple[tuple[str, ...], MatchedScores, Draws]


@dataclass(frozen=True)
class RolloutScore:
    """Result of one rollout.

    `success` is reported by the real world and decided by the probe elsewhere; `probability` is
    that of the probe's verdict, in the real world too, so that the probe itself can be evaluated.
    `cannot_tell` is the reason why an imagined rollout is undecided; `success` is then the more
    likely outcome, which counts in no rate. `repeat` numbers imagined rollouts that differ by
    their noise alone. `world_probability` is the world's own estimate of success, if it has one.
    `rubric_score` is the share of the rubric's points, by the milestones that the real world
    reports, or in imagined worlds the mean over what the probe deems possible; None where the task
    has no rubric or a milestone is unknown.
    """

    world: str
    policy: str
    task: str
    seed: int
    start_digest: str
    success: bool
    probability: float
    cannot_tell: str | None = None
    repeat: int = 0
    world_probability: float | None = None
    rubric_score: float | None = None


@dataclass(frozen=True)
class RolloutFailure:
    """A rollout that did not finish, which says nothing about the policy's success.

    `error` is the class of the error, `traceback` that of the policy's own code, if it raised.
    """

    world: str
    policy: str
    task: str
    seed: int
    error: str
    message: str
    traceback: str | None = None
    repeat: int = 0


Outcome = RolloutScore | RolloutFailure


@dataclass(frozen=True)
class ClosedLoopReport:
    """Every rollout of an evaluation; the first imagined world, if any, is reported.

    Failed and undecided rollouts are excluded from all rates and counted separately. A policy of
    which fewer than `LEAST_DECIDED` of the rollouts in a world are decided is not comparable there:
    its rate is reported, but not compared.
    """

    scores: tuple[RolloutScore, ...]
    imagined_worlds: tuple[str, ...]
    policies: tuple[str, ...]
    failures: tuple[RolloutFailure, ...] = ()

    @property
    def rollouts(self) -> tuple[Outcome, ...]:
        """Finished and failed rollouts."""
        return self.scores + self.failures

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks, in the order of the rollouts."""
        return tuple(dict.fromkeys(rollout.task for rollout in self.rollouts))

    def outcomes(
        self, world: str, task: str, *, only_decided: bool = False
    ) -> Float64[np.ndarray, "policies starts"]:
        """Success (1 or 0) of every policy from every start; NaN for failed rollouts.

        Rollouts that were repeated count with their share of successes. Undecided ones count with
        the likelier outcome, or not at all if `only_decided`. Raises InvalidInputError if policies
        have different starts.
        """
        scores: dict[tuple[str, int], list[RolloutScore]] = {}
        for score in self._of(world, task):
            scores.setdefault((score.policy, score.seed), []).append(score)
        failed = {(f.policy, f.seed) for f in self._failed(world, task)}
        seeds = list(dict.fromkeys(r.seed for r in self.rollouts if r.task == task))
        expected = {(policy, seed) for policy in self.policies for seed in seeds}
        digests = {(s.seed, s.start_digest) for found in scores.values() for s in found}
        if set(scores) | failed != expected or len(digests) != len(dict(digests)):
            raise InvalidInputError(
                f"scores of {world!r} in {task!r}: got policies with different starts, expected "
                "the same starts for all"
            )
        counted = {k: _decided(found) if only_decided else found for k, found in scores.items()}
        success = {key: _success_share(found) for key, found in counted.items() if found}
        rows = [[success.get((p, seed), math.nan) for seed in seeds] for p in self.policies]
        return np.array(rows)

    def _of(self, world: str, task: str) -> list[RolloutScore]:
        return [s for s in self.scores if s.world == world and s.task == task]

    def _failed(self, world: str, task: str) -> list[RolloutFailure]:
        return [f for f in self.failures if f.world == world and f.task == task]

    def policy_rows(self) -> list[dict[str, Any]]:
        """One row per policy and task: real and imagined success rate with Wilson intervals.

        Shown by pages, tables and texts of templates, and by `policy_panels`.
        """
        rows = []
        for task in self.tasks:
            for policy in self.policies:
                row: dict[str, Any] = {"policy": policy, "task": task}
                for name, world in zip(
                    (REAL, "imagined"), (REAL, *self.imagined_worlds), strict=False
                ):
                    row |= self._prefixed(name, world, task, policy)
                row["other_worlds"] = {
                    world: self._prefixed("success", world, task, policy)
                    for world in self.imagined_worlds[1:]
                }
                rows.append(row)
        return rows

    def _prefixed(self, name: str, world: str, task: str, policy: str) -> dict[str, Any]:
        figures = self.figures(world, task, policy)
        return {name: figures.pop("rate")} | {f"{name}_{k}": one for k, one in figures.items()}

    def figures(self, world: str, task: str, policy: str) -> dict[str, Any]:
        """Success rate of a policy with its Wilson interval, and what it is of."""
        mine = [s for s in self._of(world, task) if s.policy == policy]
        num_failed = sum(f.policy == policy for f in self._failed(world, task))
        found: dict[str, Any] = {"rate": UNDEFINED, "rollouts": len(mine), "failed": num_failed}
        if not mine:
            return found | {"probability": UNDEFINED}
        found["probability"] = float(np.mean([s.probability for s in mine]))
        found["undecided"] = len(mine) - len(_decided(mine))
        found["comparable"] = self._is_comparable(world, task, policy)
        if math.isfinite(rubric := self._rubric(world, task, policy)):
            found["rubric"] = rubric
        # Repeats of one start are one observation of the policy.
        starts: dict[int, list[RolloutScore]] = {}
        for score in _decided(mine):
            starts.setdefault(score.seed, []).append(score)
        if starts:
            successes = sum(map(_success_share, starts.values()))
            interval = wilson_interval(successes, len(starts))
            found |= {"rate": successes / len(starts), "interval": [interval.low, interval.high]}
        return found

    def _is_comparable(self, world: str, task: str, policy: str) -> bool:
        mine = [s for s in self._of(world, task) if s.policy == policy]
        return len(_decided(mine)) >= LEAST_DECIDED * len(mine)

    def agreement(self, world: str) -> dict[str, dict[str, Any]]:
        """Agreement of the policies' success rates in a world with the real ones, by task.

        `mmrv` counts ties (`ties="simpler"`); `mmrv_paper` does not, so it is 0 for a world that
        gives every policy the same score. `rates` are the compared success rates, over the
        `num_starts` starts that finished in both worlds for every policy; the imagined ones are of
        the decided rollouts among them, and policies in `not_comparable` are left out. Correlations
        need three policies; with fewer they are "undefined (2 policies)". With two policies and
        two starts or more, every figure has a 95 % interval of the true scores' figure and the
        share of bootstrap draws in which it is undefined; `pearson_without` leaves one policy out,
        `pearson_chance` is the permutation p value, and `differences` compares policies in pairs.
        """
        return {task: self._agreement(world, task)[0] for task in self.tasks}

    def rubric_agreement(self, world: str) -> dict[str, dict[str, Any]]:
        """Agreement of the policies' mean rubric scores in a world with the real ones, by task.

        Over all rollouts, decided or not, of policies and tasks that have scores in both worlds.
        """
        found = {}
        for task in self.tasks:
            worlds = {"real": REAL, "imagined": world}
            means = {
                side: np.array([self._rubric(name, task, policy) for policy in self.policies])
                for side, name in worlds.items()
            }
            known = np.isfinite(means["real"]) & np.isfinite(means["imagined"])
            if num_policies := int(known.sum()):
                pair = {side: values[known] for side, values in means.items()}
                figures = {name: FIGURES[name].compute(**pair) for name in _RUBRIC_FIGURES}
                found[task] = {name: defined(one, num_policies) for name, one in figures.items()}
                found[task]["num_policies"] = num_policies
        return found

    def _rubric(self, world: str, task: str, policy: str) -> float:
        """Mean rubric score of the rollouts that have one; NaN where none has."""
        scores = [s.rubric_score for s in self._of(world, task) if s.policy == policy]
        known = [score for score in scores if score is not None]
        return float(np.mean(known)) if known else math.nan

    def _agreements(self, world: str) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        """Report entries by task, and over all tasks at once if they compare the same policies."""
        found = {task: self._agreement(world, task) for task in self.tasks}
        by_task = {task: entries for task, (entries, _) in found.items()}
        compared = [one for _, one in found.values() if one is not None]
        if len(compared) < max(2, len(found)) or len({names for names, _, _ in compared}) > 1:
            return by_task, {}
        (policies, *_), scores, draws = zip(*compared, strict=True)
        pooled = pooled_agreement(policies, scores, draws, np.random.default_rng(_SEED))
        return by_task, _entries(pooled, len(policies))

    def _agreement(self, world: str, task: str) -> tuple[dict[str, Any], _Compared | None]:
        vague = [p for p in self.policies if not self._is_comparable(world, task, p)]
        kept = np.array([policy not in vague for policy in self.policies])
        names = [policy for policy in self.policies if policy not in vague]
        compared, real, imagined = matched(
            names,
            self.outcomes(REAL, task)[kept],
            self.outcomes(world, task)[kept],
            self.outcomes(world, task, only_decided=True)[kept],
        )
        if real.size == 0:
            undefined = dict.fromkeys(FIGURES, UNDEFINED)
            counts = {"num_policies": 0, "num_starts": 0, "rates": {}, "not_comparable": vague}
            return undefined | counts, None
        pair = {"real": real.mean(axis=1), "imagined": known_mean(imagined, axis=1)}
        figures = {name: measure.compute(**pair) for name, measure in FIGURES.items()}
        found: dict[str, Any] = {n: defined(one, len(real)) for n, one in figures.items()}
        joined = None
        if min(real.shape) >= 2:
            generator = np.random.default_rng(_SEED)
            scores = MatchedScores(real, imagined)
            agreement, draws = task_agreement(compared, scores, generator)
            joined = tuple(compared), scores, draws
            found |= _entries(agreement, len(real))
            found["differences"] = {
                world: _differences(compared, outcomes, generator)
                for world, outcomes in ((REAL, real), ("imagined", imagined))
            }
        found |= {
            "num_policies": len(real),
            "num_starts": real.shape[1],
            "not_comparable": vague,
            "rates": {
                policy: {side: float(rates[row]) for side, rates in pair.items()}
                for row, policy in enumerate(compared)
            },
        }
        return found, joined

    def real_differences(self, task: str) -> list[dict[str, Any]]:
        """Differences of pairs of policies in the real world, over starts that ended for all."""
        outcomes = self.outcomes(REAL, task)
        compared, real, _ = matched(self.policies, outcomes, outcomes, outcomes)
        return _differences(compared, real, np.random.default_rng(_SEED)) if real.size else []

    def probe_accuracy(self) -> float | str:
        """Share of real rollouts whose outcome the probe classifies correctly."""
        real = [s for s in self.scores if s.world == REAL]
        if not real:
            return UNDEFINED
        return float(np.mean([(s.probability >= 0.5) == s.success for s in real]))

    def to_report(self) -> dict[str, Any]:
        """Report entries as plain JSON: `policies`, `agreement` and the rest."""
        first, *others = self.imagined_worlds or (None,)
        rows = self.policy_rows()
        agreement, pooled = ({}, {}) if first is None else self._agreements(first)
        return {
            "policies": rows,
            "agreement": agreement,
            "agreement_of_all_tasks": pooled,
            "comments": {
                task: task_comments([r for r in rows if r["task"] == task], found, str(first))
                for task, found in agreement.items()
            },
            "real_differences": {task: self.real_differences(task) for task in self.tasks},
            "agreement_of_other_worlds": {world: self.agreement(world) for world in others},
            "rubrics": {world: self.rubric_agreement(world) for world in self.imagined_worlds},
            "imagined_world": first,
            "probe_accuracy_on_real": self.probe_accuracy(),
            "num_rollouts": len(self.rollouts),
            "rollouts": [asdict(score) for score in self.scores],
            "failures": [asdict(failure) for failure in self.failures],
        }


def _differences(
    policies: Sequence[str], outcomes: np.ndarray, generator: np.random.Generator
) -> list[dict[str, Any]]:
    return [
        asdict(one) | {"interval": [one.interval.low, one.interval.high]}
        for one in paired_differences(policies, outcomes, generator)
    ]


def _decided(scores: Sequence[RolloutScore]) -> list[RolloutScore]:
    return [score for score in scores if score.cannot_tell is None]


def _success_share(scores: Sequence[RolloutScore]) -> float:
    return sum(score.success for score in scores) / len(scores)


def matched(
    policies: Sequence[str], real: np.ndarray, imagined: np.ndarray, decided: np.ndarray
) -> tuple[
    list[str], Float64[np.ndarray, "policies starts"], Float64[np.ndarray, "policies starts"]
]:
    """Compared policies, and their outcomes [policies, starts] in both worlds.

    Excludes policies without a start that finished in both worlds, then starts that did not
    finish in both worlds for every remaining policy, then policies without a decided one of these.
    `imagined` has the likelier outcome of undecided rollouts, `decided` NaN.
    """
    known = np.isfinite(real) & np.isfinite(imagined)
    rows = known.any(axis=1)
    columns = known[rows].all(axis=0)
    rows &= np.isfinite(decided[:, columns]).any(axis=1)
    compared = [policy for policy, kept in zip(policies, rows, strict=True) if kept]
    return compared, real[rows][:, columns], decided[rows][:, columns]


def _entries(agreement: Agreement, num_policies: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, figure in agreement.figures.items():
        interval = figure.interval
        found[name] = defined(figure.value, num_policies)
        found[f"{name}_interval"] = [interval.low, interval.high] if interval else UNDEFINED
        found[f"{name}_undefined_share"] = figure.undefined_share
    without = agreement.without.items()
    found["pearson_without"] = {name: defined(r, num_policies - 1) for name, r in without}
    found["pearson_chance"] = defined(agreement.chance, num_policies)
    return found


def defined(value: float, num_policies: int) -> float | str:
    """The value, or "undefined" for NaN, which JSON does not have, with the reason if it is few."""
    return value if math.isfinite(value) else undefined_by(num_policies)


def undefined_by(num_policies: int) -> str:
    """Text of an undefined figure; it names the number of policies if they are too few."""
    if 0 < num_policies < MIN_POLICIES:
        return f"{UNDEFINED} ({num_policies} {'policy' if num_policies == 1 else 'policies'})"
    return UNDEFINED


def task_comments(
    rows: Sequence[Mapping[str, Any]], agreement: Mapping[str, Any], world: str
) -> list[str]:
    """Sentences about one task, from its rows of `policy_rows` and its figures of `agreement`."""
    compared = [
        row
        for row in rows
        if UNDEFINED not in {row["real"], row["imagined"]} and row["imagined_comparable"]
    ]
    text = rendered(
        "comments.txt.j2",
        rows=rows,
        found=agreement,
        world=world,
        num_compared=len(compared),
        gaps={
            "overrates": _separated(compared, "real", "imagined"),
            "underrates": _separated(compared, "imagined", "real"),
        },
        influence=_most_influential(agreement),
        least_decided=f"{LEAST_DECIDED:.0%}",
        notable_bias=NOTABLE_BIAS,
        min_policies=MIN_POLICIES,
        vague_r=VAGUE_R,
    )
    return text.splitlines()


def _separated(rows: Sequence[Mapping[str, Any]], low: str, high: str) -> list[Mapping[str, Any]]:
    found = [row for row in rows if row[f"{low}_interval"][1] < row[f"{high}_interval"][0]]
    return sorted(found, key=lambda row: -abs(row["imagined"] - row["real"]))


def _most_influential(agreement: Mapping[str, Any]) -> str | None:
    """The policy without which Pearson's r would differ most, if it would notably."""
    r, without = agreement["pearson"], agreement.get("pearson_without", {})
    moved = {n: abs(one - r) for n, one in without.items() if not isinstance(one, str)}
    name = max(moved, key=moved.__getitem__, default=None)
    return name if name is not None and moved[name] >= NOTABLE_INFLUENCE else None
