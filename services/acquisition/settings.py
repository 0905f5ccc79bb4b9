"""Environment and flags in (DEXTOUCH_ACQUISITION_…), a station's frozen settings out."""

from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, SecretStr, model_validator

from dextouch.data_folder import default_spool
from dextouch.serving.settings import ServiceSettings, service_config
from dextouch.tactile.layout import Side
from services.acquisition.mocks.links import MockLinks
from services.acquisition.supervisor import SpoolSafety

POSE_STREAMS = Literal["wrist_left", "wrist_right", "head"]
ROBOT_STREAMS = Literal[
    "joints_measured",
    "joints_commanded",
    "wrist_left",
    "wrist_right",
    "wrist_left_commanded",
    "wrist_right_commanded",
]
CAMERAS = Literal["camera_head", "camera_wrist_left", "camera_wrist_right"]


class _DeviceSettings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TactileGloveSettings(_DeviceSettings):
    """A glove on a serial port.

    It is found by its serial number, or by a port name; with both, the port is opened and the
    glove there must say that it has the number (protocol `dextouch`). Gloves of the protocol
    `justfloat` tell nothing of themselves: their numbers a packet, full scale and rate are needed.
    """

    kind: Literal["tactile_glove"] = "tactile_glove"
    protocol: Literal["dextouch", "wuji", "justfloat"] = "dextouch"
    side: Side
    serial_number: str | None = None
    port: str | None = None
    baud_rate: int = Field(default=2_000_000, gt=0)
    num_values: int | None = Field(default=None, ge=1, le=4096)
    full_scale: float | None = Field(default=None, gt=0, le=1e30)
    rate_hz: float | None = Field(default=None, gt=0, le=10_000)

    @model_validator(mode="after")
    def _form_where_needed(self) -> "TactileGloveSettings":
        form = (self.num_values, self.full_scale, self.rate_hz)
        if self.protocol == "justfloat" and None in form:
            raise ValueError(
                f"glove {self.side}: protocol 'justfloat' needs num_values, full_scale and rate_hz"
            )
        if self.protocol != "justfloat" and form != (None, None, None):
            raise ValueError(
                f"glove {self.side}: num_values, full_scale and rate_hz are set by protocol "
                f"{self.protocol!r}; leave them out"
            )
        return self


class _TrackerSettings(_DeviceSettings):
    """How a tracker is reached.

    By `hid` or `usb` it is found by its ids and, where several are alike, its serial number; by
    `bridge` it is asked for at the socket of its SDK's process: `path` of a local socket, or `host`
    and `port`.
    """

    link: Literal["hid", "usb", "bridge"] = "hid"
    vendor_id: int | None = Field(default=None, ge=0, le=0xFFFF)
    product_id: int | None = Field(default=None, ge=0, le=0xFFFF)
    serial_number: str | None = None
    host: str = "127.0.0.1"
    port: int | None = Field(default=None, gt=0, le=65535)
    path: str | None = None

    @model_validator(mode="after")
    def _address_of_its_link(self) -> "_TrackerSettings":
        num_ids = sum(number is not None for number in (self.vendor_id, self.product_id))
        num_ends = sum(end is not None for end in (self.port, self.path))
        if (num_ids, num_ends) != ((0, 1) if self.link == "bridge" else (2, 0)):
            raise ValueError(
                f"link {self.link!r}: got vendor_id {self.vendor_id}, product_id "
                f"{self.product_id}, port {self.port}, path {self.path}; expected both ids (hid, "
                "usb), or else a port or a path (bridge)"
            )
        return self


class FingerTrackerSettings(_TrackerSettings):
    """A finger tracker of one hand."""

    kind: Literal["finger_tracker"] = "finger_tracker"
    side: Side


class PoseTrackerSettings(_TrackerSettings):
    """A pose tracker on a wrist or on the head."""

    kind: Literal["pose_tracker"] = "pose_tracker"
    stream: POSE_STREAMS


class CameraSettings(_DeviceSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CAMERAS
    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"


class StationCameraSettings(_DeviceSettings):
    """A camera on this host by V4L2, found by its serial number or, failing that, by a device.

    `exposure_ms` absent leaves the exposure to the camera. `stamp_point` is the end of the
    exposure at which its driver stamps. `latency_ms` is calibrated: from the middle of the
    exposure to the earliest arrival; it comes with its sigma or not at all.
    """

    kind: Literal["station_camera"] = "station_camera"
    stream: CAMERAS
    serial_number: str | None = None
    device: str | None = None
    fourcc: str = Field(default="MJPG", min_length=4, max_length=4)
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    rate_hz: float = Field(default=30.0, gt=0, le=1000)
    exposure_ms: float | None = Field(default=None, gt=0, le=1000)
    stamp_point: Literal["start", "end"] = "start"
    latency_ms: float | None = Field(default=None, ge=0, le=1000)
    latency_sigma_ms: float | None = Field(default=None, gt=0, le=1000)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"

    @model_validator(mode="after")
    def _latency_with_sigma(self) -> "StationCameraSettings":
        if (self.latency_ms is None) != (self.latency_sigma_ms is None):
            raise ValueError(
                f"camera {self.stream}: got latency {self.latency_ms} ms with sigma "
                f"{self.latency_sigma_ms} ms, expected both or neither"
            )
        return self


class RobotStateSettings(_DeviceSettings):
    """A robot's state server at a TCP address.

    `streams` names those of its six streams that are recorded: a station whose trackers give the
    wrists leaves `wrist_left` and `wrist_right` out.
    """

    kind: Literal["robot_state"] = "robot_state"
    streams: tuple[ROBOT_STREAMS, ...] = Field(default=get_args(ROBOT_STREAMS), min_length=1)
    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)


DeviceSettings = Annotated[
    TactileGloveSettings
    | FingerTrackerSettings
    | PoseTrackerSettings
    | CameraSettings
    | StationCameraSettings
    | RobotStateSettings,
    Field(discriminator="kind"),
]


class AcquisitionSettings(ServiceSettings):
    """One station.

    With `mock` the devices are simulated: they play the episode `mock_episode_id` of the local
    store `mock_store` round and round, or a made-up pattern when no episode is named, connected
    as `mock_links` says, without faults or, as in the demo, with those of an ordinary station
    (`mock_faults=first_light`: its losses are findings of the health). Otherwise `devices` names
    the real ones, and `calibration` a JSON file of named matrices.

    Takes reach the disk every `flush_period_s`, which is what a power loss costs at most. One ends
    when less than `min_free_bytes` are left on the disk of the `spool`, and none begins then.
    """

    model_config = service_config("acquisition")

    station: str = Field(default="station", min_length=1, max_length=128)
    spool: Path = Field(default_factory=default_spool)
    flush_period_s: float = Field(default=SpoolSafety.flush_period_s, gt=0, le=3600)
    min_free_bytes: int = Field(default=SpoolSafety.min_free_bytes, ge=0)
    mock: bool = False
    mock_store: str | None = None
    mock_episode_id: str | None = None
    mock_faults: Literal["none", "first_light"] = "none"
    mock_links: MockLinks = MockLinks()
    seed: int = Field(default=0, ge=0)
    devices: tuple[DeviceSettings, ...] = ()
    calibration: Path | None = None
    episode_store_url: str | None = None
    episode_store_key: SecretStr | None = None
    upload_period_s: float = Field(default=2.0, gt=0, le=3600)
    keep_uploaded: bool = True

    @model_validator(mode="after")
    def _mock_or_devices(self) -> "AcquisitionSettings":
        if (self.mock_store is None) != (self.mock_episode_id is None):
            raise ValueError(
                f"got mock_store {self.mock_store!r} and mock_episode_id {self.mock_episode_id!r}, "
                "expected both (the episode that mock devices play) or neither (a pattern)"
            )
        if self.mock and self.devices:
            kinds = ", ".join(device.kind for device in self.devices)
            raise ValueError(
                f"got mock and devices ({kinds}), expected one of the two: mock devices take the "
                "place of real ones"
            )
        return self
