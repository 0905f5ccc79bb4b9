"""Settings of one station, from flags and the environment (`DEXTOUCH_ACQUISITION_…`)."""

from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, model_validator

from dextouch.data_folder import default_enrolment, default_spool
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.serving import ServiceSettings, service_config
from services.acquisition.devices.kinds import ChosenDevice
from services.acquisition.mock_links import MockLinks
from services.acquisition.retention import Retention


class SpoolSafety(FrozenModel):
    """How much a power loss may cost, and how much space is kept for closing a take."""

    flush_period_s: float = Field(
        default=0.5,
        gt=0,
        le=3600,
        description="seconds between flushes to disk, the most that a power failure can lose",
    )
    min_free_bytes: int = Field(
        default=64 * 2**20,
        ge=0,
        description="bytes to keep free on the spool's disk: below, takes end and none can start",
    )


class AcquisitionSettings(ServiceSettings, SpoolSafety, Retention):
    """Record the gloves, trackers, robots and cameras of a station, and serve them over HTTP.

    --devices lists the real devices. With --mock devices are simulated and replay an episode of a
    local store in a loop, by default a synthetic pattern.

    Example:
      dextouch station serve --mock --port 8083 --spool data/spool
    """

    model_config = service_config("acquisition", "dextouch station serve")

    station: FreeText = Field(
        default="station",
        min_length=1,
        max_length=128,
        description="name of the station, stored in recordings",
    )
    spool: Path = Field(default_factory=default_spool, description="folder of the takes")
    mock: bool = Field(default=False, description="simulate the devices")
    mock_store: str | None = Field(
        default=None, description="local store of the episode that mock devices play"
    )
    mock_episode_id: str | None = Field(
        default=None, description="episode that mock devices replay (default: a synthetic pattern)"
    )
    mock_faults: Literal["none", "first_light", "worn_glove"] = Field(
        default="none",
        description="first_light: losses, delays and drifts of an ordinary station; worn_glove: a "
        "left glove with dead, stuck, saturated and drifted taxels",
    )
    mock_practice: bool = Field(
        default=False,
        description="to practise calibration: a moving board before the mock head camera, gloves "
        "at rest",
    )
    mock_links: MockLinks = MockLinks()
    seed: int = Field(default=0, ge=0, description="random seed of mock devices")
    devices: tuple[ChosenDevice, ...] = Field(
        default=(), description="real devices, see docs/stations.md"
    )
    calibration: Path | None = Field(
        default=None, description="JSON file of named matrices, see docs/calibration_guide.md"
    )
    episode_store_url: str | None = Field(default=None, description="store to upload takes to")
    episode_store_key: SecretStr | None = Field(
        default=None, description="bearer key of the episode store"
    )
    enrolment: Path = Field(
        default_factory=default_enrolment,
        description="file of dextouch station enrol, which gives the store, its key and the "
        "station's name where they are not set",
    )
    upload_period_s: float = Field(
        default=2.0, gt=0, le=3600, description="seconds between checks for takes to upload"
    )

    @model_validator(mode="after")
    def _mock_or_devices(self) -> "AcquisitionSettings":
        if (self.mock_store is None) != (self.mock_episode_id is None):
            raise ValueError(
                f"got mock_store {self.mock_store!r} and mock_episode_id {self.mock_episode_id!r}, "
                "expected both (the episode that mock devices replay) or neither (a pattern)"
            )
        if self.mock and self.devices:
            kinds = ", ".join(device.kind for device in self.devices)
            raise ValueError(
                f"got mock and devices ({kinds}), expected one of the two: mock devices take the "
                "place of real ones"
            )
        return self
