"""The settings of any device of a station, validated by the kind that they name."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny

from dextouch.errors import InvalidInputError
from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.devices.registry import device_kind, kind_names

# Until now these gloves were `tactile_glove` with a `protocol`; such settings are still read.
OLD_PROTOCOLS = {"wuji": "wuji_glove", "justfloat": "justfloat_glove"}


def _validated(value: object) -> DeviceSettings:
    if isinstance(value, DeviceSettings):
        return value
    if not isinstance(value, Mapping) or not isinstance(value.get("kind"), str):
        raise ValueError(  # noqa: TRY004 - pydantic gathers ValueErrors of all devices
            f"got {value!r}, expected a map that names its kind: {', '.join(kind_names())}"
        )
    told: dict[str, Any] = dict(value)
    if told["kind"] == "tactile_glove" and told.get("protocol") in OLD_PROTOCOLS:
        told["kind"] = OLD_PROTOCOLS[told.pop("protocol")]
    try:
        settings = device_kind(told["kind"]).settings
    except InvalidInputError as error:
        raise ValueError(error.message) from error
    return settings.model_validate(told)


ChosenDevice = Annotated[SerializeAsAny[DeviceSettings], BeforeValidator(_validated)]
