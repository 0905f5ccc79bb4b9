"""Presets of the paper's form of the world model: named settings, one TOML file each."""

import tomllib
from pathlib import Path
from typing import Any, Final

from pydantic.fields import FieldInfo
from pydantic_settings import PydanticBaseSettingsSource

from dextouch.errors import UnknownNameError

_FOLDER: Final = Path(__file__).parent
PRESETS: Final = tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def preset_settings(name: str) -> dict[str, Any]:
    """Settings of a preset over those of its `base`; raises UnknownNameError if there is none."""
    if name not in PRESETS:
        raise UnknownNameError("preset", name, list(PRESETS))
    own = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    base = own.pop("base", None)
    return own if base is None else merged(preset_settings(base), own)


class PresetSource(PydanticBaseSettingsSource):
    """Settings of the preset that a source of higher priority names."""

    def get_field_value(self, field: FieldInfo, field_name: str) -> tuple[None, str, bool]:
        """Unused: all values come at once, from `__call__`."""
        return None, field_name, False

    def __call__(self) -> dict[str, Any]:
        """Values of the preset; none without one."""
        name = self.current_state.get("preset")
        return preset_settings(name) if isinstance(name, str) else {}


def merged(settings: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Nested settings in which those of `over` replace others."""
    both = dict(settings)
    for key, value in over.items():
        known = both.get(key)
        both[key] = (
            merged(known, value) if isinstance(known, dict) and isinstance(value, dict) else value
        )
    return both
