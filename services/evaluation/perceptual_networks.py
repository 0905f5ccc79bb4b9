"""Metrics with pretrained networks of local files: LPIPS, CLIP, DINO (docs/evaluation.md)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.nn import functional

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.tactile import colour
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, TactileLayout
from services.evaluation.prediction_scenes import Future, Scene
from services.networks.weight_files import load_strictly, read_tensors

Pairs = list[tuple[Scene, Future]]
Better = Literal["higher", "lower"]
Of = Literal["images", "touch", "geometry", "objects"]
NO_WEIGHTS: Final = "not available (weights)"
BATCH: Final = 32  # chosen: images of 224 px in some 20 MB
# Mean and deviation by which LPIPS scales images in -1 … 1 (Zhang et al. 2018, reference code).
_LPIPS_SHIFT: Final = (-0.030, -0.088, -0.188)
_LPIPS_SCALE: Final = (0.458, 0.448, 0.450)
_CLIP_MEAN: Final = (0.48145466, 0.4578275, 0.40821073)
_CLIP_STD: Final = (0.26862954, 0.26130258, 0.27577711)
_IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
_IMAGENET_STD: Final = (0.229, 0.224, 0.225)
_INPUT_PX: Final = 224
# AlexNet of torchvision up to its last convolution: channels, kernel, stride, padding.
_CONVOLUTIONS: Final = (
    (64, 11, 4, 2),
    (192, 5, 1, 2),
    (384, 3, 1, 1),
    (256, 3, 1, 1),
    (256, 3, 1, 1),
)
_POOLED_AFTER: Final = (0, 1)  # of torchvision's AlexNet
MIN_LPIPS_PX: Final = 63  # 3 x 3, the size of a kernel, are left after both pools
# Heat maps are enlarged by this factor, so that LPIPS can read them.
_CELL_PX: Final = 4


@dataclass(frozen=True)
class Metric:
    """A figure of predicted futures; `measure` gets all pairs of a task, or of all tasks.

    Without it, `missing` says why the metric is not available.
    """

    name: str
    title: str
    unit: str
    better: Better
    of: Of
    measure: Callable[[Pairs], float] | None
    about: str
    missing: str = ""


class Lpips(nn.Module):
    """Learned perceptual image patch similarity with AlexNet (Zhang et al. 2018): 0 for equals.

    The folder has `alexnet.safetensors` (names of torchvision: features.0.weight, …) and
    `heads.safetensors` (names of the package lpips: lin0.model.1.weight, …).
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        self._taps: list[int] = []
        channels = 3
        for index, (width, kernel, stride, padding) in enumerate(_CONVOLUTIONS):
            layers += [nn.Conv2d(channels, width, kernel, stride, padding), nn.ReLU()]
            self._taps.append(len(layers) - 1)
            if index in _POOLED_AFTER:
                layers.append(nn.MaxPool2d(3, 2))
            channels = width
        self.features = nn.Sequential(*layers)
        self.heads = nn.ModuleList(
            nn.Conv2d(width, 1, 1, bias=False) for width, *_ in _CONVOLUTIONS
        )
        backbone = _tensors(folder / "alexnet.safetensors", "features.")
        heads = _tensors(folder / "heads.safetensors", "")
        renamed = {name.replace("lin", "").replace(".model.1", ""): w for name, w in heads.items()}
        load_strictly({"": self.features}, backbone, where="alexnet.safetensors")
        load_strictly({"": self.heads}, renamed, where="heads.safetensors")
        self.eval().requires_grad_(requires_grad=False)

    def forward(
        self, first: Float32[Tensor, "n 3 h w"], second: Float32[Tensor, "n 3 h w"]
    ) -> Float32[Tensor, " n"]:
        """Distances of images in 0 … 1, at least 63 px high and wide."""
        if min(first.shape[-2:]) < MIN_LPIPS_PX:
            raise InvalidInputError(
                f"LPIPS: got images of {tuple(first.shape[-2:])} px, expected at least "
                f"{MIN_LPIPS_PX}"
            )
        one = _scaled(2 * first - 1, _LPIPS_SHIFT, _LPIPS_SCALE)
        two = _scaled(2 * second - 1, _LPIPS_SHIFT, _LPIPS_SCALE)
        total = torch.zeros(len(first))
        heads = iter(self.heads)
        for index, layer in enumerate(self.features):
            one, two = layer(one), layer(two)
            if index in self._taps:
                change = functional.normalize(one, dim=1, eps=1e-10) - functional.normalize(
                    two, dim=1, eps=1e-10
                )
                total = total + next(heads)(change.square()).mean(dim=(1, 2, 3))
        return total


class PerceptualNetworks:
    """Networks in subfolders `lpips`, `clip`, `aesthetic` and `dino`, each read when first used."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, *names: str) -> bool:
        """Whether these subfolders exist."""
        return all((self._folder / name).is_dir() for name in names)

    @cached_property
    def lpips(self) -> Lpips:
        """LPIPS with AlexNet."""
        return Lpips(self._folder / "lpips")

    @cached_property
    def _clip(self) -> nn.Module:
        from transformers import CLIPVisionModelWithProjection

        return _pretrained(CLIPVisionModelWithProjection, self._folder / "clip")

    @cached_property
    def _dino(self) -> nn.Module:
        from transformers import ViTModel

        return _pretrained(ViTModel, self._folder / "dino")

    @cached_property
    def _aesthetic_head(self) -> nn.Module:
        projection = self._clip.get_parameter("visual_projection.weight")
        head = nn.Linear(len(projection), 1)
        tensors = _tensors(self._folder / "aesthetic" / "head.safetensors", "")
        load_strictly({"": head}, tensors, where="head.safetensors")
        return head

    @torch.no_grad()
    def perceptual_distance(
        self, first: UInt8[np.ndarray, "n h w 3"], second: UInt8[np.ndarray, "n h w 3"]
    ) -> Float32[np.ndarray, " n"]:
        """LPIPS of pairs of images."""
        parts = zip(_batches(first), _batches(second), strict=True)
        return torch.cat([self.lpips(one, two) for one, two in parts]).numpy()

    @torch.no_grad()
    def aesthetic_quality(self, images: UInt8[np.ndarray, "n h w 3"]) -> Float32[np.ndarray, " n"]:
        """Rating of LAION's linear head on normalized CLIP features, divided by ten (VBench)."""
        ratings = []
        for part in _batches(images):
            pixels = _scaled(_resized(part), _CLIP_MEAN, _CLIP_STD)
            features = functional.normalize(self._clip(pixel_values=pixels).image_embeds, dim=1)
            ratings.append(self._aesthetic_head(features)[:, 0] / 10)
        return torch.cat(ratings).numpy()

    @torch.no_grad()
    def subject_consistency(self, images: UInt8[np.ndarray, "n h w 3"]) -> float:
        """Mean similarity of DINO features to those of the image before and the first (VBench).

        For each image after the first, the mean of both cosine similarities, none below 0.
        """
        parts = [_scaled(_resized(p), _IMAGENET_MEAN, _IMAGENET_STD) for p in _batches(images)]
        found = [self._dino(pixel_values=part).last_hidden_state[:, 0] for part in parts]
        features = functional.normalize(torch.cat(found), dim=1)
        before = (features[1:] * features[:-1]).sum(dim=1).clamp_min(0.0)
        first = (features[1:] * features[:1]).sum(dim=1).clamp_min(0.0)
        return float(((before + first) / 2).mean())


def _tensors(path: Path, prefix: str) -> dict[str, Tensor]:
    """Tensors of a file whose names begin with a prefix, without it."""
    if not path.is_file():
        raise NotFoundError(
            f"weights: no file {path.name} in the folder {path.parent.name} of weights; "
            "docs/evaluation.md says how to make it"
        )
    tensors, _ = read_tensors(path, path.name)
    return {
        name.removeprefix(prefix): tensor.float()
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _pretrained(kind: type, folder: Path) -> nn.Module:
    try:
        network, info = kind.from_pretrained(  # type: ignore[attr-defined]
            folder,
            local_files_only=True,
            use_safetensors=True,
            output_loading_info=True,
            ignore_mismatched_sizes=True,
        )
    except (OSError, ValueError, SafetensorError) as error:
        raise InvalidInputError(
            f"weights: the folder {folder.name} holds no {kind.__name__} that transformers can "
            f"read ({error}); docs/evaluation.md says how to make it"
        ) from error
    # transformers gives these random values. DINO has no pooler, and none is used.
    mismatched = {name for name, *_ in info["mismatched_keys"]}
    absent = sorted(mismatched.union(info["missing_keys"]))
    if absent := [name for name in absent if not name.startswith("pooler.")]:
        raise InvalidInputError(
            f"weights: the folder {folder.name} has {len(absent)} tensors of {kind.__name__} "
            f"missing or of another shape than its config.json says, such as {absent[0]}; convert "
            "the published file anew"
        )
    loaded: nn.Module = network.eval().requires_grad_(requires_grad=False)
    return loaded


def _batches(images: UInt8[np.ndarray, "n h w 3"]) -> tuple[Tensor, ...]:
    """Images in 0 … 1 as [batch, 3, h, w], a few at a time."""
    unit = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255.0
    return torch.split(unit, BATCH)


def _scaled(
    images: Float32[Tensor, "n 3 h w"],
    mean: tuple[float, float, float],
    deviation: tuple[float, float, float],
) -> Float32[Tensor, "n 3 h w"]:
    return (images - torch.tensor(mean)[:, None, None]) / torch.tensor(deviation)[:, None, None]


def _resized(images: Float32[Tensor, "n 3 h w"]) -> Float32[Tensor, "n 3 224 224"]:
    """Resized so that the shorter side has 224 px (bicubic), and cropped around the middle."""
    height, width = images.shape[-2:]
    factor = _INPUT_PX / min(height, width)
    size = [round(height * factor), round(width * factor)]
    large = functional.interpolate(
        images, size=size, mode="bicubic", antialias=True, align_corners=False
    ).clamp(0.0, 1.0)
    top, left = (size[0] - _INPUT_PX) // 2, (size[1] - _INPUT_PX) // 2
    return large[..., top : top + _INPUT_PX, left : left + _INPUT_PX]


def heat_maps(
    tactile_kpa: np.ndarray, layout: TactileLayout = DEXTOUCH_V1
) -> UInt8[np.ndarray, "n h w 3"]:
    """Both hands' taxels [n, 2, taxels] as pictures, side by side, four pixels a cell."""
    rows = []
    for hands in tactile_kpa:
        pairs = zip(hands, SIDES, strict=True)
        canvas = np.concatenate(
            [layout.hand_canvas(hand, side=side) for hand, side in pairs], axis=1
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
        maps = [heat_maps(one.tactile_kpa[steps], scene.layout) for one in (future, scene.truth)]
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


# Name, title, direction, what it is of, subfolders of weights that it needs, its function or why it
# needs more than local weights, and its definition.
_Measure = Callable[[PerceptualNetworks, Pairs], float]
_WEIGHTED: Final[tuple[tuple[str, str, Better, Of, tuple[str, ...], _Measure | str, str], ...]] = (
    ("lpips", "LPIPS", "lower", "images", ("lpips",), _lpips,
     "learned perceptual image patch similarity with AlexNet, mean over images"),
    ("aesthetic_quality", "Aesthetic Quality", "higher", "images", ("clip", "aesthetic"),
     _aesthetic_quality,
     "rating of LAION's linear head on CLIP ViT-L/14, divided by ten, mean over images"),
    ("image_quality", "Image Quality", "higher", "images", (),
     "not available: MUSIQ's maintained implementation is non-commercial", "MUSIQ"),
    ("jepa_similarity", "JEPA Similarity", "higher", "images", (),
     "not available: how V-JEPA features are compared is not published",
     "distance of V-JEPA features of all clips"),
    ("subject_consistency", "Subject Consistency", "higher", "images", ("dino",),
     _subject_consistency,
     "similarity of DINO ViT-B/16 features to the image before and the first, as in VBench"),
    ("semantic_alignment", "Semantic Alignment", "higher", "images", (),
     "not available: what the captioning model is asked is not published",
     "similarity of captions of true and predicted clips"),
    ("tactile_lpips", "LPIPS of heat maps", "lower", "touch", ("lpips",), _tactile_lpips,
     "LPIPS of both hands' taxels as pictures on a square-root scale of 0 … 40 kPa"),
)  # fmt: skip


def weighted_metrics(folder: Path | None) -> list[Metric]:
    """Prediction metrics that need pretrained networks, by their own definitions or not at all.

    Metrics whose weights are not in the folder say so.
    """
    networks = None if folder is None else PerceptualNetworks(folder)
    found = []
    for name, title, better, of, folders, function, about in _WEIGHTED:
        measure, missing = None, ""
        if isinstance(function, str):
            missing = function
        elif networks is None or not networks.has(*folders):
            missing = NO_WEIGHTS
        else:
            measure = partial(function, networks)
        found.append(Metric(name, title, "", better, of, measure, about, missing))
    return found
