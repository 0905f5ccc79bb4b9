"""Random windows of episodes as training requests and targets.

Windows are cut from whole episodes read once, through the same re-anchoring that the store's
reader uses, so that an epoch touches no disk. `services.world_model.training.streaming` has the
same windows of episodes that stay on the disk.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, poses_from_actions, reanchor
from dextouch.worlds.world import ActionKind
from services.world_model.network.inputs import PredictionRequest


@dataclass(frozen=True)
class Place:
    """Where a window lies: steps start … start + num_steps − 1 of one of several episodes.

    `from_command` anchors commanded actions at the first step's *commanded* pose.
    """

    episode_index: int
    start: int
    num_steps: int
    action_kind: ActionKind = "measured"
    from_command: bool = False


@runtime_checkable
class TrainingEpisode(Protocol):
    """An episode that windows are cut from, in memory or on the disk."""

    @property
    def episode_id(self) -> str:
        """Its name in the store."""
        ...

    @property
    def task(self) -> str:
        """What is done in it."""
        ...

    @property
    def seed(self) -> int | None:
        """Of the scene, if it was made by the twin."""
        ...

    @property
    def action_kinds(self) -> tuple[ActionKind, ...]:
        """The kinds of actions it holds."""
        ...

    def content_hash(self) -> str:
        """The `fingerprint` of its content."""
        ...

    def __len__(self) -> int:
        """Its steps."""
        ...

    def cut(self, place: Place) -> "Window":
        """The window at a place in this episode."""
        ...


@dataclass(frozen=True)
class EpisodeArrays:
    """One episode on the model grid, ready for cutting; actions relative to its step 0."""

    episode_id: str
    task: str
    instruction: str
    seed: int | None
    images: UInt8[np.ndarray, "steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 320"]
    tactile_valid: Bool[np.ndarray, "steps 2"]
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    model_rate_hz: float

    def __len__(self) -> int:
        return len(self.tactile_kpa)

    @property
    def action_kinds(self) -> tuple[ActionKind, ...]:
        """The kinds of actions it holds."""
        return tuple(self.actions)

    def content_hash(self) -> str:
        """The `fingerprint` of its content."""
        return fingerprint(self)

    def cut(self, place: Place) -> "Window":
        """The window at a place in this episode."""
        return cut_window(
            self,
            place.start,
            place.num_steps,
            action_kind=place.action_kind,
            from_command=place.from_command,
        )


@dataclass(frozen=True)
class Window:
    """One slice of an episode: what is asked of the model and what came true."""

    request: PredictionRequest
    images: UInt8[np.ndarray, "time h w 3"]
    tactile_kpa: Float32[np.ndarray, "time 2 320"]
    tactile_valid: Bool[np.ndarray, "time 2"]


@dataclass(frozen=True)
class WindowBatch:
    """Windows of one length."""

    requests: list[PredictionRequest]
    images: UInt8[Tensor, "batch time px px 3"]
    tactile_kpa: Float32[Tensor, "batch time 2 320"]
    tactile_valid: Bool[Tensor, "batch time 2"]


def fingerprint(episode: EpisodeArrays) -> str:
    """SHA-256 of what was seen, felt and done: the same data under another name is found out."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(episode.images).tobytes())
    digest.update(np.ascontiguousarray(episode.tactile_kpa, dtype="<f4").tobytes())
    for kind in sorted(episode.actions):
        digest.update(kind.encode())
        # Rounded to a micrometre: re-anchoring on the way here changes the last bits. Adding zero
        # turns minus zero into zero.
        rounded = episode.actions[kind].round(6) + 0.0
        digest.update(np.ascontiguousarray(rounded, dtype="<f8").tobytes())
    return digest.hexdigest()


def combined_hash(fingerprints: Sequence[str]) -> str:
    """One hash of a set of episodes, whatever their order."""
    return hashlib.sha256("\n".join(sorted(fingerprints)).encode()).hexdigest()


def cut_window(
    episode: EpisodeArrays,
    start: int,
    num_steps: int,
    *,
    action_kind: ActionKind = "measured",
    from_command: bool = False,
) -> Window:
    """Steps start … start + num_steps - 1, re-anchored to the first of them.

    Args:
        episode: what to cut from.
        start: first step.
        num_steps: 1 + 4k.
        action_kind: of the actions the model is given.
        from_command: with commanded actions, anchor at the first step's *commanded* pose, which
            is what a served rollout does after its first chunk: it senses no pose of its own.

    Raises:
        InvalidInputError: a slice outside the episode or actions it does not have.
    """
    if not 0 <= start <= len(episode) - num_steps:
        raise InvalidInputError(
            f"episode {episode.episode_id}: got steps {start} … {start + num_steps - 1}, "
            f"expected them inside 0 … {len(episode) - 1}"
        )
    if action_kind not in episode.actions:
        raise InvalidInputError(
            f"episode {episode.episode_id}: has no {action_kind} actions, only "
            f"{sorted(episode.actions)}"
        )
    steps = slice(start, start + num_steps)
    origin_kind = action_kind if from_command else "measured"
    origin = episode.actions[origin_kind][start]
    actions = reanchor(episode.actions[action_kind][steps], 0, anchor_action=origin)
    request = PredictionRequest(
        first_image=episode.images[start],
        first_tactile_kpa=episode.tactile_kpa[start],
        actions=actions,
        action_kind=action_kind,
        instruction=episode.instruction,
        anchor=poses_from_actions(origin[None], episode.anchor).anchor(0),
        K_head=episode.K_head,
    )
    return Window(
        request, episode.images[steps], episode.tactile_kpa[steps], episode.tactile_valid[steps]
    )


def stack_windows(windows: Sequence[Window]) -> WindowBatch:
    """Windows of one length as a batch."""
    return WindowBatch(
        [window.request for window in windows],
        torch.from_numpy(np.stack([window.images for window in windows])),
        torch.from_numpy(np.stack([window.tactile_kpa for window in windows])),
        torch.from_numpy(np.stack([window.tactile_valid for window in windows])),
    )


class WindowSampler:
    """Draws windows evenly over episodes and starts.

    Args:
        episodes: at least one, each at least `max_steps` long.
        rng: decides everything that is random.
        commanded_fraction: of the windows of episodes that hold commanded actions.
        chained_fraction: of the commanded windows, those anchored like a later chunk.
    """

    def __init__(
        self,
        episodes: Sequence[TrainingEpisode],
        rng: np.random.Generator,
        *,
        max_steps: int,
        commanded_fraction: float = 0.5,
        chained_fraction: float = 0.3,
    ) -> None:
        short = [e.episode_id for e in episodes if len(e) < max_steps]
        if not episodes or short:
            raise InvalidInputError(
                f"training episodes: got {len(episodes)}, of which {len(short)} are shorter than "
                f"{max_steps} steps {short[:3]}; expected at least one and none too short"
            )
        self._episodes = list(episodes)
        self._rng = rng
        self._commanded_fraction = commanded_fraction
        self._chained_fraction = chained_fraction

    def draw(self, batch: int, num_steps: int) -> WindowBatch:
        """A batch of random windows."""
        return self.cut(self.places(batch, num_steps))

    def places(self, batch: int, num_steps: int) -> list[Place]:
        """Where the windows of the next batch lie."""
        return [self._place(num_steps) for _ in range(batch)]

    def cut(self, places: Sequence[Place]) -> WindowBatch:
        """The windows at these places."""
        return stack_windows([self._episodes[p.episode_index].cut(p) for p in places])

    def _place(self, num_steps: int) -> Place:
        index = int(self._rng.integers(len(self._episodes)))
        episode = self._episodes[index]
        start = int(self._rng.integers(len(episode) - num_steps + 1))
        is_commanded = self._rng.random() < self._commanded_fraction
        is_chained = bool(self._rng.random() < self._chained_fraction)
        if not is_commanded or "commanded" not in episode.action_kinds:
            return Place(index, start, num_steps)
        return Place(index, start, num_steps, action_kind="commanded", from_command=is_chained)
