"""Image and array data of a report: head images, taxel maps, residuals and actions."""

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from dextouch.images import encode_jpeg
from dextouch.tactile import colour, hand_canvas
from dextouch.tactile.layout import SIDES

# Photographs larger than this are embedded as JPEG.
MAX_PNG_SIDE_PX = 256


@dataclass(frozen=True)
class EpisodePicture:
    """A few moments of one episode."""

    title: str
    times_s: Float64[np.ndarray, " n"]
    images: UInt8[np.ndarray, "n h w 3"]
    tactile_kpa: Float32[np.ndarray, "n 2 320"]


@dataclass(frozen=True)
class ActionPicture:
    """Actions of one episode on the model grid; commanded ones only for robots."""

    times_s: Float64[np.ndarray, " n"]
    measured: Float64[np.ndarray, "n 67"]
    commanded: Float64[np.ndarray, "n 67"] | None = None


@dataclass(frozen=True)
class PredictionPicture:
    """A few moments of one held-out window, true and predicted."""

    title: str
    times_s: Float64[np.ndarray, " n"]
    true_images: UInt8[np.ndarray, "n h w 3"]
    predicted_images: UInt8[np.ndarray, "n h w 3"]
    true_tactile_kpa: Float32[np.ndarray, "n 2 320"]
    predicted_tactile_kpa: Float32[np.ndarray, "n 2 320"]


@dataclass(frozen=True)
class ReportPictures:
    """Data of all pictures of a report; missing ones are omitted from the page.

    `clock_residuals_ms` maps a stream to its reference times (s) and residuals (ms), [2, n].
    """

    episodes: tuple[EpisodePicture, ...] = ()
    clock_residuals_ms: Mapping[str, Float64[np.ndarray, "2 n"]] = field(default_factory=dict)
    actions: ActionPicture | None = None
    predictions: tuple[PredictionPicture, ...] = ()


@dataclass(frozen=True)
class Moment:
    """One column of a strip: caption, head image, and taxel maps of both hands."""

    caption: str
    image: str
    touch: str


def moments(times_s: np.ndarray, images: np.ndarray, tactile_kpa: np.ndarray) -> list[Moment]:
    """Columns of a strip, as data URLs of embedded images."""
    return [
        Moment(f"{time:.2f} s", data_address(image), data_address(touch_image(taxels)))
        for time, image, taxels in zip(times_s, images, tactile_kpa, strict=True)
    ]


def data_address(image: UInt8[np.ndarray, "h w channels"]) -> str:
    """Data URL of an image: RGB, or RGBA with opacity."""
    if image.shape[2] == 3 and max(image.shape[:2]) > MAX_PNG_SIDE_PX:
        return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(image)).decode()
    png = io.BytesIO()
    Image.fromarray(image).save(png, "PNG")
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()


def touch_image(tactile_kpa: np.ndarray, *, scale: int = 3) -> UInt8[np.ndarray, "h w 4"]:
    """Both hands [2, 320] side by side in hand layout; transparent where there is no taxel."""
    hands = [
        hand_canvas(taxels, side=side) for taxels, side in zip(tactile_kpa, SIDES, strict=True)
    ]
    gap = np.full((hands[0].shape[0], 2), np.nan, dtype=np.float32)
    canvas = np.concatenate([hands[0], gap, hands[1]], axis=1)
    opacity = np.where(np.isnan(canvas), 0, 255).astype(np.uint8)
    both = np.concatenate([colour(canvas), opacity[..., None]], axis=-1)
    return both.repeat(scale, axis=0).repeat(scale, axis=1)
