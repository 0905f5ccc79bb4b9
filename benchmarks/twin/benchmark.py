"""Entry point of the benchmark stage `twin`."""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.rounds import every_round, interleaved
from benchmarks.stages import Amounts, Bar
from benchmarks.twin.chunks import HEAD, HEAD_LAST, TimedChunk
from benchmarks.twin.physics import AS_SERVED, SOLVERS, ContactChunks, ContactError, contact_error
from services.twin.tasks import TASK_NAMES

# Of demonstrations that nothing is trained on.
FIRST_SEED: Final = 30_000
# 16 steps at 15 a second.
CHUNK_MS: Final = 16 / 15 * 1e3
AMOUNTS: Final = Amounts(
    usual={"rounds": 15, "seeds": 3, "solver_rounds": 5},
    quick={"rounds": 3, "seeds": 1, "solver_rounds": 1},
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument("--task", default="stand_bottle", choices=TASK_NAMES, help="(%(default)s)")
    AMOUNTS.add_options(parser, rounds="rounds")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Time a chunk alternately with every selector, then chunks with contact with every solver."""
    plan = AMOUNTS.of(options)
    chunk = TimedChunk(options.task, FIRST_SEED)
    subjects = chunk.subjects()
    with bar("selectors", plan["rounds"] * len(subjects)) as step:
        found = interleaved(subjects, plan["rounds"], on_step=step)
    times_ms = {name: Figure.of(values) for name, values in found.items()}
    solver_ms, errors, num_chunks = _solvers(options.task, plan, bar)
    points = [
        Point.of(name, solver_ms[name], error.force_n, is_ours=name == AS_SERVED)
        for name, error in errors.items()
    ]
    label = "RMS error of pad forces after one chunk (N)"
    return StageReport(
        stage="twin",
        packages=("numpy", "mujoco-core"),
        options={**plan, "task": options.task, "chunks_with_contact": num_chunks},
        tables=[
            ResultTable(
                "A chunk of 16 steps by requested observation",
                ("requested", "ms", "times real time"),
                [
                    (name, figure.text(), figure.inverse(CHUNK_MS).text())
                    for name, figure in times_ms.items()
                ],
            ),
            solver_table(solver_ms, errors, num_chunks),
        ],
        panels=[Panel("Physics of a chunk with contact", "processor ms a chunk", label, points)],
        requirements=requirements(times_ms, states_are_equal=chunk.states_are_equal()),
        data={
            "chunk_ms": {name: list(figure.values) for name, figure in times_ms.items()},
            "solver_ms": {name: list(figure.values) for name, figure in solver_ms.items()},
            "contact_error": {
                name: {"force_n": error.force_n, "object_mm": error.object_mm}
                for name, error in errors.items()
            },
        },
        notes=["times are processor time of the whole process, with one thread"],
    )


def solver_table(
    times_ms: Mapping[str, Figure], errors: Mapping[str, ContactError], num_chunks: int
) -> ResultTable:
    """Times and contact errors of coarser solvers."""
    return ResultTable(
        f"Solvers on {num_chunks} chunks with contact, no camera, errors after one chunk",
        ("solver", "ms", "force error (N)", "true force (N)", "object error (mm)"),
        [
            (
                name,
                times_ms[name].text(),
                f"{error.force_n:.2g}",
                f"{error.force_rms_n:.2g}",
                f"{error.object_mm:.2g}",
            )
            for name, error in errors.items()
        ],
    )


def requirements(times_ms: Mapping[str, Figure], *, states_are_equal: bool) -> list[Requirement]:
    """Requirements on selectors of the twin."""
    saved = times_ms[HEAD_LAST].over(times_ms[HEAD]).median
    share, equal = times_ms[HEAD].median / CHUNK_MS, float(states_are_equal)
    return [
        at_most(f"{HEAD_LAST}, share of the time of {HEAD}", saved, 0.9),
        at_most(f"{HEAD}, share of real time", share, 0.5),
        at_least("selectors that leave the state after a chunk as it is, share", equal, 1.0),
    ]


def _solvers(
    task: str, plan: Mapping[str, int], bar: Bar
) -> tuple[dict[str, Figure], dict[str, ContactError], int]:
    """Milliseconds of the median chunk by round, and errors, of every solver."""
    chunks = ContactChunks(task, range(FIRST_SEED, FIRST_SEED + plan["seeds"]))
    subjects = {name: every_round(partial(chunks.play, solver)) for name, solver in SOLVERS.items()}
    with bar("solvers", plan["solver_rounds"] * len(subjects)) as step:
        found = interleaved(subjects, plan["solver_rounds"], on_step=step)
    times_ms = {
        name: Figure.of([float(np.median([one.ms for one in played])) for played in rounds])
        for name, rounds in found.items()
    }
    truth = found[AS_SERVED][0]
    errors = {name: contact_error(rounds[-1], truth) for name, rounds in found.items()}
    return times_ms, errors, len(chunks)
