"""The benchmark stage `retargeting`: its measurements, tables and requirements."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, astuple
from pathlib import Path

import numpy as np

from benchmarks.chart import Panel, Point
from benchmarks.figures import Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.retargeting.compare import (
    FULL,
    FULL_NOISE,
    HAND_LOST,
    NATURAL,
    NATURAL_NOISE,
    NODE_LOST,
    NODES_LOST,
    OURS,
    OURS_EXACT,
    OURS_LIVE,
    PINCH_INPUT,
    ROBOT_INPUT,
    BoneScore,
    ColdStart,
    Effort,
    Outcome,
    PinchScore,
    RobotScore,
    RobotScores,
    Speed,
    cold_start,
    compare_axes,
    compare_pinches,
    compare_robot,
    compare_speed,
    pinch_set,
    robot_sets,
    try_faults,
)
from benchmarks.retargeting.rival_process import NUM_WARM_UP, RivalProcess
from benchmarks.retargeting.rivals import DEX, DEXI, INSTALL, RIVALS, VECTOR, Rival, missing_modules
from benchmarks.simulated.hand_motions import RATE_HZ
from benchmarks.stages import Amounts, Bar, named
from dextouch.errors import InvalidInputError
from services.alignment.retargeting import RetargetOptions

# (library, how many times as fast), each with its vectors from the wrist to 15 points.
PROMISED_SPEED = ((DEX, 150.0), (DEXI, 5.0))
# Tolerance for rounding at the velocity limit.
_ROUNDING_DEG = 1e-6


def tables(
    speeds: Sequence[Speed],
    robot: RobotScores,
    pinches: Mapping[str, PinchScore],
    cold: ColdStart,
    outcomes: Sequence[Outcome],
    rivals: Sequence[str] = (),
) -> list[ResultTable]:
    """All tables of the stage; libraries without a result are marked as not finished."""
    what = "means, joints beyond limits, largest turn a sample"
    return [
        *[_speed_table(speeds, motion, rivals) for motion in (ROBOT_INPUT, PINCH_INPUT)],
        *[
            ResultTable(
                f"The robot's own hands, {name}: {what}",
                ("method", "tip (mm)", "p95", "max", "joint (deg)", "max", "outside", "turn (deg)"),
                [(method, *cells(*astuple(score))) for method, score in scores.items()]
                + _unfinished(rivals, scores, 8),
            )
            for name, scores in robot.items()
        ],
        ResultTable(
            "Pinches of people: the robot's gap where the human one is below 3 mm; a joint may "
            f"turn {velocity_limit_deg():.3g} deg a sample",
            ("method", "gap (mm)", "p95", "off human angles (deg)", "turn (deg)", "outside"),
            # All but the number of pinches.
            [(method, *cells(*astuple(score)[:-1])) for method, score in pinches.items()]
            + _unfinished(rivals, pinches, 6),
        ),
        ResultTable(
            "Cold start: fingers of random postures solved within 0.1 mm",
            ("fingers", "with one start", "with retries"),
            [tuple(str(number) for number in cold)],
        ),
        ResultTable(
            "Behaviour on lost samples and nodes (robot motion, one second)",
            ("method", NODE_LOST, HAND_LOST, NODES_LOST),
            [
                (method, *(one.text for one in outcomes if one.method == method))
                for method in dict.fromkeys(one.method for one in outcomes)
            ],
        ),
    ]


def axes_tables(
    axes: Mapping[float, Mapping[str, BoneScore]], rivals: Sequence[str]
) -> list[ResultTable]:
    """Tables of people with other axes than the robot's."""
    return [
        ResultTable(
            f"People whose axes are {oblique_deg:g} degrees off: angles between their bones and "
            "the robot's (deg)",
            ("method", "thumb", "p95", "fingers", "p95"),
            [(method, *cells(*astuple(score))) for method, score in scores.items()]
            + _unfinished(rivals, scores, 5),
        )
        for oblique_deg, scores in axes.items()
    ]


def panels(
    speeds: Sequence[Speed], robot: RobotScores, pinches: Mapping[str, PinchScore]
) -> list[Panel]:
    """Time against error of the tips under noise; time against the gap of pinches."""
    noisy = {name: score.tip_mean_mm for name, score in robot[NATURAL_NOISE].items()}
    gaps = {name: score.gap_mean_mm for name, score in pinches.items()}
    pictures = (
        ("Robot motion, 1 mm noise", "mean tip error (mm)", ROBOT_INPUT, noisy),
        ("Pinches of people", "mean gap of the robot's tips (mm)", PINCH_INPUT, gaps),
    )
    return [
        Panel(title, "processor µs a sample and hand", label, _points(speeds, motion, errors))
        for title, label, motion, errors in pictures
    ]


def _points(speeds: Sequence[Speed], motion: str, errors: Mapping[str, float]) -> list[Point]:
    return [
        Point.of(speed.method, speed.cpu_us, errors[speed.method], is_ours=speed.method == OURS)
        for speed in speeds
        if speed.motion == motion and speed.method in errors
    ]


def _unfinished(
    rivals: Sequence[str], finished: Iterable[str], num_columns: int
) -> list[tuple[str, ...]]:
    """A row for each library without a result."""
    missing = set(rivals).difference(finished)
    return [
        (name, "did not finish", *[""] * (num_columns - 2)) for name in rivals if name in missing
    ]


def _speed_table(speeds: Sequence[Speed], motion: str, rivals: Sequence[str]) -> ResultTable:
    mine = {speed.method: speed for speed in speeds if speed.motion == motion}
    rows = []
    for method, speed in mine.items():
        calls = ("", "") if speed.call_us is None else [f"{value:.3g}" for value in speed.call_us]
        ratios = [speed.cpu_us.over(mine[ours].cpu_us).text() for ours in (OURS, OURS_LIVE)]
        rows.append((method, speed.cpu_us.text(), *ratios, *calls))
    columns = ("/ ours", "/ ours, live", "call (µs)", "p99 (µs)")
    title = f"Time a sample and hand ({motion}, 1 mm noise): processor, ratios, wall time of a call"
    rows += _unfinished(rivals, mine, 2 + len(columns))
    return ResultTable(title, ("method", "cpu (µs)", *columns), rows)


def requirements(
    speeds: Sequence[Speed],
    robot: RobotScores,
    pinches: Mapping[str, PinchScore],
    cold: ColdStart,
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    exact = [robot[name][OURS_EXACT] for name in (NATURAL, FULL)]
    tip_mm, joint_deg = max(s.tip_max_mm for s in exact), max(s.joint_max_deg for s in exact)
    noisy = [robot[name][OURS] for name in (NATURAL_NOISE, FULL_NOISE)]
    noisy_mm, noisy_deg = max(s.tip_mean_mm for s in noisy), max(s.joint_mean_deg for s in noisy)
    pinched = pinches[OURS]
    every: list[RobotScore | PinchScore] = [*(found[OURS] for found in robot.values()), pinched]
    step_deg, bound_deg = max(s.max_step_deg for s in every), velocity_limit_deg() + _ROUNDING_DEG
    once, retried = cold.num_found_once / cold.num_fingers, cold.num_found / cold.num_fingers
    rivals = [(Rival(library, VECTOR).name, bound) for library, bound in PROMISED_SPEED]
    motion, noise = f"robot motion, {OURS_EXACT}", "robot motion, 1 mm noise"
    return [
        *(
            at_least(f"{OURS}: times as fast as {name}", worst_ratio(speeds, OURS, name), bound)
            for name, bound in rivals
        ),
        at_most(f"{motion}: tip error, max", tip_mm, 1e-3, "mm"),
        at_most(f"{motion}: joint error, max", joint_deg, 0.01, "deg"),
        at_most(f"{motion}: joints beyond limits", float(sum(s.num_outside for s in exact)), 0.0),
        at_most(f"{noise}: tip error, mean", noisy_mm, 1.3, "mm"),
        at_most(f"{noise}: joint error, mean", noisy_deg, 1.7, "deg"),
        at_most(
            "pinches: gap where the human's is below 3 mm, mean", pinched.gap_mean_mm, 1.5, "mm"
        ),
        at_most("pinches: gap where the human's is below 3 mm, p95", pinched.gap_p95_mm, 2.5, "mm"),
        at_most("pinches: off the human joint angles, mean", pinched.same_angle_deg, 5.0, "deg"),
        at_most("all motions: turn of a joint a sample", step_deg, bound_deg, "deg"),
        at_most("all motions: joints beyond limits", float(sum(s.num_outside for s in every)), 0.0),
        at_least("cold start: fingers within 0.1 mm, one start", once, 0.999),
        at_least("cold start: fingers within 0.1 mm, retries", retried, 1.0),
    ]


def worst_ratio(speeds: Sequence[Speed], ours: str, rival: str) -> float | None:
    """Other library's time relative to ours: median over the rounds, for the worse input."""
    times = {(speed.method, speed.motion): speed.cpu_us for speed in speeds}
    motions = {motion for method, motion in times if method == rival}
    ratios = [times[rival, motion].over(times[ours, motion]).median for motion in motions]
    return min(ratios, default=None)


def velocity_limit_deg() -> float:
    """Maximum joint change between samples under our default velocity limit."""
    return float(np.rad2deg(RetargetOptions().velocity_limit_rad_s / RATE_HZ))


AMOUNTS = Amounts(
    usual={"seeds": 2, "samples": 600, "people": 5, "rounds": 6, "postures": 5000},
    quick={"seeds": 1, "samples": 120, "people": 1, "rounds": 1, "postures": 100},
)
_NONE = "none"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, rounds="timing rounds", samples="of a motion")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the first motion (%(default)s)"
    )
    parser.add_argument(
        "--rivals",
        metavar="A,B",
        help=f"comma-separated libraries, or {_NONE} (all that are installed: {', '.join(RIVALS)})",
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run every method on robot motions, on pinching people and on those of other axes."""
    if options.seed < 0:
        raise InvalidInputError(f"--seed: got {options.seed}, expected at least 0")
    plan = AMOUNTS.of(options, samples=30)
    effort = Effort(**{f"num_{name}": one for name, one in plan.items()}, seed=options.seed)
    chosen, left_out = choose_rivals(options.rivals)
    with ExitStack() as stack:
        rivals = {one.name: stack.enter_context(RivalProcess(one)) for one in chosen}
        speeds = compare_speed(effort, rivals, bar)
        robot = compare_robot(robot_sets(effort), rivals, bar)
        pinches = compare_pinches(pinch_set(effort), rivals, bar)
        axes = compare_axes(effort, rivals, bar)
        outcomes = try_faults(effort.seed, rivals, bar)
    cold = cold_start(effort.num_postures, effort.seed)
    return StageReport(
        stage="retargeting",
        packages=("numpy", "numba", "dex-retargeting", "nlopt", "pin", "torch", "dexi-rs"),
        options={**asdict(effort), "rivals": list(rivals)},
        tables=[
            *tables(speeds, robot, pinches, cold, outcomes, list(rivals)),
            *axes_tables(axes, list(rivals)),
        ],
        panels=panels(speeds, robot, pinches),
        requirements=requirements(speeds, robot, pinches, cold),
        data={
            "speed": speeds,
            "robot": robot,
            "pinches": pinches,
            "oblique_axes": {f"{oblique_deg:g}": scores for oblique_deg, scores in axes.items()},
            "cold_start": cold._asdict(),
            "faults": outcomes,
        },
        notes=notes(chosen, left_out),
    )


def choose_rivals(words: str | None) -> tuple[list[Rival], list[Rival]]:
    """The rivals of `--rivals` that are installed, and those that are not.

    Raises UnknownNameError for a rival that there is not.
    """
    selected = list(RIVALS.values())
    if words is not None:
        selected = [] if words == _NONE else list(named("rival", RIVALS, words).values())
    left_out = [rival for rival in selected if missing_modules(rival)]
    return [rival for rival in selected if rival not in left_out], left_out


def notes(chosen: list[Rival], left_out: list[Rival]) -> list[str]:
    """Notes on how methods were run, and why some were skipped."""
    texts = [
        f"{OURS_EXACT} is without temporal regularization; times assume a known profile of the "
        "person, errors a profile measured from the same samples"
    ]
    if chosen:
        texts.append(
            "other libraries run in separate processes, sample by sample, without their low-pass "
            f"filter, and after {NUM_WARM_UP} warm-up calls with the first sample; their keypoints "
            "are scaled by the lengths of the fingers; ours has a cold start"
        )
    if left_out:
        missing = sorted({module for rival in left_out for module in missing_modules(rival)})
        texts.append(
            f"{', '.join(rival.name for rival in left_out)} not measured: "
            f"{', '.join(missing)} not installed; {INSTALL}"
        )
    return texts
