"""Tables and charts of the retargeting benchmark."""

from collections.abc import Iterable, Mapping, Sequence

from benchmarks.chart import Panel, Point
from benchmarks.report import ResultTable
from benchmarks.retargeting.acceptance import velocity_limit_deg
from benchmarks.retargeting.compare import (
    NATURAL_NOISE,
    PINCH_INPUT,
    ROBOT_INPUT,
    RobotScores,
    Speed,
)
from benchmarks.retargeting.ours import OURS, OURS_LIVE, ColdStart
from benchmarks.retargeting.robustness import HAND_LOST, NODE_LOST, NODES_LOST, Outcome
from benchmarks.retargeting.robustness import table_rows as fault_rows
from benchmarks.retargeting.scores import PinchScore


def tables(
    speeds: Sequence[Speed],
    robot: RobotScores,
    pinches: Mapping[str, PinchScore],
    cold: ColdStart,
    outcomes: Sequence[Outcome],
    rivals: Sequence[str] = (),
) -> list[ResultTable]:
    """All tables of the stage; libraries without a result are marked as not finished."""
    return [
        *[_speed_table(speeds, motion, rivals) for motion in (ROBOT_INPUT, PINCH_INPUT)],
        *[_robot_table(robot, name, rivals) for name in robot],
        _pinch_table(pinches, rivals),
        ResultTable(
            "Cold start: fingers of random postures solved within 0.1 mm",
            ("fingers", "with one start", "with retries"),
            [tuple(str(number) for number in cold)],
        ),
        ResultTable(
            "Behaviour on lost samples and nodes (robot motion, one second)",
            ("method", NODE_LOST, HAND_LOST, NODES_LOST),
            fault_rows(outcomes),
        ),
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


def _robot_table(robot: RobotScores, name: str, rivals: Sequence[str]) -> ResultTable:
    return ResultTable(
        f"The robot's own hands, {name}: means, joints beyond limits, largest turn a sample",
        ("method", "tip (mm)", "p95", "max", "joint (deg)", "max", "outside", "turn (deg)"),
        [
            (
                method,
                f"{score.tip_mean_mm:.3g}",
                f"{score.tip_p95_mm:.3g}",
                f"{score.tip_max_mm:.3g}",
                f"{score.joint_mean_deg:.3g}",
                f"{score.joint_max_deg:.3g}",
                str(score.num_outside),
                f"{score.max_step_deg:.3g}",
            )
            for method, score in robot[name].items()
        ]
        + _unfinished(rivals, robot[name], 8),
    )


def _pinch_table(pinches: Mapping[str, PinchScore], rivals: Sequence[str]) -> ResultTable:
    return ResultTable(
        "Pinches of people: the robot's gap where the human one is below 3 mm; a joint may turn "
        f"{velocity_limit_deg():.3g} deg a sample",
        ("method", "gap (mm)", "p95", "off human angles (deg)", "turn (deg)", "outside"),
        [
            (
                method,
                f"{score.gap_mean_mm:.3g}",
                f"{score.gap_p95_mm:.3g}",
                f"{score.same_angle_deg:.3g}",
                f"{score.max_step_deg:.3g}",
                str(score.num_outside),
            )
            for method, score in pinches.items()
        ]
        + _unfinished(rivals, pinches, 6),
    )
