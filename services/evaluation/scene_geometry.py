"""Where bodies are in predicted images, compared with exact labels and depths of the true ones.

A prediction is only an image. Each of its pixels is labelled with the body whose colour, at some
brightness, is nearest; the twin's flat colours make that possible. The same procedure on the true
images gives its own error, which every figure stands beside.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from dextouch.geometry import apply, invert
from dextouch.metrics import geometry as depth_metrics
from dextouch.metrics import trajectory as trajectory_metrics

BACKGROUND, TABLE, FIRST_BODY = 0, 1, 2
# Depth of a pixel that shows nothing (m): the farthest that the twin renders.
FAR_M: Final = 4.0
# Shading of a colour that is lit: ambient light alone … full light.
BRIGHTNESS: Final = (0.3, 1.0)
# A body of fewer pixels has no position.
MIN_PIXELS: Final = 3
# Mean distance at which the accuracy of a trajectory falls to 1/e, as a share of the image's width.
TOLERANCE: Final = 0.05
# A body that moves less than this over a scene has no trajectory to compare.
MIN_PATH_PX: Final = 2.0


@dataclass(frozen=True)
class SceneGeometry:
    """Exact geometry of a scene's true images.

    Labels are 0 for the background, 1 for the table, then bodies: hands and objects. `colours` has
    rows of label, red, green and blue (0 … 1); `table_m` is the depth of the bare table.
    """

    colours: Float64[np.ndarray, "colours 4"]
    labels: Int64[np.ndarray, "shown h w"]
    depth_m: Float64[np.ndarray, "shown h w"]
    table_m: Float64[np.ndarray, "shown h w"]


def labelled(
    images: UInt8[np.ndarray, "shown h w 3"], colours: Float64[np.ndarray, "colours 4"]
) -> Int64[np.ndarray, "shown h w"]:
    """Label of the colour nearest to each pixel, each colour at the brightness that fits best."""
    pixels = images.reshape(-1, 3).astype(np.float64) / 255.0
    rgb = colours[:, 1:]
    scale = (pixels @ rgb.T) / np.maximum((rgb**2).sum(axis=1), 1e-9)
    lit = np.where(colours[:, 0] == BACKGROUND, 1.0, np.clip(scale, *BRIGHTNESS))
    # |p - b c|² = p·p - 2 b p·c + b² c·c; p·p is the same for all colours.
    distance = lit * (lit * (rgb**2).sum(axis=1) - 2.0 * (pixels @ rgb.T))
    return colours[distance.argmin(axis=1), 0].astype(np.int64).reshape(images.shape[:-1])


def centroids(labels: Int64[np.ndarray, "shown h w"], label: int) -> Float64[np.ndarray, "shown 2"]:
    """Mean pixel (u, v) of a label in each image, NaN where it has fewer than three pixels."""
    found = np.full((len(labels), 2), np.nan)
    for index, image in enumerate(labels):
        v, u = np.nonzero(image == label)
        if len(u) >= MIN_PIXELS:
            found[index] = u.mean(), v.mean()
    return found


def trajectory_accuracies(
    geometry: SceneGeometry, images: UInt8[np.ndarray, "shown h w 3"]
) -> list[float]:
    """Accuracy of the trajectory of every body that moves by at least two pixels."""
    seen = labelled(images, geometry.colours)
    found = []
    for label in range(FIRST_BODY, int(geometry.colours[:, 0].max()) + 1):
        true = centroids(geometry.labels, label)
        shown = np.isfinite(true).all(axis=1)
        true = true[shown]
        if len(true) < 2 or np.linalg.norm(np.diff(true, axis=0), axis=1).sum() < MIN_PATH_PX:
            continue
        predicted = centroids(seen, label)[shown]
        tolerance = TOLERANCE * images.shape[2]
        found.append(
            trajectory_metrics.trajectory_accuracy(
                predicted=predicted, true=true, tolerance=tolerance
            )
        )
    return found


def implied_depth(
    geometry: SceneGeometry, images: UInt8[np.ndarray, "shown h w 3"]
) -> Float64[np.ndarray, "shown h w"]:
    """Depth of what each pixel shows: the table's, or the mean depth of that body.

    The mean is of the body's true pixels in the same image, or in all of the scene's if it is
    hidden in that one; a body that is never visible counts as the table.
    """
    seen = labelled(images, geometry.colours)
    depth_m = np.where(seen == BACKGROUND, FAR_M, geometry.table_m)
    for label in range(FIRST_BODY, int(geometry.colours[:, 0].max()) + 1):
        everywhere = geometry.labels == label
        if not everywhere.any():
            continue
        mean_m = geometry.depth_m[everywhere].mean()
        for index in range(len(seen)):
            here = everywhere[index]
            value_m = geometry.depth_m[index][here].mean() if here.any() else mean_m
            depth_m[index][seen[index] == label] = value_m
    return depth_m


def trajectory_accuracy(
    pairs: Iterable[tuple[SceneGeometry, UInt8[np.ndarray, "shown h w 3"]]],
) -> float:
    """Mean over scenes and moving bodies; NaN if none moves."""
    found = [value for pair in pairs for value in trajectory_accuracies(*pair)]
    return float(np.mean(found)) if found else float("nan")


def geometry_error(
    pairs: Iterable[tuple[SceneGeometry, UInt8[np.ndarray, "shown h w 3"]]],
) -> float:
    """AbsRel of the implied depth where the truth shows something, mean over scenes."""
    found = [
        depth_metrics.depth_error(
            predicted_m=implied_depth(geometry, images), true_m=geometry.depth_m
        )
        for geometry, images in pairs
    ]
    return float(np.mean(found)) if found else float("nan")


# Baseline image: an earlier image, warped by the camera's known motion over the table.


def warp_over_table(
    image: UInt8[np.ndarray, "h w 3"],
    K: np.ndarray,
    T_world_then: np.ndarray,
    T_world_now: np.ndarray,
) -> UInt8[np.ndarray, "h w 3"]:
    """Image of a camera now if everything in its earlier image lies on the table plane z = 0.

    Bilinear; pixels outside the image repeat its edge. Rays that miss the table count as
    infinitely far.
    """
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(K).T @ T_world_now[:3, :3].T
    down = rays[:, 2] < -1e-9
    far = np.where(down, -T_world_now[2, 3] / np.where(down, rays[:, 2], 1.0), 1e6)
    points = T_world_now[:3, 3] + far[:, None] * rays
    then = apply(invert(T_world_then), points)
    depth = np.where(np.abs(then[:, 2:]) > 1e-9, then[:, 2:], 1e-9)
    at = (then / depth) @ K.T - 0.5
    return _bilinear(image, at[:, :2]).reshape(height, width, 3)


def _bilinear(image: np.ndarray, at_px: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    height, width = image.shape[:2]
    x = np.clip(at_px[:, 0], 0, width - 1)
    y = np.clip(at_px[:, 1], 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    values: Float64[np.ndarray, "n 3"] = (
        image[top, left] * (1 - fx) * (1 - fy)
        + image[top, right] * fx * (1 - fy)
        + image[bottom, left] * (1 - fx) * fy
        + image[bottom, right] * fx * fy
    )
    return np.round(values).astype(np.uint8)
