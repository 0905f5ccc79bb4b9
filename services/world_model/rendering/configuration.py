"""Every number that fixes the renderer's shape; stored with its weights."""

from pydantic import BaseModel, ConfigDict, Field

from services.world_model.rendering.camera_motion import Interpolation


class RendererConfig(BaseModel):
    """Shape of the renderer's network and of what it is given.

    Images have any sides divisible by 2^(number of widths); weights do not depend on their size.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    widths: tuple[int, ...] = Field(
        default=(32, 64, 96), min_length=1, max_length=4, description="channels at 1/2, 1/4, …"
    )
    depths: tuple[int, ...] = Field(
        default=(1, 1, 2), min_length=1, max_length=4, description="residual blocks a level"
    )
    stem_px: int = Field(default=1, ge=1, le=5, description="side of the first convolution")
    interpolation: Interpolation = Field(
        default="bicubic", description="of the start image under the camera's motion"
    )
    redraws_table: bool = Field(
        default=True,
        description="whether a moving camera alone opens the whole image to the network",
    )

    @property
    def pixel_multiple(self) -> int:
        """Sides of images must be multiples of this."""
        return 2 ** len(self.widths)
