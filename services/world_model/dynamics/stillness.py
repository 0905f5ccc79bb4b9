"""Detection of resting hands and resting scenes, per latent step.

Counting latent steps instead of chunks makes the result independent of how a client splits its
commands into chunks.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

# Hands that move less than this between latent steps count as still.
STILL_M = 1e-4
# After this many still latent steps (2 s) the scene counts as settled.
REST_LATENTS = 8


@dataclass(frozen=True)
class Stillness:
    """Latent steps in which the hands move, and in which the scene is at rest.

    `points_m` are the hand points when they last moved, `num_still` the number of latent steps
    since then, both after the last latent step.
    """

    points_m: Float32[Tensor, "batch 2 points 3"]
    num_still: Int64[Tensor, " batch"]
    moves: Bool[Tensor, "batch latents"]
    at_rest: Bool[Tensor, "batch latents"]

    def runs(self) -> Iterator[tuple[slice, Bool[Tensor, " batch"]]]:
        """Runs of latent steps in which the same entries are at rest, each with these entries."""
        first, num_latents = 0, self.at_rest.shape[1]
        for last in range(1, num_latents + 1):
            if last == num_latents or bool((self.at_rest[:, last] != self.at_rest[:, first]).any()):
                yield slice(first, last), self.at_rest[:, first]
                first = last


def stillness(
    points_m: Float32[Tensor, "batch 2 points 3"],
    num_still: Int64[Tensor, " batch"],
    commanded_m: Float32[Tensor, "batch latents looks 2 points 3"],
) -> Stillness:
    """Track hands that have stood at `points_m` for `num_still` latent steps.

    Hands move when they leave that position, however slowly. A scene is at rest in latent steps
    without hand motion that follow at least `REST_LATENTS` such steps.
    """
    moved, rested = [], []
    for looks_m in commanded_m.unbind(1):
        off_m = (looks_m - points_m[:, None]).norm(dim=-1).amax((-1, -2, -3))
        moves = off_m >= STILL_M
        rested.append(~moves & (num_still >= REST_LATENTS))
        moved.append(moves)
        points_m = torch.where(moves[:, None, None, None], looks_m[:, -1], points_m)
        num_still = torch.where(moves, 0, num_still + 1)
    return Stillness(points_m, num_still, torch.stack(moved, 1), torch.stack(rested, 1))
