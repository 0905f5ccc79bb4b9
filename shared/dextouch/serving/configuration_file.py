"""The configuration file `dextouch.toml`, which every command and service reads its settings from.

The section of a command is its prefix of environment variables in lower case: [dashboard] `port` is
DEXTOUCH_DASHBOARD_PORT. Flags come before the environment, that before the file.
"""

import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from dextouch.errors import InvalidInputError
from dextouch.schemas import first_problems

MAX_PROBLEMS: Final = 5  # chosen: a message that people read
MAX_SHOWN: Final = 60  # chosen: the rest of a line
# What pydantic expects, by the type of its error; `ctx` has the numbers and names.
_EXPECTED: Final = {
    **dict.fromkeys(("int_parsing", "int_type", "int_from_float"), "a whole number"),
    **dict.fromkeys(("float_parsing", "float_type"), "a number"),
    "finite_number": "a finite number",
    **dict.fromkeys(("bool_parsing", "bool_type"), "true or false"),
    "string_type": "a text",
    "path_type": "a path",
    **dict.fromkeys(("tuple_type", "list_type"), "a list"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "a table"),
    "string_too_short": "at least {min_length} characters",
    "string_too_long": "at most {max_length} characters",
    "string_pattern_mismatch": "text of the form {pattern}",
    "too_short": "at least {min_length} entries",
    "too_long": "at most {max_length} entries",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    **dict.fromkeys(("literal_error", "enum"), "{expected}"),
    "union_tag_invalid": "one of {expected_tags}",
}
# Names of settings whose values are not repeated.
_SECRET: Final = re.compile(r"key|token|secret|password|url", re.IGNORECASE)


def _problem_text(item: Mapping[str, Any]) -> str:
    where = ".".join(str(part) for part in item["loc"]) or "settings"
    kind = item["type"]
    if kind == "missing":
        return f"{where}: is not set, and has no default"
    if kind == "extra_forbidden":
        return f"{where}: there is no such setting"
    if kind not in _EXPECTED:
        return f"{where}: {item['msg'].removeprefix('Value error, ')}"
    expected = _EXPECTED[kind].format_map(item.get("ctx", {}))
    return f"{where}: got {_shown(item)}, expected {expected}"


def _shown(item: Mapping[str, Any]) -> str:
    value = item["input"]
    may_be_secret = any(_SECRET.search(str(part)) for part in item["loc"])
    if may_be_secret or not isinstance(value, str | int | float | bool | None):
        return "another value"
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


VARIABLE: Final = "DEXTOUCH_CONFIG"
FILE_NAME: Final = "dextouch.toml"
PREFIX: Final = "DEXTOUCH_"
# The only setting outside of a section: the data folder of all commands.
DATA: Final = "data"
# Editors and spreadsheets of Windows begin a file with a byte-order mark.
ENCODING: Final = "utf-8-sig"
_HEADER = re.compile(r"\s*\[\[?\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?")
_KEY = re.compile(r"\s*([\w.\"' -]+?)\s*=")


class CommandSettings(BaseSettings):
    """Base of all settings: flags, then the environment, then `dextouch.toml`, then defaults.

    An empty variable counts as not set, which is how compose passes one that is left out of `.env`.
    """

    model_config = SettingsConfigDict(env_ignore_empty=True)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Sources in the order of their priority; flags come before all of them."""
        return init_settings, env_settings, *file_source(settings_cls)


def file_source(settings_cls: type[BaseSettings]) -> tuple[PydanticBaseSettingsSource, ...]:
    """The section of a settings class in the configuration file; none where it has none."""
    path, section = configuration_path(), section_of(settings_cls)
    if path is None or section not in read_configuration(path):
        return ()
    return (_TomlSource(settings_cls, path, (section,)),)


class _TomlSource(TomlConfigSettingsSource):
    """Settings of a section, also of a file that begins with a byte-order mark."""

    def _read_file(self, file_path: Path | Traversable) -> dict[str, Any]:
        return tomllib.loads(file_path.read_text(encoding=ENCODING))


def section_of(settings_cls: type[BaseSettings]) -> str:
    """Name of the section of a settings class; empty for a base class."""
    prefix = settings_cls.model_config.get("env_prefix", "")
    return prefix.removeprefix(PREFIX).removesuffix("_").lower()


def configuration_path() -> Path | None:
    """The file that DEXTOUCH_CONFIG names, or dextouch.toml in the working folder; None without.

    Raises InvalidInputError if the named file does not exist.
    """
    named = os.environ.get(VARIABLE)
    if not named:
        path = Path(FILE_NAME)
        return path if path.is_file() else None
    path = Path(named).expanduser()
    if not path.is_file():
        raise InvalidInputError(f"{VARIABLE}: got {named!r}, which is not a file")
    return path


def read_configuration(path: Path) -> Mapping[str, Any]:
    """Sections of a configuration file, and its data folder if it names one.

    Raises:
        InvalidInputError: it cannot be read, is no TOML, or has a setting outside of a section.
    """
    try:
        return _read(path, path.stat().st_mtime_ns)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"{path}: cannot be read as TOML: {error}") from error


@lru_cache(maxsize=8)
def _read(path: Path, _: int) -> Mapping[str, Any]:
    sections = tomllib.loads(path.read_text(encoding=ENCODING))
    for name, values in sections.items():
        if name == DATA:
            if not isinstance(values, str) or not values:
                raise InvalidInputError(
                    f"{path}:{line_of(path, (name,))}: data: got {values!r}, expected the path of "
                    "the data folder"
                )
        elif not isinstance(values, dict):
            line = line_of(path, (name,))
            raise InvalidInputError(
                f"{path}:{line}: {name} stands outside of a section; expected it below [dashboard] "
                "or another section, see dextouch config example"
            )
    return sections


def line_of(path: Path, keys: Sequence[str]) -> int | None:
    """Line of a section or setting, or of the nearest table around it."""
    best: tuple[int, int] | None = None
    for number, found in _keys(path):
        depth = len(found) if list(found) == list(keys[: len(found)]) else 0
        if depth and (best is None or depth > best[0]):
            best = depth, number
    return None if best is None else best[1]


def _keys(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Tables and keys with their lines; elements of an array of tables have their number."""
    table: list[str] = []
    num_elements: Counter[str] = Counter()
    for number, line in enumerate(path.read_text(encoding=ENCODING).splitlines(), start=1):
        if header := _HEADER.fullmatch(line):
            table = _parts(header[1])
            if line.lstrip().startswith("[["):
                yield number, table
                num_elements[header[1]] += 1
                table = [*table, str(num_elements[header[1]] - 1)]
            yield number, table
        elif key := _KEY.match(line):
            yield number, [*table, *_parts(key[1])]


def _parts(text: str) -> list[str]:
    return [part.strip().strip("\"'") for part in text.split(".")]


def explained(error: ValidationError, section: str) -> str:
    """Problems of settings in one line, with the lines of the configuration file they come from.

    Values that may be secret are not among them.
    """
    if error.error_count() > MAX_PROBLEMS:
        text = first_problems(error)
    else:
        text = "; ".join(_problem_text(item) for item in error.errors(include_url=False))
    path = configuration_path()
    if path is None:
        return text
    values, places = read_configuration(path).get(section, {}), []
    for item in error.errors(include_input=False, include_url=False):
        keys = [section, *(str(part) for part in item["loc"])]
        if item["loc"] and item["loc"][0] in values:
            places.append(f"{path}:{line_of(path, keys)} [{section}] {'.'.join(keys[1:])}")
    return f"{text}; see {', '.join(places)}" if places else text
