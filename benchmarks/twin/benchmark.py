"""The benchmark stage `twin`: chunks by requested images, and errors of coarser solvers."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float64

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most, every_round, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.schemas import CHUNK_STEPS, EVERYTHING, ReturnSelector, RolloutStart
from services.twin.settings import TwinSettings
from services.twin.simulation import STEPS_PER_GRID, STEPS_PER_TACTILE, Simulation
from services.twin.stage import Plan, Stage, command_row, script_name, scripted_actions
from services.twin.tasks import TASK_NAMES
from services.twin.world import TwinState, TwinWorld

# Both scripts have contact in their second chunk.
CHUNK: Final = 1
EVERY_CAMERA: Final = "three cameras, 16 steps"
HEAD: Final = "head camera, 16 steps"
HEAD_LAST: Final = "head camera, last step"
SELECTORS: Final = {
    EVERY_CAMERA: EVERYTHING,
    "three cameras, last step": ReturnSelector(steps="last"),
    HEAD: ReturnSelector(cameras=("camera_head",)),
    HEAD_LAST: ReturnSelector(cameras=("camera_head",), steps="last"),
    "no camera": ReturnSelector(cameras=(), steps="last"),
}


class TimedChunk:
    """One chunk of a demonstration with contact, stepped repeatedly from the same state."""

    def __init__(self, task: str, seed: int) -> None:
        self._world = TwinWorld(TwinSettings())
        state: TwinState = self._world.reset(RolloutStart(task, seed, "")).state
        rows = scripted_actions(self._world.stage(task), seed, script_name(0.0))
        for chunk in range(CHUNK):
            before = rows[chunk * CHUNK_STEPS :][:CHUNK_STEPS]
            state = self._world.step(state, before, seed=0).state
        self._state, self._actions = state, rows[CHUNK * CHUNK_STEPS :][:CHUNK_STEPS]

    def subjects(self) -> dict[str, Callable[[int], float]]:
        """Functions that measure processor milliseconds of the chunk with each selector."""
        return {
            name: every_round(partial(self._timed, selector))
            for name, selector in SELECTORS.items()
        }

    def states_are_equal(self) -> bool:
        """Whether the state after the chunk is bit-identical for every selector."""
        snapshots = {self._world.snapshot(self._step(selector)) for selector in SELECTORS.values()}
        return len(snapshots) == 1

    def _step(self, selector: ReturnSelector) -> TwinState:
        return self._world.step(self._state, self._actions, seed=0, selector=selector).state

    def _timed(self, selector: ReturnSelector) -> float:
        begin_s = time.process_time()
        self._step(selector)
        return 1e3 * (time.process_time() - begin_s)


AS_SERVED: Final = "as served"

# Options of MuJoCo that differ from the twin's.
SOLVERS: Final[Mapping[str, Mapping[str, int]]] = {
    AS_SERVED: {},
    "3 Newton steps": {"iterations": 3},
    "2 Newton steps": {"iterations": 2},
    "1 Newton step": {"iterations": 1},
    "pyramidal cones": {"cone": int(mujoco.mjtCone.mjCONE_PYRAMIDAL)},
    "CG": {"solver": int(mujoco.mjtSolver.mjSOL_CG)},
}


@dataclass(frozen=True)
class Played:
    """Result of a chunk with contact: pad forces at 60 Hz and final object positions."""

    pad_forces_n: Float64[np.ndarray, "samples 2 6"]
    object_positions_m: Float64[np.ndarray, "objects 3"]
    ms: float


@dataclass(frozen=True)
class ContactError:
    """Errors of chunks relative to the default solver, from the same initial states.

    Forces are root mean squares: the error over pads and samples with contact, and the true forces
    that are not zero. `object_mm` is the median error of final positions over chunks and objects.
    """

    force_n: float
    force_rms_n: float
    object_mm: float


class ContactChunks:
    """Chunks of demonstrations, started from the states that the default solver reaches.

    Errors are therefore those of one chunk and do not accumulate.
    """

    def __init__(self, task: str, seeds: Sequence[int]) -> None:
        stage = Stage(task, "robot", TwinSettings())
        self._simulation = stage.simulation
        self._begins: list[tuple[Plan, int, Float64[np.ndarray, " numbers"]]] = []
        for seed in seeds:
            plan = stage.plan(seed)
            stage.start(plan)
            for first in range(1, len(plan.commands.joints_left_rad), CHUNK_STEPS):
                state = stage.simulation.state()
                if _play(stage.simulation, plan, first).pad_forces_n.any():
                    self._begins.append((plan, first, state))

    def __len__(self) -> int:
        return len(self._begins)

    def play(self, solver: Mapping[str, int]) -> list[Played]:
        """Play every chunk with other options; the default ones are restored afterwards."""
        played, simulation = [], self._simulation
        option = simulation.scene.model.opt
        kept = {name: getattr(option, name) for name in solver}
        for plan, first, state in self._begins:
            simulation.set_state(state, step_index=(first - 1) * STEPS_PER_GRID)
            for name, value in solver.items():
                setattr(option, name, value)
            played.append(_play(simulation, plan, first))
            for name, value in kept.items():
                setattr(option, name, value)
        return played


def contact_error(played: Sequence[Played], truth: Sequence[Played]) -> ContactError:
    """Errors of chunks relative to the default solver."""
    true_n = np.concatenate([one.pad_forces_n for one in truth])
    off_n = np.concatenate([one.pad_forces_n for one in played]) - true_n
    off_m = np.concatenate([one.object_positions_m for one in played]) - np.concatenate(
        [one.object_positions_m for one in truth]
    )
    felt = (true_n > 0) | (off_n != 0)
    return ContactError(
        force_n=float(np.sqrt(np.mean(off_n[felt] ** 2))) if felt.any() else 0.0,
        force_rms_n=float(np.sqrt(np.mean(true_n[true_n > 0] ** 2))),
        object_mm=1e3 * float(np.median(np.linalg.norm(off_m, axis=1))),
    )


def _play(simulation: Simulation, plan: Plan, first: int) -> Played:
    last = min(first + CHUNK_STEPS, len(plan.commands.joints_left_rad))
    forces_n: list[np.ndarray] = []
    begin_s = time.process_time()
    for row in range(first, last):
        forces_n.extend(
            simulation.pad_forces_n
            for step_index in simulation.advance(command_row(plan.commands, row))
            if step_index % STEPS_PER_TACTILE == 0
        )
    elapsed_s = time.process_time() - begin_s
    return Played(np.stack(forces_n), simulation.object_poses()[:, :3], 1e3 * elapsed_s)


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
            "chunk_ms": times_ms,
            "solver_ms": solver_ms,
            "contact_error": errors,
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
