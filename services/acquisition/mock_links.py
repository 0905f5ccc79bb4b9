"""Settings of a mock station's connections: links and protocols of its devices."""

from typing import Literal

from pydantic import Field, field_validator

from dextouch.frozen_model import FrozenModel
from services.acquisition.devices.registry import kind_names


class MockLinks(FrozenModel):
    """Which of the ways that real stations know the mock devices of a station take.

    Attributes:
        gloves: the kind of both gloves, ours or one that another package brings. Each says what a
            calibrated station knows of it.
        trackers: finger and pose trackers by HID, or behind an SDK's bridge.
        cameras: images over a socket, or from a camera on the station's own bus.
        wrists: whether a robot or pose trackers give the wrists where there is a robot's state; its
            packets hold them in any case.
        images: how images are encoded: by the bridge, or by the station for a camera of its own.
    """

    gloves: str = Field(
        default="tactile_glove", description="kind of both gloves, ours or of another package"
    )
    trackers: Literal["hid", "bridge"] = Field(
        default="hid", description="how finger and pose trackers are connected"
    )
    wrists: Literal["robot", "trackers"] = Field(
        default="robot", description="what gives the poses of the wrists"
    )
    cameras: Literal["bridge", "station"] = Field(
        default="bridge", description="images over a socket, or from a camera on the station's bus"
    )
    images: Literal["rgb8", "jpeg", "h264"] = Field(
        default="rgb8", description="how images are encoded"
    )

    @field_validator("gloves")
    @classmethod
    def _is_known(cls, gloves: str) -> str:
        if gloves not in kind_names():
            raise ValueError(f"got {gloves!r}, expected a kind of glove: {', '.join(kind_names())}")
        return gloves
