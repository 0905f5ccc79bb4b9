"""Settings of the twin: environment `DEXTOUCH_TWIN_*` or arguments in, checked values out."""

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class TwinSettings(BaseSettings):
    """What can be chosen about the twin; physics and geometry are part of the code's version."""

    model_config = SettingsConfigDict(
        env_prefix="DEXTOUCH_TWIN_", env_nested_delimiter="__", frozen=True, extra="forbid"
    )

    image_height_px: int = Field(default=64, ge=16, le=512)
    image_width_px: int = Field(default=64, ge=16, le=512)
    settle_s: float = Field(default=0.2, ge=0.0, le=2.0)
