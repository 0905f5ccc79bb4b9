"""A test double of demonstrations and of a world: a green hand that must reach a red target."""

from dataclasses import dataclass, replace

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, reanchor
from dextouch.streams.packing import pack
from dextouch.tactile.layout import TactileLayout
from dextouch.worlds.world import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutStart,
    StartedRollout,
    SteppedRollout,
    WorldDescription,
)
from services.evaluation.matched_starts import start_digest
from services.evaluation.policies.cloning_training import DECISION_STRIDE, CloningEpisode, Moment
from services.evaluation.policies.open_loop import ReplayPolicy

SIZE = 32
STEPS = 81
TASKS = ("reach", "reach far")
INSTRUCTIONS = {"reach": "Touch the red spot.", "reach far": "Touch the far red spot."}
REACHED_M = 0.02
TWO_CAMERAS = ("camera_head", "camera_wrist_left")
K_HEAD = np.array([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
ANCHOR = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))


@dataclass(frozen=True)
class Demonstration:
    """One robot episode with images and touch at every step; actions are relative to step 0."""

    episode_id: str
    task: str
    instruction: str
    seed: int
    success: bool
    images: np.ndarray
    tactile_kpa: np.ndarray
    measured: np.ndarray
    commanded: np.ndarray

    @property
    def scene(self) -> str:
        return f"{self.task}/{self.seed}"

    @property
    def num_steps(self) -> int:
        return len(self.measured)

    @property
    def start_digest(self) -> str:
        return start_digest(self.images[0], self.tactile_kpa[0])


def replay(items: list[Demonstration]) -> ReplayPolicy:
    return ReplayPolicy({(item.task, item.seed): item.commanded[1:] for item in items})


def target_m(task: str, seed: int) -> np.ndarray:
    rng = np.random.default_rng([TASKS.index(task), seed])
    return rng.uniform(-0.05, 0.05, 2) + (0.03 if task == "reach far" else 0.0)


def image(hand: np.ndarray, target: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    picture = np.full((SIZE, SIZE, 3), 30.0)
    for channel, place in ((0, target), (1, hand)):
        x, y = (place + 0.1) / 0.2 * SIZE
        picture[..., channel] += 200 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
    return picture.clip(0, 255).astype(np.uint8)


def touch(hand: np.ndarray, target: np.ndarray) -> np.ndarray:
    taxels = np.zeros((2, 320), dtype=np.float32)
    if np.linalg.norm(hand - target) < REACHED_M:
        taxels[0, :16] = 10.0
    return taxels


def action(hand: np.ndarray) -> np.ndarray:
    row = np.zeros(67)
    row[[3, 7, 12, 16, 61, 65]] = 1.0
    row[:2] = hand
    return row


def demonstration(task: str, seed: int, *, noise_m: float = 0.0, name: str = "") -> Demonstration:
    target = target_m(task, seed)
    rng = np.random.default_rng([9, TASKS.index(task), seed])
    goal = target + rng.normal(size=2) * noise_m
    progress = np.clip(np.arange(STEPS) / 48, 0, 1)[:, None]
    path = goal * progress**2 * (3 - 2 * progress)
    actions = np.stack([action(hand) for hand in path])
    return Demonstration(
        episode_id=name or f"{task.replace(' ', '-')}-{seed}-{round(1e3 * noise_m)}",
        task=task,
        instruction=INSTRUCTIONS[task],
        seed=seed,
        success=bool(np.linalg.norm(goal - target) < REACHED_M),
        images=np.stack([image(hand, target) for hand in path]),
        tactile_kpa=np.stack([touch(hand, target) for hand in path]),
        measured=reanchor(actions, 0),
        commanded=actions,
    )


def demonstrations(seeds: range, *, noise_m: float = 0.0) -> list[Demonstration]:
    return [demonstration(t, s, noise_m=noise_m * (s % 3)) for t in TASKS for s in seeds]


def cloning_episode(item: Demonstration) -> CloningEpisode:
    moments = {
        step: Moment(item.images[step], item.tactile_kpa[step])
        for step in range(0, item.num_steps, DECISION_STRIDE)
    }
    about = (item.episode_id, item.task, item.instruction, item.scene, item.success)
    actions = (item.measured, item.commanded)
    return CloningEpisode(*about, ANCHOR, moments, *actions, item.start_digest, item.episode_id)


@dataclass(frozen=True)
class ToyState:
    target: np.ndarray
    step: int
    seen: Observation


class ToyWorld:
    """As `judge` it starts from task and seed and knows success; else only from observations.

    `drift_m` moves the hand away from where it was sent: an imperfect imagination.
    """

    def __init__(
        self,
        name: str,
        *,
        judge: bool,
        drift_m: float = 0.0,
        cameras: tuple[str, ...] = ("camera_head",),
        layout: TactileLayout | None = None,
    ) -> None:
        self.judge = judge
        self.drift_m = drift_m
        self.description = WorldDescription(
            name=name,
            kind="twin" if judge else "model",
            digest=f"{name}-digest",
            tasks=TASKS,
            cameras=cameras,
            image_height_px=SIZE,
            image_width_px=SIZE,
            model_rate_hz=15.0,
            action_kinds=("commanded",),
            starts_from=("task_seed",) if judge else ("observation",),
            knows_success=judge,
            tactile_layout=layout,
        )

    def reset(self, start: RolloutStart) -> StartedRollout[ToyState]:
        target = target_m(start.task, start.seed)
        if self.judge:
            seen = self._observe(target, np.zeros((1, 2)), 0)
        elif start.observation is None:
            raise InvalidInputError("toy: expected an observation")
        else:
            seen = start.observation
        return StartedRollout(ToyState(target, 0, seen), seen, start.anchor or ANCHOR, K_HEAD)

    def step(
        self,
        state: ToyState,
        actions: np.ndarray,
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[ToyState]:
        del seed
        hands = actions[:, :2] + self.drift_m
        seen = self._observe(state.target, hands, state.step + 1)
        after = ToyState(state.target, state.step + len(actions), seen)
        return SteppedRollout(after, seen.selected(selector))

    def _observe(self, target: np.ndarray, hands: np.ndarray, first_step: int) -> Observation:
        success = bool(np.linalg.norm(hands[-1] - target) < REACHED_M)
        return Observation(
            first_step=first_step,
            images=dict.fromkeys(
                self.description.cameras, np.stack([image(hand, target) for hand in hands])
            ),
            tactile_kpa=np.stack([touch(hand, target) for hand in hands]),
            action_reached=np.stack([action(hand) for hand in hands]),
            reached_is_measured=self.judge,
            success=success if self.judge else None,
        )

    def snapshot(self, state: ToyState) -> bytes:
        seen = replace(state.seen)
        arrays = {"target": state.target, "image": seen.images["camera_head"]}
        return pack({"step": state.step}, arrays)

    def restore(self, data: bytes) -> ToyState:
        raise InvalidInputError("toy: one process only")
