"""Definition of a kind of device for a station, and the base class of its settings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver

# Names of streams are ROLE_LABEL or ROLE_LABEL_SIDE; the role says what reads them.
StreamName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
# `camera_head` is what episodes need; any number of others may stand beside it.
CameraStream = Annotated[str, Field(pattern=r"^camera_[a-z0-9_]{1,57}$")]


class DeviceSettings(FrozenModel):
    """Settings of one device of a station; every kind derives its own class.

    `kind` names the kind. A derived class narrows it to that name and makes it the default:
    `kind: Literal["wuji_glove"] = "wuji_glove"`. Unknown keys are refused.
    """

    kind: str


class TcpSettings(DeviceSettings):
    """A device at a TCP address."""

    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)


SettingsT = TypeVar("SettingsT", bound=DeviceSettings)


@dataclass(frozen=True)
class DeviceKind(Generic[SettingsT]):
    """One kind of device: how it is called, configured, read and simulated.

    Our own kinds and those of other packages are found by the entry point `dextouch.devices`, whose
    name is that of the kind. The decoder of a glove provides its cells (`TellsCells`), so that
    health checks treat real and simulated gloves alike.

    Attributes:
        name: the value of `kind` in a station's settings: a-z, 0-9 and `_`.
        settings: the class that validates the rest of them.
        build: makes the driver, not opened yet, from the settings and the station's clock. It
            raises InvalidInputError where the settings do not say where the device is.
        mock: where a function is that simulates the device, as "module:function"; None if nothing
            does. It takes a `MockPlace` and gives a `MockPair` (`services.acquisition.mocks`). It
            is imported in mock stations only: drivers never import mocks.
    """

    name: str
    settings: type[SettingsT]
    build: Callable[[SettingsT, StationClock], Driver]
    mock: str | None = None
