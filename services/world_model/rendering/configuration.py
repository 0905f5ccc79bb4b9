"""Configuration of the renderer's network; stored with its weights."""

from typing import Literal

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.networks.training_settings import (
    AdamWSettings,
    Batch,
    BudgetSettings,
    CpuBudget,
    NonNegative,
    Share,
    WarmupSteps,
    WeightDecay,
)

Interpolation = Literal["bilinear", "bicubic"]


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
    interpolation: Interpolation = Field(default="bicubic", description="of the warped start image")
    redraws_table: bool = Field(
        default=True, description="redraw the whole image when only the camera moves"
    )

    @property
    def pixel_multiple(self) -> int:
        """Sides of images must be multiples of this."""
        return 2 ** len(self.widths)


class RendererTraining(AdamWSettings, BudgetSettings):
    """One training run of the renderer."""

    cpu_budget_s: CpuBudget = 400.0
    batch: Batch = 24
    warmup_steps: WarmupSteps = 50
    weight_decay: WeightDecay = 0.01
    gradient_weight: NonNegative = Field(default=0.5, description="image gradient loss")
    sharpness_weight: NonNegative = Field(
        default=0.3, description="edge strength loss (7 px windows)"
    )
    shaken_fraction: Share = Field(default=0.5, description="share of pairs with pose noise")
    shake_m: NonNegative = Field(default=0.003, description="position noise per axis")
    uses_bfloat16: bool = Field(default=True, description="convolve in bfloat16 if that is faster")
