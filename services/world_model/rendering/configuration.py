"""Configuration of the renderer's network; stored with its weights."""

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.world_model.rendering.camera_motion import Interpolation


class RendererConfig(FrozenModel):
    """Shape of the renderer's network and of its inputs.

    Image sides must be divisible by 2^(number of widths); weights do not depend on the image size.
    """

    widths: tuple[int, ...] = Field(
        default=(32, 64, 96), min_length=1, max_length=4, description="channels at 1/2, 1/4, …"
    )
    depths: tuple[int, ...] = Field(
        default=(1, 1, 2), min_length=1, max_length=4, description="residual blocks per level"
    )
    stem_px: int = Field(default=1, ge=1, le=5, description="kernel size of the first convolution")
    interpolation: Interpolation = Field(
        default="bicubic", description="interpolation of the warped start image"
    )
    redraws_table: bool = Field(
        default=True,
        description="let the network redraw the whole image when only the camera moves",
    )

    @property
    def pixel_multiple(self) -> int:
        """Sides of images must be multiples of this."""
        return 2 ** len(self.widths)
