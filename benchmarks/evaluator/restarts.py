"""Touch that a world imagines for one chunk when it is restarted from the true observation."""

import numpy as np
from jaxtyping import Bool, Float64

from benchmarks.evaluator.measuring import contact_counts
from benchmarks.evaluator.playing import TrueRollout, start_amid
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands.actions import HandTrajectory, reanchor
from dextouch.schemas import CHUNK_STEPS, ReturnSelector, RolloutStart
from dextouch.worlds import StartedRollout, State, World
from services.twin.world import TwinState, TwinWorld

_NO_IMAGES = ReturnSelector(cameras=())
_REACHED = ReturnSelector(cameras=(), steps="last")
# Smaller motions within a chunk count as none.
_STILL_M, _STILL_RAD = 1e-3, 0.02


def contact_with_true_context(
    twin: TwinWorld,
    world: World[State],
    started: StartedRollout[TwinState],
    first: RolloutStart,
    real: TrueRollout,
) -> list[list[float]]:
    """Contact counts of every chunk, each imagined from the true observation at its start.

    The twin replays the commands to get the true poses of hands and camera; image and touch are
    those of the kept rollout, and the commands are the same.
    """
    found = []
    reached = _reached_rows(twin, started, real)
    for index in range(len(real.images_of_chunks)):
        start, chunk = first, real.actions[index * CHUNK_STEPS : (index + 1) * CHUNK_STEPS]
        if index:
            image, touch = real.images_of_chunks[index - 1], real.tactile_kpa[index * CHUNK_STEPS]
            start = start_amid(first, image, touch, reached[index - 1])
            chunk = reanchor(chunk, 0, anchor_action=reached[index - 1])
        state = world.reset(start).state
        imagined = world.step(state, chunk, seed=first.seed, selector=_NO_IMAGES)
        after = slice(1 + index * CHUNK_STEPS, 1 + (index + 1) * CHUNK_STEPS)
        found.append(contact_counts(imagined.observation.tactile_kpa, real.tactile_kpa[after]))
    return found


def _reached_rows(
    twin: TwinWorld, started: StartedRollout[TwinState], real: TrueRollout
) -> list[Float64[np.ndarray, "67"]]:
    """Reached actions at the end of every chunk, relative to step 0."""
    rows, state = [], started.state
    for chunk in np.split(real.actions, len(real.images_of_chunks)):
        step = twin.step(state, chunk, seed=0, selector=_REACHED)
        rows.append(step.observation.action_reached[-1])
        state = step.state
    return rows


def chunks_that_move(
    commands: HandTrajectory, object_poses: Float64[np.ndarray, "ends objects 7"]
) -> Bool[np.ndarray, " chunks"]:
    """Whether a wrist, a finger or an object moves within each chunk.

    Commands are those of steps 1 … 80, poses T_world_object at step 0 and at the chunk ends.
    """
    moves = []
    for index in range(len(object_poses) - 1):
        rows = slice(index * CHUNK_STEPS, (index + 1) * CHUNK_STEPS)
        wrists = (commands.Ts_world_wrist_left[rows], commands.Ts_world_wrist_right[rows])
        fingers = (commands.joints_left_rad[rows], commands.joints_right_rad[rows])
        before, after = object_poses[index], object_poses[index + 1]
        turned = 2 * np.arccos(np.clip(np.abs(np.sum(before[:, 3:] * after[:, 3:], axis=1)), 0, 1))
        moves.append(
            any(np.ptp(T[:, :3, 3], axis=0).max() > _STILL_M for T in wrists)
            or any(rotation_angle(T[0, :3, :3].T @ T[:, :3, :3]).max() > _STILL_RAD for T in wrists)
            or any(np.ptp(angles, axis=0).max() > _STILL_RAD for angles in fingers)
            or bool(np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max() > _STILL_M)
            or bool(turned.max() > _STILL_RAD)
        )
    return np.array(moves, dtype=bool)
