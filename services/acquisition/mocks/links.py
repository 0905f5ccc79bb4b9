"""How a mock station's devices are connected, and which protocols they speak."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

GloveProtocol = Literal["dextouch", "wuji", "justfloat"]
TrackerLink = Literal["hid", "usb", "bridge"]


class MockLinks(BaseModel):
    """Which of the ways that real stations know the mock devices of a station take.

    Attributes:
        gloves: the protocol of both gloves. Other gloves than ours come without the calibration
            that turns counts into kPa.
        trackers: finger and pose trackers by HID, by USB, or behind an SDK's bridge.
        cameras: images over a socket, or from a camera on the station's own bus.
        wrists: whether a robot or pose trackers give the wrists where there is a robot's state; its
            packets hold them in any case.
        images: how images are encoded: by the bridge, or by the station for a camera of its own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    gloves: GloveProtocol = "dextouch"
    trackers: TrackerLink = "hid"
    wrists: Literal["robot", "trackers"] = "robot"
    cameras: Literal["bridge", "station"] = "bridge"
    images: Literal["rgb8", "jpeg", "h264"] = "rgb8"
