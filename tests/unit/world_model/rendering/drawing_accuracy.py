"""Accuracy of drawn images per chunk of steps, beside copying and warping the start image.

Three metrics: PSNR of whole images, PSNR around objects (where they are or were, plus a few
pixels), and sharpness, the mean absolute Laplacian relative to the true images'.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch.nn import functional

from benchmarks.evaluator.playing import sharpness
from dextouch.errors import InvalidInputError
from dextouch.metrics.image import PEAK, decibels
from dextouch.schemas import CHUNK_STEPS
from services.world_model.rendering.inputs import PreparedScenes, Scenes, drawing_inputs
from services.world_model.rendering.rasters import SceneStates
from services.world_model.rendering.renderer import RendererNetwork
from services.world_model.rendering.training import SceneClip, gather

_REACH_PX = 5
_BATCH = 32


@dataclass(frozen=True)
class DrawingFigures:
    """Image metrics of one chunk; `psnr_objects_db` is NaN without any object."""

    psnr_db: float
    psnr_objects_db: float
    sharpness: float


StatesOf = Callable[[int, SceneClip], SceneStates]


@dataclass(frozen=True)
class DrawingReport:
    """Metrics by method (`copy`, `warp`, `drawn`) and by chunk; chunk 0 holds steps 1 … 16."""

    chunks: dict[str, list[DrawingFigures]]
    num_images: int


def evaluate_drawing(
    network: RendererNetwork,
    clips: Sequence[SceneClip],
    *,
    states_of: StatesOf | None = None,
    chunk_steps: int = CHUNK_STEPS,
) -> DrawingReport:
    """Draw every image of every clip from the clip's first image and compare with the truth.

    Args:
        network: the network to evaluate.
        clips: true images and states.
        states_of: states given to the renderer instead of a clip's true ones, from the clip's
            number and the clip; for example predicted poses.
        chunk_steps: steps per chunk.

    Raises:
        InvalidInputError: no clips.
    """
    if not clips:
        raise InvalidInputError("renderer evaluation: got no clips, expected at least one")
    sums = _Sums()
    for number, clip in enumerate(clips):
        given = clip.states if states_of is None else states_of(number, clip)
        later = np.arange(1, len(clip))
        scenes = gather(clips, np.array([[number, 0]]))
        for rows in np.split(later, range(_BATCH, len(later), _BATCH)):
            sums.num_images += len(rows)
            chunks = (clip.steps[rows] - clip.steps[0] - 1) // chunk_steps
            true = clip.images[rows].astype(np.float64)
            images, region = _drawn(network, scenes, clip.states.take(rows), given.take(rows))
            for method, guesses in {"copy": scenes.images, **images}.items():
                guessed = np.broadcast_to(guesses, true.shape).astype(np.float64)
                sums.add(method, chunks, _rows(guessed, true, region))
    return sums.report()


class _Sums:
    """Errors and sharpness summed by method and chunk."""

    def __init__(self) -> None:
        self.num_images = 0
        self._rows: dict[str, dict[int, list[Float64[np.ndarray, 5]]]] = {}

    def add(self, method: str, chunks: np.ndarray, rows: Float64[np.ndarray, "n 5"]) -> None:
        """Add rows, one per image: squared error, that of objects, their pixels, two Laplacians."""
        for chunk, row in zip(chunks.tolist(), rows, strict=True):
            self._rows.setdefault(method, {}).setdefault(chunk, []).append(row)

    def report(self) -> DrawingReport:
        """All metrics."""
        chunks = {
            method: [_figures(np.stack(by_chunk[chunk])) for chunk in sorted(by_chunk)]
            for method, by_chunk in self._rows.items()
        }
        return DrawingReport(chunks, self.num_images)


def _figures(rows: Float64[np.ndarray, "n 5"]) -> DrawingFigures:
    error, objects_error, objects_pixels, sharp, true_sharp = rows.sum(axis=0)
    objects_db = float("nan")
    if objects_pixels > 0:
        objects_db = float(decibels(objects_error / objects_pixels, peak=PEAK))
    return DrawingFigures(
        float(decibels(error / len(rows), peak=PEAK)), objects_db, float(sharp / true_sharp)
    )


def _drawn(
    network: RendererNetwork, scenes: Scenes, true: SceneStates, given: SceneStates
) -> tuple[dict[str, np.ndarray], Bool[np.ndarray, "n h w"]]:
    """Warped and drawn images, and the true regions of objects."""
    owner = np.zeros(len(true), dtype=np.int64)
    with torch.inference_mode():
        prepared = PreparedScenes.of(scenes)
        inputs = drawing_inputs(prepared, given, owner, network.config)
        images = {"warp": inputs.fine[:, :3], "drawn": network(inputs)}
        shown = inputs if given is true else drawing_inputs(prepared, true, owner, network.config)
    rounded = {
        method: (planes * 255.0).round().clamp(0, 255).permute(0, 2, 3, 1).numpy()
        for method, planes in images.items()
    }
    return rounded, objects_region(shown.fine[:, 11] + shown.fine[:, 13])


def objects_region(shown: torch.Tensor) -> Bool[np.ndarray, "n h w"]:
    """Pixels within five pixels of an object, now or at the start."""
    side = 2 * _REACH_PX + 1
    grown = functional.max_pool2d(shown[:, None], side, stride=1, padding=_REACH_PX)
    return np.asarray(grown[:, 0].numpy() > 0.5)


def _rows(images: np.ndarray, true: np.ndarray, region: np.ndarray) -> Float64[np.ndarray, "n 5"]:
    error = np.square(images - true).mean(axis=-1)
    return np.stack(
        [
            error.mean(axis=(1, 2)),
            (error * region).sum(axis=(1, 2)),
            region.sum(axis=(1, 2)),
            sharpness(images),
            sharpness(true),
        ],
        axis=1,
    )
