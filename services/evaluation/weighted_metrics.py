"""Prediction metrics that need pretrained networks, by their own definitions or not at all."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import UInt8

from dextouch.tactile import colour, hand_canvas
from dextouch.tactile.layout import SIDES
from services.evaluation.perceptual_networks import PerceptualNetworks
from services.evaluation.prediction_scenes import Future, Scene

Pairs = list[tuple[Scene, Future]]
# Subfolders of weights that each metric needs.
FOLDERS: Final[dict[str, tuple[str, ...]]] = {
    "lpips": ("lpips",),
    "tactile_lpips": ("lpips",),
    "aesthetic_quality": ("clip", "aesthetic"),
    "subject_consistency": ("dino",),
}
NO_WEIGHTS: Final = "not available (weights)"
# Metrics of the paper's table whose definition needs more than local weights.
UNDEFINED: Final = {
    "image_quality": "not available: MUSIQ's maintained implementation is non-commercial",
    "jepa_similarity": "not available: how V-JEPA features are compared is not published",
    "semantic_alignment": "not available: what the captioning model is asked is not published",
}
# Heat maps are enlarged by this factor, so that LPIPS can read them.
_CELL_PX: Final = 4


def weighted_measures(folder: Path | None) -> dict[str, Callable[[Pairs], float] | str]:
    """Functions of the metrics whose weights are in a folder; for others, why there is none."""
    networks = None if folder is None else PerceptualNetworks(folder)
    functions: dict[str, Callable[[PerceptualNetworks, Pairs], float]] = {
        "lpips": _lpips,
        "tactile_lpips": _tactile_lpips,
        "aesthetic_quality": _aesthetic_quality,
        "subject_consistency": _subject_consistency,
    }
    found: dict[str, Callable[[Pairs], float] | str] = dict(UNDEFINED)
    for name, function in functions.items():
        if networks is None or not networks.has(*FOLDERS[name]):
            found[name] = NO_WEIGHTS
        else:
            found[name] = _bound(function, networks)
    return found


def _bound(
    function: Callable[[PerceptualNetworks, Pairs], float], networks: PerceptualNetworks
) -> Callable[[Pairs], float]:
    return lambda pairs: function(networks, pairs)


def heat_maps(tactile_kpa: np.ndarray) -> UInt8[np.ndarray, "n h w 3"]:
    """Both hands' taxels [n, 2, 320] as pictures, side by side, four pixels a cell."""
    rows = []
    for hands in tactile_kpa:
        canvas = np.concatenate(
            [hand_canvas(hand, side=side) for hand, side in zip(hands, SIDES, strict=True)], axis=1
        )
        rows.append(np.kron(colour(canvas), np.ones((_CELL_PX, _CELL_PX, 1), dtype=np.uint8)))
    return np.stack(rows)


def _lpips(networks: PerceptualNetworks, pairs: Pairs) -> float:
    """Mean over images."""
    parts = [networks.perceptual_distance(one.images, scene.truth.images) for scene, one in pairs]
    return float(np.concatenate(parts).mean())


def _tactile_lpips(networks: PerceptualNetworks, pairs: Pairs) -> float:
    """Mean over the heat maps of the steps that have images."""
    parts = []
    for scene, future in pairs:
        steps = np.array(future.image_steps) - 1
        maps = [heat_maps(one.tactile_kpa[steps]) for one in (future, scene.truth)]
        parts.append(networks.perceptual_distance(*maps))
    return float(np.concatenate(parts).mean())


def _aesthetic_quality(networks: PerceptualNetworks, pairs: Pairs) -> float:
    """Mean over images."""
    parts = [networks.aesthetic_quality(future.images) for _, future in pairs]
    return float(np.concatenate(parts).mean())


def _subject_consistency(networks: PerceptualNetworks, pairs: Pairs) -> float:
    """Mean over scenes, of the first image and those predicted from it."""
    values = [
        networks.subject_consistency(np.concatenate([scene.first_image, future.images]))
        for scene, future in pairs
    ]
    return float(np.mean(values))


Better = Literal["higher", "lower"]
# Name, title, direction, definition, and what it is of.
DESCRIPTIONS: Final[tuple[tuple[str, str, Better, str, Literal["images", "touch"]], ...]] = (
    (
        "lpips",
        "LPIPS",
        "lower",
        "learned perceptual image patch similarity with AlexNet, mean over images",
        "images",
    ),
    (
        "aesthetic_quality",
        "Aesthetic Quality",
        "higher",
        "rating of LAION's linear head on CLIP ViT-L/14, divided by ten, mean over images",
        "images",
    ),
    (
        "image_quality",
        "Image Quality",
        "higher",
        "MUSIQ",
        "images",
    ),
    (
        "jepa_similarity",
        "JEPA Similarity",
        "higher",
        "distance of V-JEPA features of all clips",
        "images",
    ),
    (
        "subject_consistency",
        "Subject Consistency",
        "higher",
        "similarity of DINO ViT-B/16 features to the image before and the first, as in VBench",
        "images",
    ),
    (
        "semantic_alignment",
        "Semantic Alignment",
        "higher",
        "similarity of captions of true and predicted clips",
        "images",
    ),
    (
        "tactile_lpips",
        "LPIPS of heat maps",
        "lower",
        "LPIPS of both hands' taxels as pictures on a square-root scale of 0 … 40 kPa",
        "touch",
    ),
)
