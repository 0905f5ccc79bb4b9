"""The file in which an enrolled station keeps the address of its store, and its key there."""

from pathlib import Path

import structlog
from pydantic import SecretStr, ValidationError, field_serializer

from dextouch.episodes import disk_errors, replace_file
from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from services.acquisition.settings import AcquisitionSettings

logger = structlog.get_logger(__name__)


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
    with disk_errors(f"write {path}"):
        replace_file(path, enrolment.model_dump_json(indent=1).encode(), mode=0o600)


def check_writable(path: Path) -> None:
    """Refuse a place where `write_enrolment` would fail, before a token is used up for it."""
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
        logger.warning(
            "refused_station_name",
            station=settings.station,
            enrolled_as=enrolment.station,
            advice="the store takes recordings of the enrolled name only: remove the setting "
            "station, or enrol the station under its name",
        )
    return settings.model_copy(update=changed)
