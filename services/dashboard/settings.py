"""Settings of the dashboard, from flags and DEXTOUCH_DASHBOARD_… variables."""

from pydantic import Field, SecretStr

from dextouch.serving.settings import ServiceSettings, service_config


class DashboardSettings(ServiceSettings):
    """URLs of the services to show; a service without URL is omitted.

    `upstream_key` is the bearer key of the other services. Browsers reach the page under loopback
    names and those of `allowed_hosts`.
    """

    model_config = service_config("dashboard")

    station: str = Field(default="station", min_length=1, max_length=64)
    tasks: tuple[str, ...] = Field(default=("stand_bottle", "stack_bowls"), min_length=1)
    acquisition_url: str | None = None
    episode_store_url: str | None = None
    alignment_url: str | None = None
    twin_url: str | None = None
    world_model_url: str | None = None
    upstream_key: SecretStr | None = None
    upstream_timeout_s: float = Field(default=2.0, gt=0, le=30)
    station_period_s: float = Field(default=0.2, ge=0.05, le=10)
    taxel_period_s: float = Field(default=0.1, ge=0.02, le=10)
    list_period_s: float = Field(default=2.0, ge=0.2, le=60)
    session_hours: float = Field(default=12.0, gt=0, le=24 * 30)

    def upstream_urls(self) -> dict[str, str]:
        """Configured services by name, in the order of the data flow."""
        urls = {
            "acquisition": self.acquisition_url,
            "episode_store": self.episode_store_url,
            "alignment": self.alignment_url,
            "twin": self.twin_url,
            "world_model": self.world_model_url,
        }
        return {name: url.rstrip("/") for name, url in urls.items() if url}
