"""Settings of the dashboard, from flags and DEXTOUCH_DASHBOARD_… variables."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, FiniteFloat, SecretStr

from dextouch.free_text import FreeText
from dextouch.serving import ServiceSettings, service_config


class DashboardSettings(ServiceSettings):
    """Serve the operators' page, which shows the services whose URLs are given.

    Browsers reach the page under loopback names and those of --allowed-hosts.

    Example:
      dextouch dashboard --port 8080 --acquisition-url http://127.0.0.1:8083
    """

    model_config = service_config("dashboard", "dextouch dashboard")

    station: FreeText = Field(
        default="station", min_length=1, max_length=64, description="name of the station"
    )
    task_file: Path | None = Field(
        default=None,
        description="TOML file of the tasks that the recorder offers, see docs/dashboard.md "
        "(default: those of the twin)",
    )
    takes_goal: int = Field(
        default=0, ge=0, le=1_000_000, description="takes of a task per session; 0: no goal"
    )
    reset_s: float = Field(
        default=0.0, ge=0, le=3600, description="seconds to reset the scene after a saved take"
    )
    acquisition_url: str | None = Field(
        default=None, description="URL of the station; services without a URL are not shown"
    )
    stations: dict[FreeText, str] = Field(
        default={},
        max_length=64,
        description='URLs of further stations by name: {"desk_2": "http://…"}; /fleet shows all',
    )
    episode_store_url: str | None = Field(default=None, description="URL of the episode store")
    alignment_url: str | None = Field(default=None, description="URL of the alignment service")
    twin_url: str | None = Field(default=None, description="URL of the twin")
    world_model_url: str | None = Field(default=None, description="URL of the world model")
    studies_url: str | None = Field(default=None, description="URL of the results of studies")
    rating_url: str | None = Field(
        default=None,
        pattern=r"^https?://",
        description="address of the rating page in the users' browsers, for a link to it",
    )
    upstream_key: SecretStr | None = Field(
        default=None, description="bearer key of the other services"
    )
    upstream_timeout_s: float = Field(
        default=2.0, gt=0, le=30, description="seconds until a silent service counts as unavailable"
    )
    live_timeout_s: float = Field(
        default=0.7,
        ge=0.05,
        le=10,
        description="seconds until a station that does not answer is shown as STALE",
    )
    station_period_s: float = Field(
        default=0.2, ge=0.05, le=10, description="seconds between updates of the station's state"
    )
    taxel_period_s: float = Field(
        default=1 / 30, ge=0.02, le=10, description="seconds between updates of the taxel maps"
    )
    pose_period_s: float = Field(
        default=1 / 30, ge=0.02, le=10, description="seconds between updates of hands and poses"
    )
    fleet_period_s: float = Field(
        default=0.1, ge=0.05, le=10, description="seconds between updates of the wall of stations"
    )
    list_period_s: float = Field(
        default=2.0, ge=0.2, le=60, description="seconds between listings of takes and episodes"
    )
    goal_hours: dict[str, Annotated[FiniteFloat, Field(gt=0)]] = Field(
        default={}, description="hours of episodes to record, by task, as JSON"
    )
    session_hours: float = Field(
        default=12.0, gt=0, le=24 * 30, description="hours until an operator must sign in again"
    )

    audit_folder: Path | None = Field(
        default=None,
        description="folder of the audit log, of this dashboard alone (default: in memory only)",
    )
    audit_max_bytes: int = Field(
        default=16 * 2**20, ge=2**20, description="largest size of the audit log, all files"
    )

    def station_urls(self) -> dict[str, str]:
        """URLs of the stations by name; the one of `acquisition_url` is the first."""
        own = {self.station: self.acquisition_url} if self.acquisition_url else {}
        return {name: url.rstrip("/") for name, url in {**own, **self.stations}.items()}

    def upstream_urls(self) -> dict[str, str]:
        """Configured services beside the stations by name, in the order of the data flow."""
        names = ("episode_store", "alignment", "twin", "world_model", "studies")
        urls = {name: getattr(self, f"{name}_url") for name in names}
        return {name: url.rstrip("/") for name, url in urls.items() if url}
