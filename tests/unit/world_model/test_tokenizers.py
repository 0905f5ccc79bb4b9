"""Learned tactile tokenizers: what is shared, what tells pads apart, and where taxels lie."""

import numpy as np
import pytest
import torch

from dextouch.tactile import DEXTOUCH_V1
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile import build_tokenizer, canvas_cells

LEARNED = ["split_hands", "grid"]


def _tokenizer(name, tokens="hand", channels=48):
    torch.manual_seed(3)
    config = NetworkConfig(tokenizer=name, tactile_tokens=tokens, tactile_channels=channels)
    tokenizer = build_tokenizer(config)
    for parameter in tokenizer.parameters():
        parameter.data.add_(0.05 * torch.randn(parameter.shape))
    return tokenizer.eval()


def _touch(num_hands=4):
    generator = torch.Generator().manual_seed(7)
    kpa = 60 * torch.rand(num_hands, 320, generator=generator)
    return kpa * (torch.rand(num_hands, 320, generator=generator) < 0.3)


def _exchanged(touch, finger, other):
    pads = touch.clone()
    here, there = slice(16 * finger, 16 * finger + 16), slice(16 * other, 16 * other + 16)
    pads[:, here], pads[:, there] = touch[:, there], touch[:, here]
    return pads


@torch.no_grad()
def test_exchanged_fingertips_exchange_their_tokens_except_for_their_identity():
    tokenizer, touch = _tokenizer("split_hands", "pad"), _touch()
    tokens = tokenizer.encode(touch)
    exchanged = tokenizer.encode(_exchanged(touch, 1, 4))
    assert (exchanged[:, 1] - tokens[:, 4]).abs().max() > 0.01
    torch.testing.assert_close(exchanged[:, [0, 2, 3, 5]], tokens[:, [0, 2, 3, 5]])
    # With one identity for all fingers, nothing but the identity was different.
    tokenizer.tip_encoder.identity.copy_(tokenizer.tip_encoder.identity[:1].expand(5, -1))
    tokens = tokenizer.encode(touch)
    exchanged = tokenizer.encode(_exchanged(touch, 1, 4))
    torch.testing.assert_close(exchanged[:, [0, 4, 2, 3, 1, 5]], tokens)


@torch.no_grad()
def test_fingertips_share_their_decoder_and_pads_do_not_hear_each_other():
    tokenizer = _tokenizer("split_hands", "pad")
    tokenizer.tip_decoder.identity.copy_(tokenizer.tip_decoder.identity[:1].expand(5, -1))
    latents = torch.randn(3, 6, 8, generator=torch.Generator().manual_seed(0))
    roots = tokenizer.roots(latents)
    order = [3, 1, 2, 0, 4, 5]
    exchanged = tokenizer.roots(latents[:, order])
    tips, palm = roots[:, :80].reshape(3, 5, 16), roots[:, 80:]
    torch.testing.assert_close(exchanged[:, :80].reshape(3, 5, 16), tips[:, order[:5]])
    torch.testing.assert_close(exchanged[:, 80:], palm)


@torch.no_grad()
def test_a_hand_token_is_the_pad_tokens_side_by_side():
    pads, hand = _tokenizer("split_hands", "pad"), _tokenizer("split_hands", "hand")
    touch = _touch()
    assert hand.encode(touch).shape == (4, 1, 48)
    torch.testing.assert_close(hand.encode(touch).flatten(1), pads.encode(touch).flatten(1))
    hand.load_state_dict(pads.state_dict())


@torch.no_grad()
@pytest.mark.parametrize("name", LEARNED)
def test_no_touch_is_the_zero_latent_and_the_zero_latent_no_touch(name):
    tokenizer = _tokenizer(name)
    silent = torch.stack([torch.zeros(320), torch.full((320,), -2.0)])
    assert (tokenizer.encode(silent) == 0).all()
    assert (tokenizer.decode(torch.zeros(2, 1, 48)) == 0).all()
    assert (tokenizer.decode(torch.randn(5, 1, 48)) >= 0).all()
    assert torch.isfinite(tokenizer.decode(tokenizer.encode(torch.full((1, 320), 1e5)))).all()


@torch.no_grad()
@pytest.mark.parametrize("name", LEARNED)
def test_axes_before_the_taxels_are_kept(name):
    tokenizer, touch = _tokenizer(name), _touch(12)
    together = tokenizer.encode(touch.reshape(3, 2, 2, 320))
    assert together.shape == (3, 2, 2, 1, 48)
    torch.testing.assert_close(together.reshape(12, 1, 48), tokenizer.encode(touch))
    assert tokenizer.decode(together).shape == (3, 2, 2, 320)


@pytest.mark.parametrize("name", LEARNED)
def test_every_weight_has_a_gradient(name):
    tokenizer, touch = _tokenizer(name), _touch()
    torch.autograd.backward(tokenizer.roots(tokenizer.encode(touch)).square().sum())
    without = [n for n, p in tokenizer.named_parameters() if p.grad is None or not p.grad.any()]
    assert not without


def test_the_grid_lays_out_every_taxel_once_where_its_table_says():
    # Rows of the 20 × 20 canvas by hand: T thumb, I index, M middle, R ring, L little, P palm.
    tips = "TTTTIIIIMMMMRRRRLLLL"
    rows = [tips] * 4 + ["..PPPPPPPPPPPPPPPP.."] * 15 + ["." * 20]
    counted = dict.fromkeys("TIMRLP", 0)
    first_taxel = {"T": 0, "I": 16, "M": 32, "R": 48, "L": 64, "P": 80}
    expected = {}
    # Within a pad taxels run row by row, as the canvas is read.
    for row, letters in enumerate(rows):
        for column, letter in enumerate(letters):
            if letter != ".":
                expected[first_taxel[letter] + counted[letter]] = 20 * row + column
                counted[letter] += 1
    cells, shape = canvas_cells(DEXTOUCH_V1)
    assert shape == (20, 20)
    assert cells.tolist() == [expected[taxel] for taxel in range(320)]
    assert len(set(cells.tolist())) == 320


@torch.no_grad()
def test_the_grid_network_sees_the_canvas_and_is_read_back_from_it():
    tokenizer, given = _tokenizer("grid"), []
    tokenizer.encoder.register_forward_hook(lambda _, inputs, __: given.append(inputs[0]))
    touch = _touch(2)
    tokenizer.encode(touch)
    canvas = given[0][:, 0]
    # Index fingertip, second row, third column; palm, last row, first column.
    root = touch.sqrt()
    torch.testing.assert_close(canvas[:, 1, 6], root[:, 16 + 4 + 2])
    torch.testing.assert_close(canvas[:, 18, 2], root[:, 80 + 14 * 16])
    assert canvas.count_nonzero() == touch.count_nonzero()
    drawn = torch.arange(400.0).reshape(1, 1, 20, 20)
    tokenizer.decoder.forward = lambda _: drawn
    decoded = tokenizer.decode(torch.zeros(1, 1, 48))
    np.testing.assert_allclose(decoded[0, [22, 304]], [26.0**2, 362.0**2])


def test_grid_and_split_hands_are_of_one_size():
    sizes = []
    for name in LEARNED:
        tokenizer = build_tokenizer(NetworkConfig(tokenizer=name))
        assert tokenizer.num_tokens * tokenizer.channels == 192
        sizes.append(sum(p.numel() for p in tokenizer.parameters()))
    assert sizes[0] == pytest.approx(sizes[1], rel=0.02)
