"""Per-feature statistics as LeRobot stores them, of numbers and of images."""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Shaped, UInt8

QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
# Maximum number of images per episode, and the side length they are subsampled to.
SAMPLED_IMAGES: Final = 100
SAMPLED_SIDE_PX: Final = 320

Statistics = dict[str, Shaped[np.ndarray, "..."]]


def value_statistics(values: np.ndarray) -> Statistics:
    """Of numbers [frame, ...]: everything but the last axis is pooled, as LeRobot does it.

    Args:
        values: at least one frame; finite.
    """
    rows = np.asarray(values, dtype=np.float64).reshape(-1, values.shape[-1])
    if values.ndim == 1:
        rows = np.asarray(values, dtype=np.float64)[:, None]
    statistics: Statistics = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(values)], dtype=np.int64),
    }
    levels = np.quantile(rows, list(QUANTILES.values()), axis=0)
    statistics.update(zip(QUANTILES, levels, strict=True))
    return statistics


def image_statistics(images: Iterable[UInt8[np.ndarray, "h w 3"]]) -> Statistics:
    """Of at least one image: levels scaled to 0 … 1, each statistic of shape [3, 1, 1].

    Large images are subsampled. The histogram of each channel over 256 levels gives exact
    statistics of any number of images.
    """
    counts, num_images = np.zeros((3, 256), dtype=np.int64), 0
    for image in images:
        step = max(1, -(-max(image.shape[:2]) // SAMPLED_SIDE_PX))
        for channel, levels in enumerate(np.moveaxis(image[::step, ::step], -1, 0)):
            counts[channel] += np.bincount(levels.ravel(), minlength=256)
        num_images += 1
    level = np.arange(256) / 255
    share = counts / counts.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(share, axis=1)
    mean = share @ level
    present = counts > 0
    numbers = {
        "min": level[present.argmax(axis=1)],
        "max": level[255 - present[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, share @ level**2 - mean**2)),
    }
    for name, q in QUANTILES.items():
        # The lowest level with at least that share of the pixels at or below it.
        numbers[name] = level[(cumulative < q - 1e-12).sum(axis=1)]
    result: Statistics = {name: value.reshape(3, 1, 1) for name, value in numbers.items()}
    return result | {"count": np.array([num_images], dtype=np.int64)}


def combine(first: Statistics | None, second: Statistics) -> Statistics:
    """Statistics of two sets of frames together.

    All but the quantiles are those of the union; a quantile is the mean of both, weighted by their
    counts, which is what LeRobot keeps.
    """
    if first is None:
        return second
    num_first, num_second = int(first["count"][0]), int(second["count"][0])
    total = num_first + num_second
    weight = num_second / total
    shift = second["mean"] - first["mean"]
    spread = (1 - weight) * first["std"] ** 2 + weight * second["std"] ** 2
    combined: Statistics = {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": first["mean"] + weight * shift,
        "std": np.sqrt(spread + weight * (1 - weight) * shift**2),
        "count": np.array([total], dtype=np.int64),
    }
    for name in QUANTILES:
        combined[name] = first[name] + weight * (second[name] - first[name])
    return combined


def sample_places(count: int, most: int = SAMPLED_IMAGES) -> Sequence[int]:
    """Evenly spread indices below `count`, at most `most` of them."""
    if count <= most:
        return range(count)
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]
