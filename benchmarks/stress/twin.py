"""Stress of the twin: infeasible commands, hard presses, 1008 steps."""

from functools import cache

import numpy as np

from benchmarks.stress.cells import Check, StageCells, bfloat16
from benchmarks.stress.worlds import (
    NUM_CHUNKS,
    SEED,
    TASK,
    TOUCH_ONLY,
    demonstration,
    peak_kpa,
    play,
    there_and_back,
)
from dextouch.errors import DegenerateRotationError, InvalidInputError, NonFiniteError
from dextouch.hands.actions import JOINTS_LEFT, WRIST_LEFT, WRIST_RIGHT
from dextouch.schemas import Observation, RolloutStart
from dextouch.worlds import StartedRollout
from services.twin.settings import TwinSettings
from services.twin.world import TwinState, TwinWorld

STAGE = StageCells("twin")
# A fingertip has 16 taxels of 16 mm²: 2000 kPa on one of them are 32 N.
_MAX_KPA = 20_000.0


@STAGE.cell(
    "rotations", "wrists turned by π - 1e-6, π and back within a step; columns of sine 2e-6"
)
def _rotations(check: Check) -> None:
    for columns in (
        [-1.0, 0, 0, 0, -1.0, 0],
        [-1.0, 1e-6, 0, -1e-6, -1.0, 0],
        [1.0, 0, 0, 0, -1.0, 0],
        [1.0, 0, 0, 1.0, 2e-6, 0],
    ):
        actions = _still(16)
        actions[4:8, WRIST_LEFT.start + 3 : WRIST_LEFT.stop] = columns
        _answers(check, _step(actions))
    lost = _still(16)
    lost[4, WRIST_LEFT.start + 3 : WRIST_LEFT.stop] = [1.0, 0, 0, 1.0, 5e-7, 0]
    check.refused("columns of sine 5e-7", _step, lost, kind=DegenerateRotationError)


@STAGE.cell("non_finite", "NaN and infinity in actions; 5e-324, 3 m and 50 rad in a step")
def _non_finite(check: Check) -> None:
    world, begun = _begun()
    before = world.snapshot(begun.state)
    for bad in (np.nan, np.inf):
        actions = _still(16)
        actions[3, 41] = bad
        check.refused(f"{bad}", _step, actions, kind=NonFiniteError)
    tiny = _still(16)
    tiny[:, 0] = 5e-324
    _answers(check, _step(tiny))
    for what, column, value in (("3 m", 0, 3.0), ("50 rad", JOINTS_LEFT.start, 50.0)):
        wild = _still(16)
        wild[4:, column] = value
        try:
            _answers(check, _step(wild))
        except InvalidInputError as error:
            check.true(f"{what}: {type(error).__name__}", holds=True)
    check.true("the state stands as it was", world.snapshot(begun.state) == before)
    check.equal("and plays as before", _step(_still(16)).tactile_kpa, _step(_still(16)).tactile_kpa)


@STAGE.cell("touch", "hands in the air; a hand driven 0.4 m down into the table in a second")
def _touch(check: Check) -> None:
    check.at_most("touch of hands in the air", _step(_still(16)).tactile_kpa.max(), 0.0, "kPa")
    world, begun = _begun()
    down = _still(16)
    # Commands are relative to the wrist: down in the world is the anchor's third row.
    direction = begun.anchor.T_world_wrist_right[2, :3]
    down[:, WRIST_RIGHT.start : WRIST_RIGHT.start + 3] -= (
        np.linspace(0.025, 0.4, 16)[:, None] * direction
    )
    chunks = (down, np.repeat(down[-1:], 16, axis=0))
    seen = [stepped.observation for stepped in play(world, begun.state, chunks)]
    for observation in seen:
        _answers(check, observation)
    check.true("the hand feels the table", peak_kpa(seen) > 0)
    check.at_most("peak pressure", peak_kpa(seen), _MAX_KPA, "kPa")


@STAGE.cell("ends", "one step; a rollout cut into chunks of 16 and of 4 steps")
def _ends(check: Check) -> None:
    world, begun = _begun()
    actions = demonstration(16).actions[:16]
    (whole,) = play(world, begun.state, [actions])
    *_, last = play(world, begun.state, np.split(actions, 4))
    check.equal("physics", last.state.physics, whole.state.physics)
    check.true("one step gives one", len(_step(_still(1))) == 1)
    check.refused("no step", lambda: _step(_still(1)[:0]))


@STAGE.cell("precision", "a demonstration's commands rounded to float32 and bfloat16, five chunks")
def _precision(check: Check) -> None:
    actions = demonstration(16).actions
    exact = _reached(actions[:80])
    single = _reached(actions[:80].astype(np.float32).astype(np.float64))
    check.at_most("float32: wrists off", np.abs(single - exact)[:, :3].max(), 1e-3, "m")
    coarse = _reached(bfloat16(actions[:80]).astype(np.float64))
    check.finite("bfloat16: poses", coarse)
    check.at_most("bfloat16: wrists off", np.abs(coarse - exact)[:, :3].max(), 0.01, "m")


@STAGE.cell(
    "long_run", "63 chunks: a demonstration forth and back; hands that stand still", slow=True
)
def _long_run(check: Check) -> None:
    world, begun = _begun()
    chunks = there_and_back(demonstration(16).actions)
    for stepped in play(world, begun.state, chunks):
        _answers(check, stepped.observation)
    off_m = np.abs(stepped.observation.action_reached[-1] - chunks[-1][-1])[:3].max()
    check.at_most("wrist off its last command", off_m, 0.05, "m")
    *_, stepped = play(world, begun.state, [_still(16)] * NUM_CHUNKS)
    drift_m = np.abs(stepped.observation.action_reached[-1] - _still(1)[0])[:3].max()
    check.at_most("still wrist drifts", drift_m, 1e-5, "m")
    check.at_most("still hands feel", stepped.observation.tactile_kpa.max(), 0.0, "kPa")


@STAGE.cell("batch", "two rollouts in turns in one world, and alone in worlds of their own")
def _batch(check: Check) -> None:
    world = TwinWorld(_SETTINGS)
    chunks = np.split(demonstration(16).actions[:32], 2)
    starts = [RolloutStart(TASK, seed, "") for seed in (SEED, SEED + 1)]
    in_turns = zip(
        *(play(world, world.reset(start).state, chunks) for start in starts), strict=True
    )
    *_, together = in_turns
    for start, stepped in zip(starts, together, strict=True):
        own = TwinWorld(_SETTINGS)
        *_, alone = play(own, own.reset(start).state, chunks)
        check.equal("physics", stepped.state.physics, alone.state.physics)


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="physics counts its steps, there is no clock",
    device="MuJoCo steps on the CPU",
)
_SETTINGS = TwinSettings(cameras=())


@cache
def _begun() -> tuple[TwinWorld, StartedRollout[TwinState]]:
    world = TwinWorld(_SETTINGS)
    return world, world.reset(RolloutStart(TASK, SEED, ""))


def _still(num_steps: int) -> np.ndarray:
    return np.repeat(_begun()[1].observation.action_reached[-1:], num_steps, axis=0)


def _step(actions: np.ndarray) -> Observation:
    world, begun = _begun()
    return world.step(begun.state, actions, seed=0, selector=TOUCH_ONLY).observation


def _reached(actions: np.ndarray) -> np.ndarray:
    world, begun = _begun()
    played = play(world, begun.state, np.split(actions, len(actions) // 16))
    return np.concatenate([stepped.observation.action_reached for stepped in played])


def _answers(check: Check, observation: Observation) -> None:
    check.finite("touch", observation.tactile_kpa)
    check.finite("reached poses", observation.action_reached)
    check.at_most("pressure below zero", -float(observation.tactile_kpa.min()), 0.0, "kPa")
