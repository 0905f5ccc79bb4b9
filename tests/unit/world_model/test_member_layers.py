"""Layers of an ensemble, against torch's own layers of its members."""

import pytest
import torch
from torch import nn

from services.world_model.dynamics.core import MemberGRU, MemberLinear, MemberNorm

MEMBERS, BATCH = 3, 4


def inputs(*shape, seed=0):
    return torch.randn(MEMBERS * BATCH, *shape, generator=torch.Generator().manual_seed(seed))


def of_member(values, member):
    return values[member * BATCH : (member + 1) * BATCH]


@torch.no_grad()
@pytest.mark.parametrize("shape", [(5,), (2, 3, 5)])
def test_every_member_has_its_own_linear_layer(shape):
    together, x = MemberLinear(MEMBERS, 5, 7), inputs(*shape)
    for member in range(MEMBERS):
        alone = nn.Linear(5, 7)
        alone.weight.copy_(together.weight[member].T)
        alone.bias.copy_(together.bias[member])
        torch.testing.assert_close(of_member(together(x), member), alone(of_member(x, member)))


@torch.no_grad()
def test_every_member_has_its_own_normalization():
    together, x = MemberNorm(MEMBERS, 6), inputs(6)
    nn.init.normal_(together.weight)
    nn.init.normal_(together.bias)
    for member in range(MEMBERS):
        alone = nn.LayerNorm(6)
        alone.weight.copy_(together.weight[member])
        alone.bias.copy_(together.bias[member])
        torch.testing.assert_close(of_member(together(x), member), alone(of_member(x, member)))


@torch.no_grad()
def test_every_member_has_its_own_recurrent_cell():
    together, x, state = MemberGRU(MEMBERS, 5, 8), inputs(5), inputs(8, seed=1).tanh()
    for member in range(MEMBERS):
        alone = nn.GRUCell(5, 8)
        alone.weight_ih.copy_(together.input.weight[member].T)
        alone.bias_ih.copy_(together.input.bias[member])
        alone.weight_hh.copy_(together.recurrent.weight[member].T)
        alone.bias_hh.copy_(together.recurrent.bias[member])
        expected = alone(of_member(x, member), of_member(state, member))
        torch.testing.assert_close(of_member(together(x, state), member), expected)


def test_weights_are_drawn_as_those_of_a_linear_layer():
    torch.manual_seed(0)
    ours, theirs = MemberLinear(1, 64, 4000), nn.Linear(64, 4000)
    for name in ("weight", "bias"):
        one, other = getattr(ours, name), getattr(theirs, name)
        assert one.std().item() == pytest.approx(other.std().item(), rel=0.03)
        assert one.abs().max().item() <= 64**-0.5
