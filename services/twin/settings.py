"""What can be chosen about the twin; physics and geometry belong to the code's version."""

from pydantic import BaseModel, ConfigDict, Field


class TwinSettings(BaseModel):
    """Size of the images, and how long objects settle before a take begins."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    image_height_px: int = Field(default=64, ge=16, le=512)
    image_width_px: int = Field(default=64, ge=16, le=512)
    settle_s: float = Field(default=0.2, ge=0.0, le=2.0)
