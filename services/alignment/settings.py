"""Settings of the alignment service, from flags and DEXTOUCH_ALIGNMENT_… variables."""

import os
from functools import cached_property
from pathlib import Path

from pydantic import Field, SecretStr

from dextouch.data_folder import data_folder, default_spool, default_store
from dextouch.serving import ServiceSettings, service_config
from services.alignment.options import AlignmentOptions


def usable_cores() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


class AlignmentSettings(ServiceSettings):
    """Serve alignment over HTTP, and align recordings that arrive in a store.

    The options are used for requests that do not set their own.

    Example:
      dextouch align serve --store-url data/store --port 8082
    """

    model_config = service_config("alignment", "dextouch align serve")

    store_url: str = Field(
        default_factory=default_store,
        min_length=1,
        description="store that recordings arrive in: folder, file:///… or s3://…",
    )
    jobs_folder: Path | None = Field(
        default=None, description="folder of the jobs (default: .alignments in the store)"
    )
    options: AlignmentOptions = AlignmentOptions()
    objects: Path | None = Field(
        default=None,
        description="JSON file of the tasks' objects, whose poses are measured (docs/objects.md)",
    )
    num_workers: int = Field(
        default_factory=usable_cores,
        ge=1,
        le=64,
        description="concurrent alignments, each in its own process (default: one per core)",
    )
    max_waiting: int = Field(default=10_000, ge=1, le=100_000, description="waiting jobs")
    max_kept: int = Field(default=10_000, ge=1, le=100_000, description="finished jobs to keep")
    max_attempts: int = Field(
        default=3,
        ge=1,
        le=100,
        description="starts of a job whose process dies before it fails",
    )
    align_new: bool = Field(
        default=True, description="align every recording that arrives in the store"
    )
    look_period_s: float | None = Field(
        default=None,
        gt=0,
        le=3600,
        description="seconds between listings of the store (default: 2; 30 for a bucket)",
    )

    station_url: str | None = Field(
        default=None, description="URL of the station whose devices are calibrated over HTTP"
    )
    station_key: SecretStr | None = Field(default=None, description="bearer key of the station")
    station_spool: Path = Field(
        default_factory=default_spool,
        description="spool of the station; calibration takes that are not there are read from the "
        "store",
    )
    calibration_folder: Path = Field(
        default_factory=lambda: data_folder() / "calibration",
        description="folder of the station's calibration",
    )

    @cached_property
    def wanted_options(self) -> AlignmentOptions:
        """The options, with the objects of the file.

        Raises:
            NotFoundError, InvalidInputError: as `load_scene_objects`.
        """
        if self.objects is None:
            return self.options
        from dextouch.schemas import load_scene_objects

        return self.options.model_copy(update={"objects": load_scene_objects(self.objects)})

    @property
    def period_s(self) -> float:
        """Seconds between two listings of the store."""
        if self.look_period_s is not None:
            return self.look_period_s
        # Listing a bucket takes a request for every thousand files in it.
        return 30.0 if self.store_url.startswith("s3://") else 2.0
