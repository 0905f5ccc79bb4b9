"""Processor time of the twin's chunks by requested cameras and steps."""

import time
from collections.abc import Callable
from functools import partial
from typing import Final

from benchmarks.rounds import every_round
from dextouch.schemas import CHUNK_STEPS, EVERYTHING, ReturnSelector, RolloutStart
from services.twin.scripted_actions import script_name, scripted_actions
from services.twin.settings import TwinSettings
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
