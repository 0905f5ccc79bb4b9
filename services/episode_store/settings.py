"""Settings of the episode store, from flags and DEXTOUCH_EPISODE_STORE_… variables."""

from pydantic import Field

from dextouch.data_folder import default_store
from dextouch.serving.settings import ServiceSettings, service_config


class EpisodeStoreSettings(ServiceSettings):
    """Location of the store, and limits per request, in flight and per station.

    `store_url` is a local folder or file:///…; unfinished uploads are kept below it.
    `max_body_bytes` must hold one batch of the wire format. `max_open_uploads` unfinished uploads
    keep their files open, two each: choose at least the number of concurrently uploading stations,
    since reopening one reads its whole log. Batches beyond `max_batches_in_flight` or
    `max_bytes_in_flight` are refused with 429; those that leave less than `min_free_bytes` on the
    disk, or exceed a station's quota (unfinished and finished), with 507. `commit_in_process`
    commits finished recordings in a child process.
    """

    model_config = service_config("episode_store")

    store_url: str = Field(default_factory=default_store, min_length=1)
    sync_uploads: bool = True
    max_open_uploads: int = Field(default=128, ge=1, le=1024)
    max_batches_in_flight: int = Field(default=32, ge=1, le=1024)
    max_bytes_in_flight: int = Field(default=128 * 2**20, ge=1024)
    min_free_bytes: int = Field(default=512 * 2**20, ge=0)
    quota_bytes_per_station: int | None = Field(default=None, ge=1)
    commit_in_process: bool = True
    max_page: int = Field(default=1000, ge=1, le=100_000)
    max_window_steps: int = Field(default=321, ge=1, le=10_000)
    max_answer_bytes: int = Field(default=64 * 2**20, ge=1024)
