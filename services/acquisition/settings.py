"""Settings of a station: flags, the environment (`DEXTOUCH_ACQUISITION_…`) and its enrolment."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SecretStr,
    SerializeAsAny,
    ValidationError,
    field_serializer,
    field_validator,
    model_validator,
)

from dextouch.data_folder import default_enrolment, default_spool
from dextouch.errors import InvalidInputError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.serving import ServiceSettings, service_config

# The flags can be shown without drivers, which import numpy.
if TYPE_CHECKING:
    from services.acquisition.devices.kinds import DeviceSettings
else:
    DeviceSettings = FrozenModel


def _chosen_device(value: object) -> DeviceSettings:
    from services.acquisition.devices.kinds import chosen_device

    return chosen_device(value)


ChosenDevice = Annotated[SerializeAsAny[DeviceSettings], BeforeValidator(_chosen_device)]


class MockLinks(FrozenModel):
    """Which of the ways that real stations know the mock devices of a station take."""

    gloves: str = Field(
        default="tactile_glove", description="kind of both gloves, built in or of another package"
    )
    layout: Path | None = Field(
        default=None, description="file with the layout of both gloves, of a pattern that is played"
    )
    trackers: Literal["hid", "bridge"] = Field(
        default="hid", description="connection of finger and pose trackers"
    )
    wrists: Literal["robot", "trackers"] = Field(
        default="robot", description="source of the wrist poses if there is a robot"
    )
    cameras: Literal["bridge", "station"] = Field(
        default="bridge", description="images over a socket, or from a camera on the station's bus"
    )
    images: Literal["rgb8", "jpeg", "h264"] = Field(
        default="rgb8", description="image encoding of the bridge or the station"
    )

    @field_validator("gloves")
    @classmethod
    def _is_known(cls, gloves: str) -> str:
        from services.acquisition.devices.kinds import kind_names

        if gloves not in kind_names():
            raise ValueError(f"got {gloves!r}, expected a kind of glove: {', '.join(kind_names())}")
        return gloves


class Retention(FrozenModel):
    """How long takes stay in the spool after the store acknowledged them."""

    keep_uploaded_days: float = Field(
        default=7.0,
        ge=0,
        allow_inf_nan=False,
        description="days that a take stays in the spool after the store acknowledged it",
    )
    keep_uploaded_gb: float | None = Field(
        default=None,
        ge=0,
        allow_inf_nan=False,
        description="GB of acknowledged takes to keep at most, the newest (default: no limit)",
    )


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
    mock_links: MockLinks = MockLinks()
    require_consent: bool | None = Field(
        default=None,
        description="arm no take without an operator who consented, except for calibration "
        "(default: with real devices)",
    )
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


class Enrolment(FrozenModel):
    """What `dextouch station enrol` got from a store."""

    station: str
    episode_store_url: str
    episode_store_key: SecretStr

    @field_serializer("episode_store_key", when_used="json")
    def _as_text(self, key: SecretStr) -> str:
        return key.get_secret_value()


def write_enrolment(path: Path, enrolment: Enrolment) -> None:
    """Write the file, readable only by its owner; StorageError if that fails."""
    from dextouch.episodes import disk_errors, replace_file

    with disk_errors(f"write {path}"):
        replace_file(path, enrolment.model_dump_json(indent=1).encode(), mode=0o600)


def check_writable(path: Path) -> None:
    """Refuse a place where `write_enrolment` would fail, before a token is used up for it."""
    from dextouch.episodes import disk_errors, replace_file

    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path.with_name(f"{path.name}.probe")
        replace_file(probe, b"", mode=0o600)
        probe.unlink()


def with_enrolment(settings: AcquisitionSettings) -> AcquisitionSettings:
    """Settings with the store and the name of the enrolment, where they have none of their own.

    Its key is sent only to the store that issued it.

    Raises:
        InvalidInputError: the file is damaged.
    """
    if settings.episode_store_key is not None or not settings.enrolment.is_file():
        return settings
    import structlog

    from dextouch.episodes import disk_errors
    from dextouch.schemas import first_problems

    with disk_errors(f"read {settings.enrolment}"):
        text = settings.enrolment.read_bytes()
    try:
        enrolment = Enrolment.model_validate_json(text)
    except ValidationError as error:
        raise InvalidInputError(
            f"{settings.enrolment}: no valid enrolment ({first_problems(error)}); enrol the "
            "station again with dextouch station enrol"
        ) from error
    url = settings.episode_store_url
    if url is not None and url.rstrip("/") != enrolment.episode_store_url:
        return settings
    changed: dict[str, object] = {
        "episode_store_url": enrolment.episode_store_url,
        "episode_store_key": enrolment.episode_store_key,
    }
    if "station" not in settings.model_fields_set:
        changed["station"] = enrolment.station
    elif settings.station != enrolment.station:
        # The station still records: takes wait in the spool.
        structlog.get_logger(__name__).warning(
            "refused_station_name",
            station=settings.station,
            enrolled_as=enrolment.station,
            advice="the store takes recordings of the enrolled name only: remove the setting "
            "station, or enrol the station under its name",
        )
    return settings.model_copy(update=changed)
