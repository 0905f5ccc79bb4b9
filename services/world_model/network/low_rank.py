"""Low-rank adapters (LoRA, Hu et al. 2022) of the pretrained video expert's linear layers.

A layer W x + b becomes W x + b + s U D x, with D of `rank` rows and U of `rank` columns that begins
at zero, so that training starts at the pretrained function. Adapters are float32 beside weights of
any precision, and can be merged into these.
"""

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

_NAMES: Final = (".lora_down", ".lora_up")


class AdaptedLinear(nn.Linear):
    """A linear layer with an adapter; its weight and bias keep their names."""

    def __init__(self, base: nn.Linear, rank: int, scale: float) -> None:
        super().__init__(base.in_features, base.out_features, device="meta")
        self.weight, self.bias = base.weight, base.bias
        self.scale = scale
        self.lora_down = nn.Parameter(torch.empty(rank, base.in_features))
        self.lora_up = nn.Parameter(torch.zeros(base.out_features, rank))
        nn.init.kaiming_uniform_(self.lora_down, a=5**0.5)

    def forward(self, rows: Float[Tensor, "*batch given"]) -> Float[Tensor, "*batch made"]:
        """The layer's outputs with those of the adapter, in the precision of the former."""
        made = super().forward(rows)
        low = functional.linear(rows.to(self.lora_down.dtype), self.lora_down)
        return made + (self.scale * functional.linear(low, self.lora_up)).to(made.dtype)

    def merged_weight(self) -> Float[Tensor, "made given"]:
        """The weight of a linear layer with the same outputs, but for its precision."""
        change = self.scale * (self.lora_up.float() @ self.lora_down.float())
        return (self.weight.float() + change).to(self.weight.dtype)


def add_adapters(network: nn.Module, rank: int, scale: float) -> None:
    """Give every linear layer of a network an adapter, in place."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if type(child) is nn.Linear:
                setattr(parent, name, AdaptedLinear(child, rank, scale))


def is_adapter(name: str) -> bool:
    """Whether a tensor of this name belongs to an adapter."""
    return name.endswith(_NAMES)


@torch.no_grad()
def merge_adapters(network: nn.Module) -> None:
    """Replace every layer that has an adapter by a linear layer with the same outputs, in place."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, AdaptedLinear):
                plain = nn.Linear(child.in_features, child.out_features, device="meta")
                plain.weight, plain.bias = nn.Parameter(child.merged_weight()), child.bias
                setattr(parent, name, plain.requires_grad_(child.weight.requires_grad))
