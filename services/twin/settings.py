"""What can be chosen about the twin; physics and geometry belong to the code's version."""

from pydantic import BaseModel, ConfigDict, Field


class TwinSettings(BaseModel):
    """Cameras that a world shows, their size, and how long objects settle before a take begins.

    A camera that nobody looks at costs half as much as the physics: leave it out.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    cameras: tuple[str, ...] = ("camera_head", "camera_wrist_left", "camera_wrist_right")
    image_height_px: int = Field(default=64, ge=16, le=512)
    image_width_px: int = Field(default=64, ge=16, le=512)
    settle_s: float = Field(default=0.2, ge=0.0, le=2.0)
