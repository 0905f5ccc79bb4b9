"""Environment and flags in (DEXTOUCH_ALIGNMENT_…), store, workers and defaults out."""

from pydantic import Field

from dextouch.serving.settings import ServiceSettings, service_config
from services.alignment.options import AlignmentOptions


class AlignmentSettings(ServiceSettings):
    """Which store is read and written, and what happens to recordings.

    `store_url` is the folder that the episode store writes to; `options` are the defaults of a
    request; `num_workers` alignments run at once, `max_waiting` more may wait.
    """

    model_config = service_config("alignment")

    store_url: str = Field(default="data/store", min_length=1)
    options: AlignmentOptions = AlignmentOptions()
    num_workers: int = Field(default=1, ge=1, le=64)
    max_waiting: int = Field(default=256, ge=1, le=100_000)
    max_kept: int = Field(default=1000, ge=1, le=100_000)
