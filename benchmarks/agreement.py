"""Entry point of the benchmark stage `agreement`: coverage of the intervals of an evaluation."""

import argparse
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import ndtri

from benchmarks.figures import Figure, Requirement, at_least, at_most, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from services.evaluation.agreement import CORRELATIONS, FIGURES, figures_of_draws
from services.evaluation.statistics import (
    MatchedScores,
    ScoreDraws,
    bootstrap_scores,
    central_interval,
    posterior_scores,
    shortest_interval,
)

Draw = Callable[..., ScoreDraws]
OURS: Final = "posterior"
METHODS: Final[Mapping[str, Draw]] = {OURS: posterior_scores, "bootstrap": bootstrap_scores}
MEASURED: Final = ("pearson", "mmrv", "bias")
# Standard deviations by which imagined success rates differ from real ones.
DISAGREEMENTS: Final = (0.0, 0.05, 0.2, 0.5)
NUM_POLICIES: Final = (3, 6, 10)
NUM_STARTS: Final = 10
# Correlation, on the scale of a normal variable, of the outcomes of different policies from the
# same start: unfavourable object poses are unfavourable for all.
SHARED: Final = 0.5
# The paper's largest table: 4 tasks of 3 policies and 10 starts, scored in quarters.
PAPER: Final = (3, 10)
PAPER_TASKS: Final = 4
AMOUNTS: Final = Amounts(
    usual={"studies": 200, "draws": 4000, "rounds": 7},
    quick={"studies": 6, "draws": 500, "rounds": 2},
)


@dataclass(frozen=True)
class Tally:
    """Coverage and median width of a method's intervals."""

    held: float
    width: float
    undefined: int


# By numbers of policies and disagreements, then by methods and figures.
Found = Mapping[tuple[int, float], Mapping[tuple[str, str], Tally]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, studies="simulated studies of each kind")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Simulate studies with known true rates, and time both methods on one of the paper's size."""
    plan = AMOUNTS.of(options)
    kinds = [(p, d) for p in NUM_POLICIES for d in DISAGREEMENTS]
    found: dict[tuple[int, float], dict[tuple[str, str], Tally]] = {}
    with bar("studies", len(kinds)) as step:
        for index, (num_policies, disagreement) in enumerate(kinds):
            step(f"{num_policies} policies, {disagreement:g} apart")
            generator = np.random.default_rng(index)
            found[num_policies, disagreement] = coverage(
                num_policies, disagreement, plan, generator
            )
    times_s = timed(plan["rounds"])
    return StageReport(
        stage="agreement",
        packages=("numpy", "scipy"),
        options=plan,
        tables=[
            *(coverage_table(name, found) for name in MEASURED),
            ResultTable(
                "4 tasks of 3 policies, 10 starts",
                ("method", "s"),
                [(name, figure.text()) for name, figure in times_s.items()],
            ),
        ],
        requirements=requirements(found, times_s),
        data={
            "coverage": [
                {"policies": p, "disagreement": d, "method": method, "figure": name} | asdict(tally)
                for (p, d), tallies in found.items()
                for (method, name), tally in tallies.items()
            ],
            "seconds": times_s,
        },
        notes=[
            f"{NUM_STARTS} starts of one success or failure each; times are processor time of a "
            "study of the paper's size, 10,000 draws of every task"
        ],
    )


def simulated_study(
    num_policies: int, disagreement: float, generator: np.random.Generator
) -> tuple[dict[str, np.ndarray], MatchedScores]:
    """True success rates of policies of random skill in both worlds, and a study of ten starts."""
    real = generator.uniform(0.05, 0.95, num_policies)
    imagined = np.clip(real + generator.normal(0, disagreement, num_policies), 0.02, 0.98)
    luck = generator.standard_normal(NUM_STARTS)

    def outcomes(rates: np.ndarray) -> np.ndarray:
        own = generator.standard_normal((num_policies, NUM_STARTS))
        skill = math.sqrt(SHARED) * luck + math.sqrt(1 - SHARED) * own
        return (skill < ndtri(rates)[:, None]).astype(np.float64)

    rates = {"real": real, "imagined": imagined}
    return rates, MatchedScores(outcomes(real), outcomes(imagined))


def coverage(
    num_policies: int,
    disagreement: float,
    plan: Mapping[str, int],
    generator: np.random.Generator,
) -> dict[tuple[str, str], Tally]:
    """Tallies by method and figure over simulated studies of one kind."""
    held: dict[tuple[str, str], list[tuple[bool, float]]] = {
        (method, name): [] for method in METHODS for name in MEASURED
    }
    for _ in range(plan["studies"]):
        truth, scores = simulated_study(num_policies, disagreement, generator)
        for method, draw in METHODS.items():
            draws = figures_of_draws(draw(scores, generator, num_draws=plan["draws"]))
            for name in MEASURED:
                defined = draws[name][np.isfinite(draws[name])]
                if 2 * len(defined) < plan["draws"]:
                    continue
                # A bootstrap interval consists of quantiles, as is usual.
                shortest = method == OURS and name in CORRELATIONS
                interval = (shortest_interval if shortest else central_interval)(defined)
                # A true value at its limit (r = 1) counts as covered within a thousandth.
                hit = interval.low - 1e-3 <= FIGURES[name].compute(**truth) <= interval.high + 1e-3
                held[method, name].append((hit, interval.high - interval.low))
    return {
        key: Tally(
            float(np.mean([hit for hit, _ in rows])) if rows else math.nan,
            float(np.median([width for _, width in rows])) if rows else math.nan,
            plan["studies"] - len(rows),
        )
        for key, rows in held.items()
    }


def timed(num_rounds: int) -> dict[str, Figure]:
    """Processor seconds of 10,000 draws of every task of the paper's largest study."""
    generator = np.random.default_rng(0)
    scores = MatchedScores(*(generator.integers(0, 5, PAPER) / 4 for _ in range(2)))

    def once(draw: Draw, round_index: int) -> float:
        started = time.process_time()
        for _ in range(PAPER_TASKS):
            figures_of_draws(draw(scores, np.random.default_rng(round_index)))
        return time.process_time() - started

    subjects = {name: partial(once, draw) for name, draw in METHODS.items()}
    return {name: Figure.of(values) for name, values in interleaved(subjects, num_rounds).items()}


def coverage_table(name: str, found: Found) -> ResultTable:
    """Coverage and median width of the 95 % intervals of a figure."""
    rows = []
    for (num_policies, disagreement), tallies in found.items():
        row = [f"{num_policies} policies, {disagreement:g} apart"]
        for method in METHODS:
            tally = tallies[method, name]
            row += [f"{tally.held:.2f}", f"{tally.width:.2f}", str(tally.undefined)]
        rows.append(tuple(row))
    columns = [f"{method}: {c}" for method in METHODS for c in ("holds", "width", "undefined")]
    return ResultTable(f"95 % intervals of {name}", ("studies", *columns), rows)


def requirements(found: Found, times_s: Mapping[str, Figure]) -> list[Requirement]:
    """Requirements on the intervals of an evaluation."""
    what = "studies whose 95 % interval holds the truth"
    held = {n: float(np.nanmean([one[OURS, n].held for one in found.values()])) for n in MEASURED}
    paper = "hierarchical bootstrap of the paper's largest study, 10,000 draws"
    return [
        *(at_least(f"{name}: {what}", share, 0.92) for name, share in held.items()),
        at_most(paper, times_s["bootstrap"].median, 1.0, "s"),
    ]
