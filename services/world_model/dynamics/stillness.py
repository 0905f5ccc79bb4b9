"""When hands stand still, and since when a scene is at rest: latent step by latent step.

Counted by latent steps and never by chunks, so that it is the same however a client cuts its
commands into chunks.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

# Hands that move less than this between latent steps stand still.
STILL_M = 1e-4
# After this many latent steps of standing still (2 s) everything has come to rest.
REST_LATENTS = 8


@dataclass(frozen=True)
class Stillness:
    """Which latent steps move hands, and which find a scene at rest.

    `points_m` are where hands stood when they last moved, `num_still` for how many latent steps
    they have stood there, both after the last latent step.
    """

    points_m: Float32[Tensor, "batch 2 6 3"]
    num_still: Int64[Tensor, " batch"]
    moves: Bool[Tensor, "batch latents"]
    at_rest: Bool[Tensor, "batch latents"]

    def runs(self) -> Iterator[tuple[slice, Bool[Tensor, " batch"]]]:
        """Stretches of latent steps in which the same entries are at rest, and which these are."""
        first, num_latents = 0, self.at_rest.shape[1]
        for last in range(1, num_latents + 1):
            if last == num_latents or bool((self.at_rest[:, last] != self.at_rest[:, first]).any()):
                yield slice(first, last), self.at_rest[:, first]
                first = last


def stillness(
    points_m: Float32[Tensor, "batch 2 6 3"],
    num_still: Int64[Tensor, " batch"],
    commanded_m: Float32[Tensor, "batch latents looks 2 6 3"],
) -> Stillness:
    """Follow hands that stood at `points_m` for `num_still` latent steps.

    Hands move when they leave the place where they stood, however slowly. A scene is at rest in
    latent steps that do not move hands and before which they had stood for `REST_LATENTS`.
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
