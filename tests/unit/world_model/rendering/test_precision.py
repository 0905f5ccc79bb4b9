"""bfloat16 is used where it was measured to be faster, not where instructions for it exist."""

import itertools

import pytest
import torch

from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering import renderer
from services.world_model.rendering.renderer import Renderer, RendererNetwork


@pytest.fixture
def processor(monkeypatch):
    """Sets what the processor can do and how much faster it is in bfloat16; counts timings."""
    timed = []

    def become(speedup: float, **capabilities: bool) -> list[float]:
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
        monkeypatch.setattr(renderer, "bfloat16_speedup", lambda: timed.append(speedup) or speedup)
        renderer.has_fast_bfloat16.cache_clear()
        return timed

    yield become
    renderer.has_fast_bfloat16.cache_clear()


@pytest.mark.parametrize(
    ("speedup", "is_used"), [(0.79, False), (1.0, False), (1.1, False), (1.4, True), (8.0, True)]
)
@pytest.mark.parametrize("instructions", ["avx512_bf16", "amx_bf16"])
def test_the_faster_precision_is_kept(processor, instructions, speedup, is_used):
    processor(speedup, **{instructions: True})
    assert renderer.has_fast_bfloat16() is is_used
    drawn_in = next(Renderer(RendererNetwork(RendererConfig()))._network.parameters()).dtype
    assert drawn_in == (torch.bfloat16 if is_used else torch.float32)


def test_a_processor_that_emulates_bfloat16_is_not_timed(processor):
    timed = processor(9.0, avx512_f=True)
    assert renderer.has_fast_bfloat16() is False
    assert timed == []


def test_it_is_timed_once_and_not_where_a_setting_decides(processor):
    timed = processor(2.0, amx_bf16=True)
    assert renderer.uses_bfloat16(setting=False) is False
    assert renderer.uses_bfloat16(setting=True) is True
    assert timed == []
    assert [renderer.uses_bfloat16(setting=None) for _ in range(3)] == [True] * 3
    assert timed == [2.0]


def test_the_speedup_is_the_median_of_alternate_runs():
    # A run to warm up each; then one float32 run and one bfloat16 run that something disturbed.
    seconds = [9.0, 9.0, *(3, 2), *(3, 2), *(30, 2), *(3, 20), *(3, 2)]
    readings = itertools.chain.from_iterable(
        (100.0 * k, 100.0 * k + s) for k, s in enumerate(seconds)
    )
    threads, state = torch.get_num_threads(), torch.random.get_rng_state()
    assert renderer.bfloat16_speedup(lambda: next(readings)) == 1.5
    assert next(readings, None) is None
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.random.get_rng_state(), state)
