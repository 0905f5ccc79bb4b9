"""Settings of a mock station's connections: links and protocols of its devices."""

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator

from dextouch.frozen_model import FrozenModel
from services.acquisition.devices.kinds import kind_names


class MockLinks(FrozenModel):
    """Which of the ways that real stations know the mock devices of a station take."""

    gloves: str = Field(
        default="tactile_glove", description="kind of both gloves, built in or of another package"
    )
    layout: Path | None = Field(
        default=None, description="file with the layout of both gloves, of a pattern that is played"
    )
    trackers: Literal["hid", "bridge"] = Field(
        default="hid", description="connection of finger and pose trackers"
    )
    wrists: Literal["robot", "trackers"] = Field(
        default="robot", description="source of the wrist poses if there is a robot"
    )
    cameras: Literal["bridge", "station"] = Field(
        default="bridge", description="images over a socket, or from a camera on the station's bus"
    )
    images: Literal["rgb8", "jpeg", "h264"] = Field(
        default="rgb8", description="image encoding of the bridge or the station"
    )

    @field_validator("gloves")
    @classmethod
    def _is_known(cls, gloves: str) -> str:
        if gloves not in kind_names():
            raise ValueError(f"got {gloves!r}, expected a kind of glove: {', '.join(kind_names())}")
        return gloves
