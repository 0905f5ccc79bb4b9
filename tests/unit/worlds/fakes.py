"""Small worlds and starts for tests: a noisy integrator whose numbers can be predicted."""

from dataclasses import dataclass, replace

import numpy as np

from dextouch.errors import EndedError, InvalidInputError
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses, check_actions
from dextouch.schemas import EVERYTHING, Observation, ReturnSelector, RolloutStart, WorldDescription
from dextouch.streams import pack, unpack
from dextouch.worlds import StartedRollout, SteppedRollout

CAMERAS = ("camera_head", "camera_wrist_left")
SIZE_PX = 8
K_HEAD = np.array([[70.0, 0.0, 4.0], [0.0, 70.0, 4.0], [0.0, 0.0, 1.0]])


def anchor() -> AnchorPoses:
    T = np.eye(4)
    T[:3, 3] = (0.1, -0.2, 0.3)
    return AnchorPoses(T, np.eye(4), np.eye(4))


def actions(num_steps: int, value: float = 0.0) -> np.ndarray:
    rows = np.full((num_steps, 67), value)
    for part in POSE_SLICES:
        rows[:, part] = IDENTITY_POSE_9D
    return rows


def observation(num_steps: int = 1, seed: int = 0, first_step: int = 0) -> Observation:
    rng = np.random.default_rng(seed)
    return Observation(
        first_step=first_step,
        images={
            camera: rng.integers(0, 255, (num_steps, SIZE_PX, SIZE_PX, 3), dtype=np.uint8)
            for camera in CAMERAS
        },
        tactile_kpa=rng.random((num_steps, 2, 320), dtype=np.float32),
        action_reached=actions(num_steps, 0.1),
        reached_is_measured=True,
    )


@dataclass(frozen=True)
class SumState:
    step: int
    total: float


class SumWorld:
    """Touch is the sum of all joint angles so far plus noise; a chunk with joint 1e6 breaks it.

    A chunk with joint 4e6 ends the rollout.
    """

    def __init__(self, name: str = "sum", digest: str = "d1") -> None:
        self.num_restores = 0
        self.num_steps = 0
        self._description = WorldDescription(
            name=name,
            kind="model",
            digest=digest,
            tasks=("stand_bottle", "stack_bowls"),
            cameras=CAMERAS,
            image_height_px=SIZE_PX,
            image_width_px=SIZE_PX,
            model_rate_hz=15.0,
            action_kinds=("commanded",),
            starts_from=("task_seed", "observation"),
            max_chunk_steps=16,
            knows_success=True,
        )

    @property
    def description(self) -> WorldDescription:
        return self._description

    def reset(self, start: RolloutStart) -> StartedRollout[SumState]:
        state = SumState(0, float(start.seed % 1000))
        first = self._seen(state, np.array([state.total]), actions(1))
        return StartedRollout(state, first, anchor(), K_HEAD)

    def step(
        self,
        state: SumState,
        actions: np.ndarray,
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[SumState]:
        self.num_steps += 1
        actions = check_actions(actions)
        if (actions == 1e6).any():
            raise InvalidInputError("sum: joint 1e6 cannot be reached")
        if (actions == 2e6).any():
            raise RuntimeError("a mistake of the world itself")
        if (actions == 4e6).any():
            raise EndedError("sum: cannot count on", reason="too many to count")
        noise = np.random.default_rng(seed).normal(size=len(actions))
        totals = state.total + np.cumsum(actions[:, 20] + noise)
        if (actions == 3e6).any():
            totals[:] = np.nan
        new = SumState(state.step + len(actions), float(totals[-1]))
        first = replace(state, step=state.step + 1)
        seen = self._seen(first, totals, actions).selected(selector)
        return SteppedRollout(new, seen, {"noise": float(noise[0])})

    def snapshot(self, state: SumState) -> bytes:
        return pack({"step": state.step}, {"total": np.array([state.total])})

    def restore(self, data: bytes) -> SumState:
        self.num_restores += 1
        fields, arrays = unpack(data, max_bytes=1000)
        if set(fields) != {"step"} or set(arrays) != {"total"}:
            raise InvalidInputError("sum: no snapshot of this world")
        return SumState(fields["step"], float(arrays["total"][0]))

    def _seen(self, state: SumState, totals: np.ndarray, rows: np.ndarray) -> Observation:
        n = len(totals)
        return Observation(
            first_step=state.step,
            images={
                camera: np.full((n, SIZE_PX, SIZE_PX, 3), index, np.uint8)
                for index, camera in enumerate(CAMERAS)
            },
            tactile_kpa=np.tile(totals.astype(np.float32)[:, None, None], (1, 2, 320)),
            action_reached=np.array(rows, dtype=np.float64),
            reached_is_measured=True,
            success=bool(totals[-1] > 100) if np.isfinite(totals[-1]) else None,
        )


class BatchSumWorld(SumWorld):
    """The same, several at once; remembers how many came together."""

    def __init__(self) -> None:
        super().__init__("batch-sum")
        self.batch_sizes: list[int] = []

    def step_batch(self, states, actions, *, seeds, selectors=None):
        self.batch_sizes.append(len(states))
        asked = selectors or [EVERYTHING] * len(states)
        return [
            self.step(state, chunk, seed=seed, selector=selector)
            for state, chunk, seed, selector in zip(states, actions, seeds, asked, strict=True)
        ]
