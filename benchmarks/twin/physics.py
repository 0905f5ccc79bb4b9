"""Contact errors of the twin under coarser MuJoCo solvers, relative to the default solver."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float64

from dextouch.schemas import CHUNK_STEPS
from services.twin.settings import TwinSettings
from services.twin.simulation import STEPS_PER_GRID, STEPS_PER_TACTILE, Simulation
from services.twin.stage import Plan, Stage, command_row

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
