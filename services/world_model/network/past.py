"""Images that a model remembers: which of those before a window it is given."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from dextouch.hands.actions import ACTION_DIM, POSE_SLICES, WRIST_LEFT, WRIST_RIGHT, pose_from_9d
from services.world_model.network.configuration import (
    FRAMES_PER_LATENT,
    NetworkConfig,
    PastChoice,
)

# Images that a rollout keeps, the oldest dropped: 34 s at the usual stride.
MAX_KEPT: Final = 32
# Two poses are as far apart as their origins and points on their axes: at the length of a hand,
# and for the camera about where it looks, so that a turn counts by what it changes in the image.
_HAND_M, _HEAD_M = 0.1, 0.5


@dataclass(frozen=True)
class PastRule:
    """Which images before a window are chosen: `count` of the last `kept`, `stride` steps apart."""

    count: int
    choice: PastChoice
    stride: int
    kept: int = MAX_KEPT

    @classmethod
    def of(cls, config: NetworkConfig) -> "PastRule | None":
        """The rule of a network; None for one that remembers nothing."""
        if not config.past_images:
            return None
        return cls(config.past_images, config.past_choice, config.past_stride)

    def steps(self, start: int) -> Int64[np.ndarray, " kept"]:
        """Steps of an episode that a rollout would keep before `start`, the oldest first."""
        every = np.arange(start % self.stride, start, self.stride)
        return every[max(0, len(every) - self.kept) :]

    def chosen(
        self, kept: Float64[np.ndarray, "kept 67"], actions: Float64[np.ndarray, "time 67"]
    ) -> list[int]:
        """Indices of the chosen of the kept images, in their order.

        With `nearest`, latent steps of the window take turns, the last one first, and each takes
        the image whose poses of hands and camera are nearest to its own.

        Args:
            kept: actions at the kept images, the oldest first, relative to the window's anchor.
            actions: those of the window, with its first step.
        """
        if self.choice == "recent" or len(kept) <= self.count:
            return list(range(len(kept)))[-self.count :]
        ends = pose_points_m(actions[FRAMES_PER_LATENT::FRAMES_PER_LATENT])[::-1]
        away_m = np.linalg.norm(pose_points_m(kept)[None] - ends[:, None], axis=-1).mean(axis=-1)
        found: list[int] = []
        for turn in range(self.count):
            row = away_m[turn % len(ends)].copy()
            row[found] = np.inf
            # Of equally near ones the newest.
            found.append(len(row) - 1 - int(row[::-1].argmin()))
        return sorted(found)


def pose_points_m(actions: Float64[np.ndarray, "n 67"]) -> Float64[np.ndarray, "n 12 3"]:
    """Origin of wrists and head camera and points on their axes, relative to their anchors."""
    points = []
    for part in POSE_SLICES:
        T = pose_from_9d(actions[:, part])
        reach_m = _HAND_M if part in (WRIST_LEFT, WRIST_RIGHT) else _HEAD_M
        axes = np.swapaxes(T[:, :3, :3], 1, 2) * reach_m
        points.append(T[:, None, :3, 3] + np.concatenate([np.zeros_like(axes[:, :1]), axes], 1))
    return np.concatenate(points, axis=1)


def kept_bytes(config: NetworkConfig) -> int:
    """Most that a rollout keeps of the past: half-precision latents, and poses and step."""
    latents = config.tokens_per_frame * config.video_channels * 2
    return MAX_KEPT * (latents + 8 * (ACTION_DIM + 1)) if config.past_images else 0


@dataclass(frozen=True)
class PastImages:
    """Images before a window, the oldest first, as pixels or as their latents.

    `actions` [n, 67] are relative to the window's anchor, `ages` how many steps ago they were.
    `images` have the views of the network, black where one is missing; `latents` are the codec's.
    """

    actions: Float64[np.ndarray, "n 67"]
    ages: Int64[np.ndarray, " n"]
    images: UInt8[np.ndarray, "n views h w 3"] | None = None
    latents: Float32[np.ndarray, "n tokens channels"] | None = None
