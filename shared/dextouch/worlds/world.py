"""The World protocol: what the twin, every world model and, one day, a real robot implement.

A world is functional: `step` takes a state and gives a new one, so that a failed step leaves the
old state as it was, a step can be replayed, and a rollout can branch. States are opaque to the
caller; `snapshot` and `restore` turn them into bytes for another process.
"""

from dataclasses import dataclass, field
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import BaseModel, ConfigDict

from dextouch.hands.actions import AnchorPoses

ActionKind = Literal["measured", "commanded"]
WorldKind = Literal["twin", "model", "baseline", "robot"]
State = TypeVar("State")


class WorldDescription(BaseModel):
    """What a world is and accepts: the handshake before a rollout."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    kind: WorldKind
    digest: str
    tasks: tuple[str, ...]
    cameras: tuple[str, ...]
    image_height_px: int
    image_width_px: int
    model_rate_hz: float
    action_kinds: tuple[ActionKind, ...]
    starts_from: tuple[Literal["task_seed", "observation"], ...]
    chunk_multiple: int = 4
    max_chunk_steps: int = 64
    knows_success: bool = False


@dataclass(frozen=True)
class Observation:
    """What is seen, felt and measured over n consecutive steps of the model grid.

    `action_reached` is the pose and joint reading as an action, relative to the rollout's step 0:
    measured by a twin or a robot; in an imagined world, which senses no joints, the actions it was
    given (`reached_is_measured` says which).
    """

    first_step: int
    images: dict[str, UInt8[np.ndarray, "n h w 3"]]
    tactile_kpa: Float32[np.ndarray, "n 2 320"]
    action_reached: Float64[np.ndarray, "n 67"]
    reached_is_measured: bool
    success: bool | None = None

    def __len__(self) -> int:
        return len(self.tactile_kpa)


@dataclass(frozen=True)
class RolloutStart:
    """Where a future begins: a task and seed, or an observation made elsewhere.

    `anchor` are the absolute poses of step 0, `K_head` the head camera's matrix in pixels; both
    come with `observation` (one step), and with every first observation that a world gives.
    """

    task: str
    seed: int
    instruction: str
    action_kind: ActionKind = "commanded"
    observation: Observation | None = None
    anchor: AnchorPoses | None = None
    K_head: Float64[np.ndarray, "3 3"] | None = None


@dataclass(frozen=True)
class StartedRollout(Generic[State]):
    """A world's answer to a start: its state, what is seen, and the poses actions refer to."""

    state: State
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class SteppedRollout(Generic[State]):
    """A world's answer to an action chunk: the new state and the K steps that were seen."""

    state: State
    observation: Observation
    info: dict[str, float] = field(default_factory=dict)


class World(Protocol[State]):
    """One world. Implementations are used by one thread at a time."""

    @property
    def description(self) -> WorldDescription:
        """What this world is and accepts."""
        ...

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """Begin a future.

        Raises:
            UnknownNameError: a task this world does not have.
            InvalidInputError: a start this world cannot begin from.
        """
        ...

    def step(
        self, state: State, actions: Float64[np.ndarray, "steps 67"], *, seed: int
    ) -> SteppedRollout[State]:
        """Advance by one checked action chunk.

        Args:
            state: from `reset`, `step` or `restore`; it is not changed.
            actions: [K, 67], row i the pose at step i+1 of the chunk, relative to the rollout's
                step 0 (measured poses), of the action kind the rollout was started with.
            seed: of the noise of this chunk; the same state, actions and seed give the same
                observation whatever else the world is doing.
        """
        ...

    def snapshot(self, state: State) -> bytes:
        """The state as bytes (no pickle) that `restore` of the same world accepts."""
        ...

    def restore(self, data: bytes) -> State:
        """The state of a snapshot.

        Raises:
            InvalidInputError: bytes that are no snapshot of this world.
        """
        ...
