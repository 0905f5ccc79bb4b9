"""Hands that hold still for over a thousand steps, in the twin and in imagination."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from benchmarks.evaluator.measuring import psnr_within
from benchmarks.evaluator.plan import STILL_CHUNKS, STILL_SHOWN_EVERY
from dextouch.schemas import CHUNK_STEPS, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import State, World

_NO_IMAGES = ReturnSelector(cameras=())
_LAST_IMAGE = ReturnSelector(cameras=(HEAD_CAMERA,), steps="last")


@dataclass(frozen=True)
class StillRollout:
    """Rollout of hands that hold still: the greatest pressure, and some images."""

    greatest_kpa: float
    images: UInt8[np.ndarray, "shown h w 3"]


def hold_still(
    world: World[State], first: RolloutStart, row: Float64[np.ndarray, "67"]
) -> StillRollout:
    """One command, sent 1008 times; images of every 144th step."""
    started = world.reset(first)
    state, greatest, images = started.state, 0.0, []
    chunk = np.repeat(row[None], CHUNK_STEPS, axis=0)
    for index in range(1, STILL_CHUNKS + 1):
        if index % STILL_SHOWN_EVERY == 0:
            shown = world.step(state, chunk, seed=index, selector=_LAST_IMAGE)
            images.append(shown.observation.images[HEAD_CAMERA][-1])
        step = world.step(state, chunk, seed=index, selector=_NO_IMAGES)
        greatest = max(greatest, float(step.observation.tactile_kpa.max()))
        state = step.state
    return StillRollout(greatest, np.stack(images))


def still_figures(
    imagined: StillRollout, true_images: np.ndarray, first_image: np.ndarray
) -> dict[str, object]:
    """The greatest imagined pressure, and PSNR [imagined, copy of the first image] of each image.

    True images [shown, h, w, 3] are those of the same steps, the first image is that of step 0.
    """
    return {
        "greatest_kpa": imagined.greatest_kpa,
        "psnr": [
            [psnr_within(one, true) for one in (image, first_image)]
            for image, true in zip(imagined.images, true_images, strict=True)
        ],
    }
