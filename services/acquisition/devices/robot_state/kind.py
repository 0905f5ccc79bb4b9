"""The kind `robot_state`."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.robot_state.packets import RobotStateDecoder
from services.acquisition.devices.robot_state.settings import RobotStateSettings
from services.acquisition.devices.tcp import tcp_transport
from services.acquisition.drivers.base import Driver


def build(settings: RobotStateSettings, clock: StationClock) -> Driver:
    """The driver of one robot."""
    decoder = RobotStateDecoder(settings.streams)
    return Driver("robot_state", transport=tcp_transport(settings), decoder=decoder, clock=clock)


KIND = DeviceKind(name="robot_state", settings=RobotStateSettings, build=build)
