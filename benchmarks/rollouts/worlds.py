"""Worlds of the benchmark: one that computes nothing, and a device that takes a known time."""

import time
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses, check_actions
from dextouch.schemas import EVERYTHING, Observation, ReturnSelector, RolloutStart, WorldDescription
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import StartedRollout, SteppedRollout

SIZE_PX = 64
MAX_STEPS = 16
# A batch of n takes 5 ms · (0.8 + 0.2 n).
DEVICE_S = 5e-3
FIXED_SHARE = 0.8


def resting_actions(num_steps: int) -> Float64[np.ndarray, "steps 67"]:
    """Actions that hold everything still."""
    rows = np.zeros((num_steps, 67))
    for part in POSE_SLICES:
        rows[:, part] = IDENTITY_POSE_9D
    return rows


class StillWorld:
    """Returns the same prepared observation for every chunk.

    `is_quick`: whether the service may call it in its event loop.
    """

    def __init__(self, *, is_quick: bool = True) -> None:
        self.is_quick = is_quick
        self.description = WorldDescription(
            name="still",
            kind="model",
            digest="still",
            tasks=("rest",),
            cameras=(HEAD_CAMERA,),
            image_height_px=SIZE_PX,
            image_width_px=SIZE_PX,
            model_rate_hz=15.0,
            action_kinds=("commanded",),
            starts_from=("task_seed",),
            max_chunk_steps=MAX_STEPS,
        )
        generator = np.random.default_rng(0)
        # A slope of colours with the noise of a camera, so that JPEG has usual work to do.
        place = np.arange(SIZE_PX)
        slope = 2.0 * place[:, None, None] + place[:, None] + np.array([0.0, 20.0, 40.0])
        noise = generator.normal(0.0, 2.0, (MAX_STEPS, SIZE_PX, SIZE_PX, 3))
        self._images = np.clip(slope + noise, 0, 255).astype(np.uint8)
        self._touch = generator.random((MAX_STEPS, 2, 320), dtype=np.float32)

    def reset(self, start: RolloutStart) -> StartedRollout[int]:
        """See World."""
        anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
        return StartedRollout(0, self._seen(0, resting_actions(1)), anchor, np.eye(3))

    def step(
        self,
        state: int,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[int]:
        """See World."""
        seen = self._seen(state + 1, check_actions(actions)).selected(selector)
        return SteppedRollout(state + len(actions), seen)

    def snapshot(self, state: int) -> bytes:
        """See World."""
        return str(state).encode()

    def restore(self, data: bytes) -> int:
        """See World."""
        return int(data)

    def _seen(self, first_step: int, actions: np.ndarray) -> Observation:
        n = len(actions)
        return Observation(
            first_step=first_step,
            images={HEAD_CAMERA: self._images[:n]},
            tactile_kpa=self._touch[:n],
            action_reached=actions,
            reached_is_measured=True,
        )


class Device(StillWorld):
    """Simulated device that computes one rollout at a time."""

    def step(
        self,
        state: int,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[int]:
        """See World."""
        time.sleep(DEVICE_S)
        return super().step(state, actions, seed=seed, selector=selector)


class BatchDevice(Device):
    """Simulated device whose time per batch hardly depends on the batch size."""

    def step_batch(
        self,
        states: Sequence[int],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[int]]:
        """See BatchWorld."""
        time.sleep(DEVICE_S * (FIXED_SHARE + (1 - FIXED_SHARE) * len(states)))
        asked = [EVERYTHING] * len(states) if selectors is None else selectors
        return [
            StillWorld.step(self, state, chunk, seed=seed, selector=selector)
            for state, chunk, seed, selector in zip(states, actions, seeds, asked, strict=True)
        ]
