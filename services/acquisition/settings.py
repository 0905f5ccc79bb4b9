"""Environment and flags in (DEXTOUCH_ACQUISITION_…), a station's frozen settings out."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, SecretStr

from dextouch.serving.settings import ServiceSettings, service_config
from dextouch.tactile.layout import Side

POSE_STREAMS = Literal["wrist_left", "wrist_right", "head"]
CAMERAS = Literal["camera_head", "camera_wrist_left", "camera_wrist_right"]


class _DeviceSettings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TactileGloveSettings(_DeviceSettings):
    """A glove on a serial port, found by its serial number or, failing that, by a port name."""

    kind: Literal["tactile_glove"] = "tactile_glove"
    side: Side
    serial_number: str | None = None
    port: str | None = None
    baud_rate: int = Field(default=2_000_000, gt=0)


class FingerTrackerSettings(_DeviceSettings):
    """A finger tracker by its HID ids."""

    kind: Literal["finger_tracker"] = "finger_tracker"
    side: Side
    vendor_id: int
    product_id: int
    serial_number: str | None = None


class PoseTrackerSettings(_DeviceSettings):
    """A pose tracker by its HID ids."""

    kind: Literal["pose_tracker"] = "pose_tracker"
    stream: POSE_STREAMS
    vendor_id: int
    product_id: int
    serial_number: str | None = None


class CameraSettings(_DeviceSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CAMERAS
    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg"] = "jpeg"


class RobotStateSettings(_DeviceSettings):
    """A robot's state server at a TCP address."""

    kind: Literal["robot_state"] = "robot_state"
    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)


DeviceSettings = Annotated[
    TactileGloveSettings
    | FingerTrackerSettings
    | PoseTrackerSettings
    | CameraSettings
    | RobotStateSettings,
    Field(discriminator="kind"),
]


class AcquisitionSettings(ServiceSettings):
    """One station.

    With `mock` the devices are simulated: they play the episode `mock_episode_id` of the local
    store `mock_store` round and round, or a made-up pattern when no episode is named. Otherwise
    `devices` names the real ones, and `calibration` a JSON file of named matrices.
    """

    model_config = service_config("acquisition")

    station: str = Field(default="station", min_length=1, max_length=128)
    spool: Path = Path("spool")
    mock: bool = False
    mock_store: str | None = None
    mock_episode_id: str | None = None
    mock_faults: Literal["none", "first_light"] = "first_light"
    seed: int = Field(default=0, ge=0)
    devices: tuple[DeviceSettings, ...] = ()
    calibration: Path | None = None
    episode_store_url: str | None = None
    episode_store_key: SecretStr | None = None
    upload_period_s: float = Field(default=2.0, gt=0, le=3600)
    keep_uploaded: bool = True
