"""`python -m benchmarks gpu`: the steps on processors, and what is said without a card."""

from contextlib import nullcontext

import pytest
import torch

from benchmarks.command import stage_parser
from benchmarks.world_model import card
from dextouch.errors import UnavailableError


def options(*arguments):
    parser = stage_parser("gpu")
    card.add_options(parser)
    return parser.parse_args(["--quick", *arguments])


def bar(*_):
    return nullcontext(lambda _: None)


@pytest.mark.long
def test_the_miniature_is_served_and_trained_on_processors(tmp_path):
    pytest.importorskip("diffusers")
    report = card.measure(options("--device", "cpu", "--preset", "wan-tiny"), tmp_path, bar)
    chunks, trained = report.data["chunks"], report.data["training"]
    assert len(chunks) == 10
    assert len(trained) == 2
    # Decoding all images takes more, and eight rollouts eight times as much as one.
    flops = {name: one.tflop for name, one in chunks.items()}
    assert (
        flops["4 steps, all images"] > flops["4 steps, last image"] > flops["2 steps, last image"]
    )
    assert flops["4 steps, last image, 8 rollouts"] == pytest.approx(
        8 * flops["4 steps, last image"], rel=0.15
    )
    parity, *on_cards = report.requirements
    assert parity.is_met
    assert parity.figure > 1e-4
    assert [one.is_met for one in on_cards] == [None] * 3
    assert report.to_json()


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a card")
def test_without_a_card_nothing_runs_and_another_way_is_named(tmp_path):
    with pytest.raises(UnavailableError, match="--device cpu --preset wan-tiny"):
        card.measure(options(), tmp_path, bar)
