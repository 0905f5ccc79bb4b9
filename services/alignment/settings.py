"""Settings of the alignment service, from flags and DEXTOUCH_ALIGNMENT_… variables."""

import os
from pathlib import Path

from pydantic import Field

from dextouch.data_folder import default_store
from dextouch.serving.settings import ServiceSettings, service_config
from services.alignment.options import AlignmentOptions


def usable_cores() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


class AlignmentSettings(ServiceSettings):
    """Settings of the alignment service.

    `store_url` is the folder that the episode store writes to; `jobs_folder` holds the jobs,
    `.alignments` in the store if not given; `options` are the defaults of a request; `num_workers`
    alignments run at once, each in a separate process (by default one per processor), `max_waiting`
    more may wait, `max_kept` are remembered; a job whose process died `max_attempts` times is
    failed.

    With `align_new`, recordings that arrive in the store are aligned by themselves, each once; the
    store is listed every `look_period_s` (2 s for a folder, 30 s for a bucket if not given).
    """

    model_config = service_config("alignment")

    store_url: str = Field(default_factory=default_store, min_length=1)
    jobs_folder: Path | None = None
    options: AlignmentOptions = AlignmentOptions()
    num_workers: int = Field(default_factory=usable_cores, ge=1, le=64)
    max_waiting: int = Field(default=10_000, ge=1, le=100_000)
    max_kept: int = Field(default=10_000, ge=1, le=100_000)
    max_attempts: int = Field(default=3, ge=1, le=100)
    align_new: bool = True
    look_period_s: float | None = Field(default=None, gt=0, le=3600)

    @property
    def period_s(self) -> float:
        """Seconds between two listings of the store."""
        if self.look_period_s is not None:
            return self.look_period_s
        # Listing a bucket takes a request for every thousand files in it.
        return 30.0 if self.store_url.startswith("s3://") else 2.0
