"""The kind `robot_state`."""

from typing import Literal, get_args

from pydantic import Field

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind, TcpSettings
from services.acquisition.devices.robot_state.packets import RobotStateDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.transports.socket import tcp_transport

RobotStream = Literal[
    "joints_measured",
    "joints_commanded",
    "wrist_left",
    "wrist_right",
    "wrist_left_commanded",
    "wrist_right_commanded",
]


class RobotStateSettings(TcpSettings):
    """A robot's state server at a TCP address.

    `streams` names those of its six streams that are recorded: a station whose trackers give the
    wrists leaves `wrist_left` and `wrist_right` out.
    """

    kind: Literal["robot_state"] = "robot_state"
    streams: tuple[RobotStream, ...] = Field(default=get_args(RobotStream), min_length=1)


def build(settings: RobotStateSettings, clock: StationClock) -> Driver:
    """The driver of one robot."""
    decoder = RobotStateDecoder(settings.streams)
    return Driver(
        "robot_state",
        transport=tcp_transport(settings.host, settings.port),
        decoder=decoder,
        clock=clock,
    )


KIND = DeviceKind(name="robot_state", settings=RobotStateSettings, build=build)
