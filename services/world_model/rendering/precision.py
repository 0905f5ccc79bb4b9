"""Choice between bfloat16 and float32 for convolutions: the faster one on this processor."""

import copy
import functools
import statistics
import time
from collections.abc import Callable
from typing import Final

import structlog
import torch

from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.inputs import COARSE_CHANNELS, FINE_CHANNELS, DrawingInputs
from services.world_model.rendering.network import RendererNetwork

logger = structlog.get_logger(__name__)
# Measured: 0.8 with AVX-512 BF16 on an Intel processor without AMX, 1.4 to 1.9 on AMD Zen 4. The
# bound lies between, so that noise of the timing does not choose another precision at a restart.
LEAST_SPEEDUP: Final = 1.15
# Chosen: 0.12 to 0.22 s in all on two busy cores.
_ROUNDS: Final = 5
_IMAGES, _SIDE_PX = 2, 64


@functools.cache
def has_fast_bfloat16() -> bool:
    """Whether convolutions are clearly faster in bfloat16; timed once in a process.

    False without timing on processors that emulate bfloat16 (neither AMX nor AVX-512 BF16).
    """
    found = torch.cpu.get_capabilities()
    if not (found.get("amx_bf16", False) or found.get("avx512_bf16", False)):
        return False
    speedup = bfloat16_speedup()
    is_faster = speedup >= LEAST_SPEEDUP
    logger.info(
        "convolution_precision_chosen",
        precision="bfloat16" if is_faster else "float32",
        bfloat16_speedup=round(speedup, 2),
        least_speedup=LEAST_SPEEDUP,
    )
    return is_faster


def uses_bfloat16(*, setting: bool | None) -> bool:
    """A setting, or what is faster here where it is None."""
    return has_fast_bfloat16() if setting is None else setting


def bfloat16_speedup(clock: Callable[[], float] = time.thread_time) -> float:
    """Time of the renderer's layers in float32 over that in bfloat16, median of alternate runs.

    Args:
        clock: processor seconds of this thread, in which everything is computed: with several
            threads on a busy machine the ratio would be that of their waiting.
    """
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        single = RendererNetwork(RendererConfig()).eval()
        half = copy.deepcopy(single).to(torch.bfloat16)
        inputs = DrawingInputs(
            torch.rand(_IMAGES, FINE_CHANNELS, _SIDE_PX, _SIDE_PX),
            torch.rand(_IMAGES, COARSE_CHANNELS, _SIDE_PX // 2, _SIDE_PX // 2),
            torch.ones(_IMAGES, 1, _SIDE_PX, _SIDE_PX),
        )

    def seconds(network: RendererNetwork) -> float:
        started = clock()
        network(inputs)
        return clock() - started

    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            seconds(single), seconds(half)
            ratios = [seconds(single) / seconds(half) for _ in range(_ROUNDS)]
    finally:
        torch.set_num_threads(threads)
    return statistics.median(ratios)
