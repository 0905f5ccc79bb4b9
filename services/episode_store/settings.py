"""Settings of the episode store, from flags and DEXTOUCH_EPISODE_STORE_… variables."""

from pathlib import Path

from pydantic import Field

from dextouch.data_folder import default_store
from dextouch.serving import ServiceSettings, service_config


class EpisodeStoreSettings(ServiceSettings):
    """Serve a store over HTTP, with limits per request, in flight and per station.

    Unfinished uploads are kept in the store's folder. The largest body must hold one batch of the
    wire format. Resuming an upload whose files were closed reads its whole log.

    Example:
      dextouch store serve --store-url data/store --port 8081
    """

    model_config = service_config("episode_store", "dextouch store serve")

    store_url: str = Field(
        default_factory=default_store, min_length=1, description="folder, file:///… or s3://…"
    )
    objects: Path | None = Field(
        default=None,
        description="JSON file of the tasks' objects, which are clicked in first images "
        "(docs/objects.md)",
    )
    enrolments: Path | None = Field(
        default=None,
        description="file of the enrolled stations, with hashes of their keys (default: "
        "enrolments.json in the store's folder)",
    )
    sync_uploads: bool = Field(
        default=True, description="wait for the disk before a batch is confirmed"
    )
    max_open_uploads: int = Field(
        default=128,
        ge=1,
        le=1024,
        description="unfinished uploads whose files stay open; at least one per station",
    )
    max_batches_in_flight: int = Field(
        default=32, ge=1, le=1024, description="concurrent batches; more are refused with 429"
    )
    max_bytes_in_flight: int = Field(
        default=128 * 2**20,
        ge=1024,
        description="bytes of concurrent batches; more are refused with 429",
    )
    min_free_bytes: int = Field(
        default=512 * 2**20,
        ge=0,
        description="bytes to keep free on the disk; batches that need them are refused with 507",
    )
    quota_bytes_per_station: int | None = Field(
        default=None,
        ge=1,
        description="bytes of one station, unfinished and finished; more are refused with 507",
    )
    keep_trash_days: float | None = Field(
        default=None,
        ge=0,
        allow_inf_nan=False,
        description="days until what is in the trash is permanently deleted; otherwise it stays",
    )
    commit_in_process: bool = Field(
        default=True, description="commit finished recordings in a child process"
    )
    max_page: int = Field(
        default=1000, ge=1, le=100_000, description="items of one page of a listing"
    )
    max_window_steps: int = Field(
        default=321, ge=1, le=10_000, description="steps of one window of an episode"
    )
    max_answer_bytes: int = Field(default=64 * 2**20, ge=1024, description="bytes of one response")
    max_downloads: int = Field(
        default=2, ge=1, le=64, description="concurrent downloads; more are refused with 429"
    )
    max_download_items: int = Field(
        default=100, ge=1, le=10_000, description="items of one download"
    )
    max_download_bytes: int = Field(
        default=4 * 2**30, ge=1024, description="stored bytes of the items of one download"
    )
