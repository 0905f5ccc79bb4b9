"""Settings of one station, from flags and the environment (`DEXTOUCH_ACQUISITION_…`)."""

from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, model_validator

from dextouch.data_folder import default_spool
from dextouch.serving.settings import ServiceSettings, service_config
from services.acquisition.devices.chosen import ChosenDevice
from services.acquisition.mock_links import MockLinks
from services.acquisition.supervisor import SpoolSafety


class AcquisitionSettings(ServiceSettings):
    """One station.

    With `mock` the devices are simulated: they play the episode `mock_episode_id` of the local
    store `mock_store` round and round, or a made-up pattern when no episode is named, connected
    as `mock_links` says, without faults or, as in the demo, with those of an ordinary station
    (`mock_faults=first_light`: its losses are findings of the health). Otherwise `devices` names
    the real ones, and `calibration` a JSON file of named matrices.

    Takes are flushed to the disk every `flush_period_s`, the most that a power loss can lose. One
    ends when less than `min_free_bytes` are left on the disk of the `spool`, and none begins then.
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
    devices: tuple[ChosenDevice, ...] = ()
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
                "expected both (the episode that mock devices replay) or neither (a pattern)"
            )
        if self.mock and self.devices:
            kinds = ", ".join(device.kind for device in self.devices)
            raise ValueError(
                f"got mock and devices ({kinds}), expected one of the two: mock devices take the "
                "place of real ones"
            )
        return self
