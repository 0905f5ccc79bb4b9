"""Entry point of the benchmark stage `teleoperation`: latency, limits and error of a live hand."""

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_most
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.rounds import interleaved
from benchmarks.stages import Amounts, Bar
from benchmarks.teleoperation.playing import Performance, Played, played
from benchmarks.teleoperation.server import NAIVE, RATES_HZ
from dextouch.serving import ChildProcess
from services.pipelines.teleoperation.settings import CommandLimits

OURS: Final = "ours"
MAX_LATENCY_MS: Final = 10.0
AMOUNTS: Final = Amounts(usual={"seconds": 60.0, "rounds": 3}, quick={"seconds": 6.0, "rounds": 1})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, seconds="length of a play", rounds="plays of each method")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Play a hand with faults to each method in real time, by a client in another process."""
    del folder
    plan = AMOUNTS.of(options)
    performance = Performance.of(plan["seconds"])
    child = ChildProcess("benchmarks.teleoperation.server", environment={"OMP_NUM_THREADS": "1"})
    try:
        urls = child.receive()
        names = [*RATES_HZ, NAIVE]

        def once(name: str, round_index: int) -> tuple[Played, float]:
            del round_index
            child.send({"cpu": True})
            before_s = child.receive()["cpu_s"]
            found = played(urls[name], performance)
            child.send({"cpu": True})
            return found, (child.receive()["cpu_s"] - before_s) / len(performance.is_sent) * 1e3

        with bar("plays", plan["rounds"] * len(names)) as step:
            results = interleaved(
                {name: partial(once, name) for name in names},
                plan["rounds"],
                on_step=step,
            )
    finally:
        child.close()
    return _report(plan, results)


def _report(
    plan: dict[str, float], results: Mapping[str, list[tuple[Played, float]]]
) -> StageReport:
    cpu_ms = {name: Figure.of([cpu for _, cpu in found]) for name, found in results.items()}
    plays = {name: [play for play, _ in found] for name, found in results.items()}
    errors = {name: Figure.of([p.error_deg for p in found]) for name, found in plays.items()}
    rows = []
    for name, found in plays.items():
        figures = [
            *(Figure.of([np.percentile(p.latency_ms, q) for p in found]) for q in (50, 99)),
            errors[name],
            Figure.of([p.speed_rad_s for p in found]),
            Figure.of([100 * p.num_touching / p.num_commands for p in found]),
            Figure.of([p.silence_ms for p in found]),
            cpu_ms[name],
        ]
        rows.append((name, *cells(*figures)))
    columns = (
        *("method", "latency p50 ms", "p99 ms", "error deg", "speed rad/s"),
        *("fingers overlap %", "longest silence ms", "CPU ms a sample"),
    )
    points = [
        Point.of(name, cpu_ms[name], errors[name].median, is_ours=name != NAIVE) for name in plays
    ]
    return StageReport(
        stage="teleoperation",
        packages=("numpy", "numba", "fastapi", "uvicorn", "websockets", "msgpack"),
        options=plan,
        tables=[ResultTable("A hand with faults, live", columns, rows)],
        panels=[Panel("A live hand", "CPU ms a sample", "mean error of joints, deg", points)],
        requirements=_requirements(plays[OURS]),
        data={
            "plays": {
                name: [
                    asdict(play) | {"latency_ms": play.latency_ms.tolist(), "cpu_ms": cpu}
                    for play, cpu in found
                ]
                for name, found in results.items()
            }
        },
        notes=[
            "latency is from the client's sending of a sample to its receipt of the first command "
            "that follows it; a quarter of the samples are faulty"
        ],
    )


def _requirements(ours: list[Played]) -> list[Requirement]:
    latencies_ms = np.concatenate([play.latency_ms for play in ours])
    return [
        at_most(
            "from sample to command, p99",
            float(np.percentile(latencies_ms, 99)),
            MAX_LATENCY_MS,
            "ms",
        ),
        at_most(
            "largest joint step, over speed limit times period",
            max(play.step_rad for play in ours)
            / (CommandLimits().speed_rad_s / RATES_HZ[OURS] + 1e-9),
            1.0,
        ),
        at_most(
            "commands in which fingers overlap", float(sum(play.num_touching for play in ours)), 0.0
        ),
    ]
