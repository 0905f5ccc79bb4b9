"""Stress checks shared by all kinds of world models, and their rollout start."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from benchmarks.evaluator.playing import start_in_twin
from benchmarks.stress.cells import Check, StageCells
from dextouch.clients import PolicyStart
from dextouch.errors import DegenerateRotationError, LimitExceededError, NonFiniteError, ShapeError
from dextouch.hands.actions import JOINTS_LEFT, WRIST_LEFT
from dextouch.schemas import CHUNK_STEPS, Observation, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld, State, SteppedRollout, World
from services.twin.settings import TwinSettings
from services.twin.stage import script_name, scripted_actions
from services.twin.world import TwinWorld

NUM_CHUNKS = 63
# Seed of the twin; not used in training.
SEED = 30_001
TASK = "stand_bottle"
TOUCH_ONLY = ReturnSelector(cameras=())


class Demonstration(NamedTuple):
    """The start of a demonstration, for worlds and for policies, and its commanded actions."""

    start: RolloutStart
    observation: Observation
    policy_start: PolicyStart
    actions: np.ndarray


@dataclass(frozen=True)
class Subject:
    """A world, and a demonstration from whose start it is tried."""

    world: BatchWorld[Any]
    begun: Demonstration

    @property
    def actions(self) -> np.ndarray:
        """Commanded actions of the demonstration."""
        return self.begun.actions

    def still(self, num_steps: int = CHUNK_STEPS) -> np.ndarray:
        """Commands that hold the initial pose."""
        return np.repeat(self.begun.observation.action_reached[-1:], num_steps, axis=0)

    def touching(self, pressure_kpa: float) -> RolloutStart:
        """The start with every taxel at one pressure."""
        seen = self.begun.observation
        tactile_kpa = np.full_like(seen.tactile_kpa, pressure_kpa)
        return replace(self.begun.start, observation=replace(seen, tactile_kpa=tactile_kpa))

    def step(self, actions: np.ndarray, start: RolloutStart | None = None) -> Observation:
        """Observation after the first chunk."""
        state = self.world.reset(start or self.begun.start).state
        return self.world.step(state, actions, seed=1).observation


@cache
def demonstration(image_px: int) -> Demonstration:
    """A demonstration of the twin."""
    settings = TwinSettings(
        cameras=(HEAD_CAMERA,), image_height_px=image_px, image_width_px=image_px
    )
    world = TwinWorld(settings)
    stage = world.stage(TASK)
    begun, start, policy_start = start_in_twin(world, TASK, SEED, stage.task.instruction)
    actions = scripted_actions(stage, SEED, script_name(0.0))
    return Demonstration(start, begun.observation, policy_start, actions)


def add_shared_cells(
    stage: StageCells, subject: Callable[[], Subject], trained_kpa: Callable[[], float]
) -> None:
    """Add the checks of rotations, numbers, touch and batches, the same for every world model.

    `subject` opens what is tried, `trained_kpa` tells the largest pressure of its training.
    """
    stage.cell("rotations", "commands with columns of sine 2e-6 and 5e-7; wrists turned by π")(
        lambda check: check_rotations(check, subject())
    )
    stage.cell(
        "non_finite", "NaN, infinity, 5e-324 and 1e300 in actions; NaN and 1e-40 kPa at the start"
    )(lambda check: check_non_finite(check, subject()))
    stage.cell("touch", "every taxel at 0, -5, 2, 650, 99 999 and 200 000 kPa at the start")(
        lambda check: check_touch(check, subject(), trained_kpa())
    )
    stage.cell("batch", "three rollouts at once and alone, one of them at 650 kPa")(
        lambda check: check_batch(check, subject(), max_kpa=1e-2)
    )


def check_rotations(check: Check, subject: Subject) -> None:
    """Commands with nearly degenerate rotations, and rotations by π."""
    for sine, is_taken in ((2e-6, True), (5e-7, False)):
        actions = subject.still()
        actions[5, WRIST_LEFT.start + 3 : WRIST_LEFT.stop] = [1.0, 0.0, 0.0, 1.0, sine, 0.0]
        if is_taken:
            check_answer(check, subject.step(actions))
        else:
            check.refused(
                f"columns of sine {sine:g}", subject.step, actions, kind=DegenerateRotationError
            )
    turned = subject.still()
    turned[8:, WRIST_LEFT.start + 3 : WRIST_LEFT.stop] = [-1.0, 0, 0, 0, -1.0, 0]
    check_answer(check, subject.step(turned))


def check_non_finite(check: Check, subject: Subject) -> None:
    """NaN, infinity, denormal and huge numbers in actions and starts."""
    state = subject.world.reset(subject.begun.start).state
    before = subject.world.snapshot(state)
    for bad in (np.nan, np.inf, -np.inf):
        for column in (0, 5, JOINTS_LEFT.start):
            actions = subject.still()
            actions[7, column] = bad
            check.refused(
                f"{bad} in actions", subject.world.step, state, actions, kind=NonFiniteError, seed=1
            )
        start = subject.touching(bad)
        check.refused(f"{bad} kPa", subject.step, subject.still(), start)
    for what, column, value in (("1e3 m", 0, 1e3), ("1e300 rad", JOINTS_LEFT.start, 1e300)):
        actions = subject.still()
        actions[7, column] = value
        check.refused(what, subject.world.step, state, actions, seed=1)
    check.true("refused chunks leave the state as it was", subject.world.snapshot(state) == before)
    tiny = subject.still()
    tiny[:, 0] = 5e-324
    check_answer(check, subject.step(tiny, subject.touching(1e-40)))


def check_touch(check: Check, subject: Subject, trained_kpa: float) -> None:
    """Zero, negative and saturated touch; output is bounded by input and training peak."""
    for pressure_kpa in (0.0, -5.0, 2.0, 650.0, 99_999.0):
        observation = subject.step(subject.still(), subject.touching(pressure_kpa))
        check_answer(check, observation)
        excess = observation.tactile_kpa.max() / max(pressure_kpa, trained_kpa)
        check.at_most("peak out over the larger of peak in and trained peak", excess, 1.0 + 1e-6)
    check.refused("2e5 kPa", lambda: subject.step(subject.still(), subject.touching(2e5)))


def check_chunk_ends(check: Check, subject: Subject) -> None:
    """The shortest and longest chunks, and invalid lengths."""
    about = subject.world.description
    for num in (about.chunk_multiple, about.max_chunk_steps):
        observation = subject.step(subject.still(num))
        check.true(f"a chunk of {num} steps gives {num}", len(observation) == num)
    for num in (0, 1, about.chunk_multiple + 1):
        check.refused(f"{num} steps", subject.step, subject.still(num), kind=ShapeError)
    num = about.max_chunk_steps + about.chunk_multiple
    check.refused(f"{num} steps", subject.step, subject.still(num), kind=LimitExceededError)


def check_batch(check: Check, subject: Subject, *, max_kpa: float) -> None:
    """Three rollouts in a batch and alone, one of them with saturated touch."""
    starts = [subject.begun.start, subject.touching(650.0), subject.begun.start]
    chunks = np.stack([subject.actions[:16], subject.still(), subject.still()])
    states = [subject.world.reset(start).state for start in starts]
    together = subject.world.step_batch(states, chunks, seeds=[1, 1, 1])
    for index, stepped in enumerate(together):
        alone = subject.world.step(states[index], chunks[index], seed=1).observation
        touch = np.abs(stepped.observation.tactile_kpa - alone.tactile_kpa).max()
        check.at_most("touch differs", touch, max_kpa, "kPa")
        images = stepped.observation.images[HEAD_CAMERA].astype(int) - alone.images[HEAD_CAMERA]
        check.at_most("images differ", np.abs(images).max(), 1, "levels")
    check.refused("no rollout", subject.world.step_batch, [], chunks[:0], seeds=[])


def play(
    world: World[State], state: State, chunks: Iterable[np.ndarray]
) -> Iterator[SteppedRollout[State]]:
    """Chunk after chunk from a state, with touch but without images."""
    for index, chunk in enumerate(chunks):
        stepped = world.step(state, chunk, seed=index, selector=TOUCH_ONLY)
        state = stepped.state
        yield stepped


def stand_still(subject: Subject) -> list[Observation]:
    """Observations of 63 chunks in which untouched hands stand still."""
    state = subject.world.reset(subject.touching(0.0)).state
    chunks = [subject.still()] * NUM_CHUNKS
    return [stepped.observation for stepped in play(subject.world, state, chunks)]


def peak_kpa(observations: Iterable[Observation]) -> float:
    """The greatest pressure; NaN where any is."""
    return float(np.max([one.tactile_kpa.max() for one in observations]))


def there_and_back(actions: np.ndarray) -> Sequence[np.ndarray]:
    """63 chunks that play a demonstration forward and backward repeatedly."""
    whole = actions[: len(actions) // CHUNK_STEPS * CHUNK_STEPS]
    rounds = np.concatenate([whole, whole[::-1]])
    rows = np.arange(NUM_CHUNKS * CHUNK_STEPS) % len(rounds)
    return [rounds[rows[k : k + CHUNK_STEPS]] for k in range(0, len(rows), CHUNK_STEPS)]


def check_answer(check: Check, observation: Observation) -> None:
    """Check that an observation is finite, with pressures of 0 or more."""
    check.finite("touch", observation.tactile_kpa)
    check.at_most("pressure below zero", -float(observation.tactile_kpa.min()), 0.0, "kPa")
    check.true("images are whole", observation.images[HEAD_CAMERA].dtype == np.uint8)
    if observation.object_poses is not None:
        check.finite("object poses", observation.object_poses)
        length = np.linalg.norm(observation.object_poses[..., 3:], axis=-1)
        check.at_most("quaternions off length 1", np.abs(length - 1).max(), 1e-5)
