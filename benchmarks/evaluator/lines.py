"""Kept rows as the lines of the evaluator's table: figure, interval over starts, bound."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from benchmarks.evaluator.drawn import (
    POLICIES,
    Bound,
    Drawn,
    Line,
    Rolled,
    Sampling,
    having,
    lines_over_seeds,
    probabilities,
    rates_of_draws,
    undefined,
)
from benchmarks.evaluator.plan import IDLE
from dextouch.metrics.policy import mmrv, pearson
from services.evaluation.settings import RISK_OF_DECIDED
from services.evaluation.statistics import mmrv_of_draws, pearson_of_draws
from services.twin.stage import mistake_of

_IMAGES = ("psnr", "psnr_of_objects")
_COPY, _CONTEXT = "chained contact F1 less copy", "chained contact F1 over F1 with true context"
_WHERE = "worst chunk where anything moves"


def f1(counts: np.ndarray) -> Float64[np.ndarray, "*batch"]:
    """F1 of contact counts [..., 3]: in both, predicted, true; 1 where nothing touches at all."""
    both, total = counts[..., 0], counts[..., 1] + counts[..., 2]
    return np.asarray(np.where(total > 0, 2 * both / np.maximum(total, 1), 1.0))


def _contact(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """F1 of moving chunks; contacts of all rollouts are pooled by chunk index."""
    names = (f"{_COPY}, {_WHERE}", f"{_CONTEXT}, {_WHERE}")
    bounds = (0.0, 0.85)
    mine = [one for one in scripts if "true context" in one.rows]
    moves = moving(mine)
    if not moves.any():
        return [undefined(what, ("at least", b)) for what, b in zip(names, bounds, strict=True)]
    chained, copied, context = (
        [f1(total[..., moves.any(axis=0), :]) for total in sampling.sums(counts, mine)]
        for counts in contact_counts_of(mine)
    )
    less = [ours - theirs for ours, theirs in zip(chained, copied, strict=True)]
    # A share of 1 where neither is right about anything.
    shares = [
        np.where(theirs > 0, ours / np.where(theirs > 0, theirs, 1.0), 1.0)
        for ours, theirs in zip(chained, context, strict=True)
    ]
    return [
        Drawn(what, float(value.min()), draws.min(axis=1), len(mine), ("at least", bound))
        for what, (value, draws), bound in zip(names, (less, shares), bounds, strict=True)
    ]


def moving(scripts: Sequence[Rolled]) -> np.ndarray:
    """Whether anything moves, [rollouts, chunks]."""
    return np.array([one.rows["true context"]["moves"] for one in scripts], dtype=bool)


def contact_counts_of(scripts: Sequence[Rolled]) -> list[np.ndarray]:
    """Counts [rollouts, chunks, 3] of chained, copied and true-context touch where things move."""
    moves = moving(scripts)[..., None]
    rows = (("imagined", "contact"), ("imagined", "contact_of_copy"), ("true context", "contact"))
    return [
        np.where(moves, np.array([one.rows[kind][name] for one in scripts]), 0.0)
        for kind, name in rows
    ]


def _images(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """PSNR of whole images in the worst chunk, and relative to the warped start around objects."""
    what = "chained image, worst chunk"
    around = "chained image less warped start where objects are or were, worst of chunks 2 to 5"
    found = []
    for name, text, bound, first in ((_IMAGES[0], what, 25.0, 0), (_IMAGES[1], around, 4.0, 1)):
        whole, both = image_figures(scripts, name)
        if not whole:
            found.append(undefined(text, ("at least", bound)))
            continue
        gains = both[..., 0] - (both[..., 1] if first else 0.0)
        means = [
            sampling.mean(text, column, whole, ("at least", bound)) for column in gains.T[first:]
        ]
        value = min(one.value for one in means)
        draws = np.stack([one.draws for one in means]).min(axis=0)
        found.append(Drawn(text, value, draws, len(whole), ("at least", bound), "dB"))
    return found


def image_figures(scripts: Sequence[Rolled], name: str) -> tuple[list[Rolled], np.ndarray]:
    """Scripts whose every chunk has this figure, and PSNR [rollouts, chunks, 2] of them."""
    rows = [(one, one.rows["imagined"]) for one in scripts]
    whole = [one for one, row in rows if len(row[name]) == len(row["psnr"])]
    return whole, np.array([one.rows["imagined"][name] for one in whole])


def _sharpness(sampling: Sampling, scripts: Sequence[Rolled]) -> Drawn:
    what = "sharpness of chained images as a share of the truth"
    mine = [one for one in scripts if "sharpness" in one.rows]
    if not mine:
        return undefined(what, ("at least", 0.8))
    values = np.array([one.rows["sharpness"]["sharpness"] for one in mine]).sum(axis=1)
    shares = [
        total[..., 0] / np.maximum(total[..., 1], 1e-9) for total in sampling.sums(values, mine)
    ]
    return Drawn(what, float(shares[0]), shares[1], len(mine), ("at least", 0.8))


def chunk_rows(task: str, scripts: Sequence[Rolled]) -> list[dict[str, Any]]:
    """Contact F1, PSNR and sharpness of every chunk, each with its baselines."""
    if not scripts:
        return []
    rows: list[dict[str, Any]] = [
        {"task": task, "chunk": 1 + chunk}
        for chunk in range(len(scripts[0].rows["imagined"]["psnr"]))
    ]
    mine = [one for one in scripts if "true context" in one.rows]
    if mine:
        names = ("f1", "f1_of_copy", "f1_with_true_context")
        columns = [f1(counts.sum(axis=0)) for counts in contact_counts_of(mine)]
        for row, share, *values in zip(rows, moving(mine).mean(axis=0), *columns, strict=True):
            contact = dict(zip(names, map(float, values), strict=True))
            row.update({"moving": float(share)} | (contact if share else {}))
    for name in _IMAGES:
        whole, both = image_figures(scripts, name)
        for row, pair in zip(rows, both.mean(axis=0) if whole else [], strict=False):
            row[name], row[f"{name}_of_warped_start"] = (float(value) for value in pair)
    sharp = [one.rows["sharpness"]["sharpness"] for one in scripts if "sharpness" in one.rows]
    if sharp:
        for row, (ours, true) in zip(rows, np.sum(sharp, axis=0).tolist(), strict=True):
            row["sharpness"] = ours / true if true else None
    return rows


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
        likely = [[one.rows[IMAGINED]["likely_success"] for one in seed] for seed in by_seed]
        row: dict[str, Any] = {
            "rollouts": len(first),
            "real": float(np.mean([one.success for one in first])),
            "imagined": float(np.mean(likely)),
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
    decided_rollouts = [one for one, sure in zip(rollouts, decided, strict=True) if sure]
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
            f"{what}, wrong among the decided", wrong[decided].astype(float), decided_rollouts,
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
    count, real, imagined = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for one, start in zip(rollouts, sampling.starts(rollouts), strict=True):
        at = names.index(policy_of(one)), start
        count[at] += 1
        real[at] += one.success
        imagined[at] += one.rows[IMAGINED]["likely_success"]
    about: tuple[tuple[str, Bound], ...] = (
        (f"{what}, Pearson", ("at least", bounds[0])),
        (f"{what}, MMRV with ties", ("at most", bounds[1])),
    )
    if len(names) < 2:
        return [undefined(*each) for each in about]
    sides = {"real": real, "imagined": imagined}
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
    """The kind of mistake of a rollout; raises ValueError for a policy without a mistake."""
    mistake = mistake_of(one.policy)
    if mistake is None:
        raise ValueError(f"got policy {one.policy!r}, expected one with a mistake")
    return mistake.kind


def uncertainty_of(verdict: Mapping[str, Any]) -> float:
    """How unreliable a verdict is: more than 1 if it is left open, otherwise by its probability."""
    return float(not _is_decided(verdict)) + 1 - abs(2 * float(verdict["probability"]) - 1)


def _is_decided(verdict: Mapping[str, Any]) -> bool:
    return bool(verdict["decision"] != "cannot tell")


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
            *_contact(sampling, scripts),
            *_images(sampling, scripts),
            _sharpness(sampling, scripts),
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
