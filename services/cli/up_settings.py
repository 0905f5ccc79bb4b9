"""Settings of `dextouch up`."""

from pathlib import Path
from typing import Literal

from pydantic import AliasChoices, Field
from pydantic_settings import SettingsConfigDict

from dextouch.data_folder import data_folder
from dextouch.free_text import FreeText
from dextouch.serving import CommandSettings

PORT = "0 for any free one"


class UpSettings(CommandSettings):
    """Run every service in one process, with a dashboard and mock or real devices.

    An explicit port must be free; a default port in use is replaced by a free one. All data is
    stored in one folder. Mock devices play an episode of its store, or a synthetic pattern; with
    --no-mock the station has the devices of DEXTOUCH_ACQUISITION_DEVICES. Every service reads its
    other settings from the same environment variables as on its own (DEXTOUCH_ALIGNMENT_…, see
    `dextouch align serve --help`).

    Example:
      dextouch up --data runs/station --without twin,world_model
    """

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_prefix="DEXTOUCH_UP_", cli_prog_name="dextouch up"
    )

    data: Path = Field(
        default_factory=data_folder,
        description="folder of store and spool (DEXTOUCH_DATA, else data)",
    )
    station: FreeText = Field(
        default="mock station", min_length=1, max_length=64, description="name of the station"
    )
    mock: bool = Field(default=True, description="simulate the station's devices")
    mock_episode_id: str | None = Field(
        default=None, description="episode of the store that the mock devices play"
    )
    mock_faults: Literal["none", "first_light", "worn_glove"] | None = Field(
        default=None,
        description="faults of the mock devices, as of dextouch station serve (default: none)",
    )
    align_new: bool = Field(default=True, description="align saved takes automatically")
    without: tuple[str, ...] = Field(default=(), description="services not to start")
    dashboard_port: int = Field(default=8080, ge=0, le=65535, description=PORT)
    episode_store_port: int = Field(default=8081, ge=0, le=65535, description=PORT)
    alignment_port: int = Field(default=8082, ge=0, le=65535, description=PORT)
    acquisition_port: int = Field(default=8083, ge=0, le=65535, description=PORT)
    twin_port: int = Field(default=8084, ge=0, le=65535, description=PORT)
    world_model_port: int = Field(default=8085, ge=0, le=65535, description=PORT)
    studies_port: int = Field(default=8086, ge=0, le=65535, description=PORT)
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="warning", description="minimum level of log events"
    )
    json_path: Path | None = Field(
        default=None,
        validation_alias=AliasChoices("json"),
        description="write the addresses as JSON to this file once all services respond; - for "
        "standard output",
    )

    @property
    def store_url(self) -> str:
        """The store in the data folder."""
        return str(self.data / "store")
