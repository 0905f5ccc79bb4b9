"""Settings of a robot's state server."""

from typing import Literal, get_args

from pydantic import Field

from services.acquisition.devices.tcp import TcpSettings

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
