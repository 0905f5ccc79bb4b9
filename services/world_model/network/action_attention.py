"""Cross-attention from tokens to the actions that they depend on, an alternative to AdaLN.

Dual rate (equation 4 of the paper): tokens of video latent j attend to the actions 4j-3 … 4j, those
of tactile step t to action t, and those of index 0 to nothing. Every action is three tokens: own
hand, other hand and camera.
"""

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.network.axes import split_axis
from services.world_model.network.mirroring import CAMERA_DIM, HAND_DIM

PART_DIMS = [HAND_DIM, HAND_DIM, CAMERA_DIM]


class ActionTokens(nn.Module):
    """Tokens of the actions of one latent frame or step."""

    def __init__(self, *, num_steps: int, width: int) -> None:
        super().__init__()
        self.parts = nn.ModuleList(
            nn.Sequential(nn.Linear(dim, width), nn.SiLU(), nn.Linear(width, width))
            for dim in PART_DIMS
        )
        self.steps = nn.Parameter(0.02 * torch.randn(num_steps, 1, width))

    def forward(
        self, actions: Float32[Tensor, "*batch steps 67"]
    ) -> Float32[Tensor, "*batch tokens width"]:
        """Three tokens for each step."""
        parts = zip(self.parts, torch.split(actions, PART_DIMS, dim=-1), strict=True)
        tokens = torch.stack([embed(part) for embed, part in parts], dim=-2)
        return (tokens + self.steps).flatten(-3, -2)


class ActionAttention(nn.Module):
    """Attention of each group of tokens to the action tokens of that group.

    Without biases, so that action tokens of zero (index 0) change nothing.
    """

    def __init__(self, *, width: int, num_heads: int, head_width: int) -> None:
        super().__init__()
        inner = num_heads * head_width
        self.num_heads = num_heads
        self.norm = nn.LayerNorm(width)
        self.to_query = nn.Linear(width, inner, bias=False)
        self.to_key_value = nn.Linear(width, 2 * inner, bias=False)
        self.query_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.key_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.to_out = nn.Linear(inner, width, bias=False)

    def forward(
        self,
        tokens: Float32[Tensor, "batch tokens width"],
        actions: Float32[Tensor, "batch groups keys width"],
    ) -> Float32[Tensor, "batch tokens width"]:
        """What the tokens take from their actions; groups are consecutive and of one size."""
        groups = split_axis(self.norm(tokens), 1, (actions.shape[1], -1)).flatten(0, 1)
        query = split_axis(self.to_query(groups), -1, (self.num_heads, -1)).transpose(1, 2)
        both = split_axis(
            self.to_key_value(actions.flatten(0, 1)), -1, (2, self.num_heads, -1)
        ).permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(
            self.query_norm(query), self.key_norm(both[0]), both[1]
        )
        return self.to_out(attended.transpose(1, 2).flatten(2)).reshape(tokens.shape)
