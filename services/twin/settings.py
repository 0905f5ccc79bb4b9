"""Settings of the twin and its service; physics and geometry are fixed by the code's version."""

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from dextouch.serving import service_config
from dextouch.worlds import WorldServiceSettings


class TwinSettings(FrozenModel):
    """Cameras of the twin, their image size, and the settling time of objects before a take.

    Rendering a camera takes half as long as the physics, so omit unused ones.
    """

    cameras: tuple[str, ...] = Field(
        default=("camera_head", "camera_wrist_left", "camera_wrist_right"),
        description="cameras to render; each takes half as long as the physics",
    )
    image_height_px: int = Field(default=64, ge=16, le=512, description="height of every image")
    image_width_px: int = Field(default=64, ge=16, le=512, description="width of every image")
    object_width: float = Field(
        default=1.0,
        ge=0.5,
        le=1.5,
        description="factor of the width of objects that can be carried",
    )
    object_height: float = Field(default=1.0, ge=0.5, le=1.5, description="and of their height")
    settle_s: float = Field(
        default=0.2, ge=0.0, le=2.0, description="seconds that objects settle before a take"
    )


class TwinServiceSettings(WorldServiceSettings):
    """Serve the rollouts of the physics twin, and of a baseline that copies the first step.

    Example:
      dextouch twin serve --port 8084
    """

    model_config = service_config("twin", "dextouch twin serve")

    scene: TwinSettings = Field(default=TwinSettings(), description="settings of the scene")
