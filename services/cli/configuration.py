"""Commands `dextouch config show` and `config example`: the file dextouch.toml and what it sets."""

import argparse
import importlib
import json
import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

from pydantic import BaseModel, SecretStr, ValidationError
from pydantic_core import PydanticUndefined, to_jsonable_python
from pydantic_settings import EnvSettingsSource, SettingsError

from dextouch import serving
from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.data_folder import DATA_VARIABLE, data_folder
from dextouch.errors import InvalidInputError, UnknownNameError

# Settings class of each section, imported when it is asked for.
SECTIONS: Final = {
    "up": "cli.up_settings:UpSettings",
    "acquisition": "acquisition.settings:AcquisitionSettings",
    "episode_store": "episode_store.settings:EpisodeStoreSettings",
    "alignment": "alignment.settings:AlignmentSettings",
    "dashboard": "dashboard.settings:DashboardSettings",
    "twin": "twin.settings:TwinServiceSettings",
    "world_model": "world_model.settings:WorldModelSettings",
    "rating": "evaluation.settings:RatingSettings",
    "studies": "evaluation.settings:StudyServiceSettings",
    "teleoperation": "pipelines.teleoperation.settings:TeleoperationSettings",
    "rating_report": "evaluation.settings:RatingReportSettings",
    "evaluation_run": "evaluation.settings:RunSettings",
    "evaluation_train_policy": "evaluation.settings:TrainPolicySettings",
    "evaluation_train_probe": "evaluation.settings:TrainJudgeSettings",
    "world_model_show": "world_model.settings:ShowCommand",
    "world_model_train": "world_model.paper_settings:TrainCommand",
    "world_model_train_state": "world_model.settings:TrainStateCommand",
    "world_model_train_tokenizer": "world_model.paper_settings:TrainTokenizerCommand",
    "world_model_cache": "world_model.paper_settings:CacheCommand",
    "world_model_distill": "world_model.paper_settings:DistillCommand",
    "world_model_adapt": "world_model.paper_settings:AdaptCommand",
    "world_model_adapt_state": "world_model.settings:AdaptStateCommand",
}
# Those of `config example` unless others are named.
SERVICES: Final = tuple(SECTIONS)[:10]
MASK: Final = "***"
DEFAULT: Final = "default"
REQUIRED: Final = "required"


class Setting(NamedTuple):
    """A setting with its value and where that comes from."""

    keys: tuple[str, ...]
    value: object
    origin: str


def settings_class(section: str) -> type[serving.CommandSettings]:
    """Settings class of a section; raises UnknownNameError if there is none."""
    if section not in SECTIONS:
        raise UnknownNameError("section", section, list(SECTIONS))
    module, _, name = SECTIONS[section].partition(":")
    found: type[serving.CommandSettings] = getattr(
        importlib.import_module(f"services.{module}"), name
    )
    return found


def apply_configuration() -> None:
    """Use the data folder of the configuration file, and refuse sections that no command has.

    The folder is relative to the file; the environment variable DEXTOUCH_DATA comes before it.
    """
    path = serving.configuration_path()
    if path is None:
        return
    for name, value in serving.read_configuration(path).items():
        if name == serving.DATA:
            os.environ.setdefault(DATA_VARIABLE, str(path.parent / Path(value).expanduser()))
        elif name not in SECTIONS:
            raise InvalidInputError(
                f"{path}:{serving.line_of(path, (name,))}: unknown section [{name}], expected one "
                f"of {', '.join(SECTIONS)}"
            )


def unknown_variables(section: str, environment: Iterable[str]) -> list[str]:
    """What is wrong with those environment variables of a section that set nothing.

    Each is described with the setting that was probably meant; fields of nested settings are not
    looked at.
    """
    prefixes = [f"DEXTOUCH_{name.upper()}_" for name in SECTIONS]
    own = f"DEXTOUCH_{section.upper()}_"
    # Those with a name of their own, such as that of --json, have no variable.
    fields = settings_class(section).model_fields.items()
    known = [name.upper() for name, field in fields if field.validation_alias is None]
    problems = []
    for variable in sorted(environment):
        name = variable.upper().partition("__")[0]
        # Some sections begin with the name of another one.
        nearest = max((one for one in prefixes if name.startswith(one)), key=len, default="")
        setting = name.removeprefix(nearest)
        if nearest == own and setting not in known:
            meant = get_close_matches(setting, known, n=1, cutoff=0.75)
            hint = f"see dextouch config show {section}"
            if meant:
                hint = f"did you mean {own}{meant[0]}?"
            problems.append(f"{variable} sets nothing: there is no such setting; {hint}")
    return problems


def effective_settings(section: str) -> list[Setting]:
    """Settings of a section as a command without flags would get them.

    Raises InvalidInputError for an invalid or unknown setting; lines of the file are named.
    """
    kind = settings_class(section)
    try:
        kind()
    except ValidationError as error:
        if any(item["type"] != "missing" for item in error.errors()):
            problems = serving.explained(error, section)
            raise InvalidInputError(f"settings of [{section}]: {problems}") from error
    except SettingsError as error:
        raise InvalidInputError(f"settings of [{section}]: {error}; is it JSON?") from error
    path = serving.configuration_path()
    in_file = dict(_leaves(serving.file_source(kind)[0]())) if serving.file_source(kind) else {}
    in_environment = dict(_leaves(EnvSettingsSource(kind)()))
    known = {one.keys: one.value for one in _defaults(kind)}
    prefix = str(kind.model_config.get("env_prefix"))
    found = []
    for keys in sorted(known | in_file | in_environment, key=lambda keys: _place(kind, keys)):
        inner = any(other[: len(keys)] == keys and other != keys for other in in_file)
        if keys in in_environment:
            origin = prefix + "__".join(keys).upper()
            origin = origin if origin in os.environ else prefix + keys[0].upper()
            value = in_environment[keys]
        elif keys in in_file:
            line = serving.line_of(path, (section, *keys)) if path else None
            value, origin = in_file[keys], f"{path}:{line}"
        elif inner:
            continue
        else:
            value, origin = known[keys], DEFAULT
        found.append(Setting(keys, _masked(value, keys, _secret_names(kind)), origin))
    return found


def example(sections: Sequence[str]) -> str:
    """A configuration file with every setting of some sections, all of them commented out."""
    lines = [
        "# Settings of DexTouch. Every line is a default: remove the # to change it.",
        "# Flags and environment variables (DEXTOUCH_<SECTION>_<SETTING>) come before this file.",
        "",
        "# Data folder of all commands, relative to this file (environment: DEXTOUCH_DATA).",
        '#data = "data"',
    ]
    for section in sections:
        kind = settings_class(section)
        lines += ["", f"[{section}]"]
        tables: dict[tuple[str, ...], list[str]] = {(): []}
        for keys, value, about in _defaults(kind):
            is_given = value is not None and value != REQUIRED
            tables.setdefault(keys[:-1], []).extend(
                [
                    *textwrap.wrap(f"# {about}", 100, subsequent_indent="# "),
                    f"#{keys[-1]} = {toml_text(value) if is_given else '…'}",
                ]
            )
        for table, settings in tables.items():
            lines += ["", f"# [{'.'.join((section, *table))}]"] if table else []
            lines += settings
    return "\n".join(lines) + "\n"


def toml_text(value: object) -> str:
    """A value as TOML; tables are written inline."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_text(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _leaves(values: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[Any, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, (*above, key))
        else:
            yield (*above, key), value


def _defaults(
    kind: type[BaseModel], given: BaseModel | None = None, above: Setting | None = None
) -> Iterator[Setting]:
    """Defaults of all settings, also of nested ones, with descriptions in place of origins."""
    for name, field in kind.model_fields.items():
        keys = (*(above.keys if above else ()), field.alias or name)
        value = field.get_default(call_default_factory=True, validated_data={})
        if given is not None:
            value = getattr(given, name)
        elif value is PydanticUndefined:
            value = REQUIRED
        about = field.description or (above.origin if above else "")
        if isinstance(value, BaseModel):
            yield from _defaults(type(value), value, Setting(keys, value, about))
        else:
            yield Setting(keys, to_jsonable_python(value, fallback=str), about)


def _place(kind: type[BaseModel], keys: tuple[str, ...]) -> tuple[int, tuple[str, ...]]:
    names = [field.alias or name for name, field in kind.model_fields.items()]
    return (names.index(keys[0]) if keys[0] in names else len(names)), keys


def _models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def _secret_names(kind: type[BaseModel]) -> set[str]:
    found = set()
    for name, field in kind.model_fields.items():
        if field.annotation is SecretStr or SecretStr in get_args(field.annotation):
            found.add(name)
        for inner in _models_in(field.annotation):
            found |= _secret_names(inner)
    return found


def _masked(value: object, keys: tuple[str, ...], secret: set[str]) -> object:
    if value is not None and keys and keys[-1] in secret:
        return MASK
    if isinstance(value, Mapping):
        return {key: _masked(one, (*keys, key), secret) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_masked(one, (), secret) for one in value]
    if isinstance(value, str) and "://" in value and "@" in value:
        scheme, _, rest = value.partition("://")
        return f"{scheme}://{MASK}@{rest.rpartition('@')[2]}"
    return value


def show_main(argv: Sequence[str]) -> int:
    """Print effective settings with their origin."""
    parser = CommandParser(
        prog="dextouch config show",
        description="Show the settings of a command and where each comes from; without a section "
        "those of all sections that are not defaults. Secrets are masked.",
        epilog="example:\n  dextouch config show dashboard",
    )
    names = f"one of {', '.join(SECTIONS)}"
    parser.add_argument("section", nargs="?", choices=list(SECTIONS), metavar="SECTION", help=names)
    add_json(parser)
    options = parser.parse_args(list(argv))
    path = serving.configuration_path()
    print(f"# {path.resolve() if path else 'no dextouch.toml here, and no DEXTOUCH_CONFIG'}")
    print(f"# data folder: {data_folder()}")
    result: dict[str, Any] = {}
    for section in [options.section] if options.section else SECTIONS:
        found = [
            one
            for one in effective_settings(section)
            if options.section or one.origin not in {DEFAULT, REQUIRED}
        ]
        if found:
            print(f"\n[{section}]")
        for one in found:
            text = f"{'.'.join(one.keys)} = {toml_text(one.value)}"
            print(f"{text:<48} # {one.origin}")
        result[section] = {
            ".".join(one.keys): {"value": one.value, "origin": one.origin} for one in found
        }
    write_result(
        options.json,
        {"file": str(path) if path else None, "data": str(data_folder()), "sections": result},
    )
    return 0


def example_main(argv: Sequence[str]) -> int:
    """Print an example of the configuration file."""
    parser = CommandParser(
        prog="dextouch config example",
        description="Print a dextouch.toml with all settings of some sections, commented out.",
        epilog="example:\n  dextouch config example acquisition > dextouch.toml",
    )
    parser.add_argument(
        "sections",
        nargs="*",
        metavar="SECTION",
        help=f"default: all services. Known: {', '.join(SECTIONS)}",
    )
    parser.add_argument("--output", type=Path, metavar="PATH", help="new file to write instead")
    options: argparse.Namespace = parser.parse_args(list(argv))
    text = example(options.sections or SERVICES)
    if options.output is None:
        print(text, end="")
        return 0
    try:
        with options.output.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InvalidInputError(f"{options.output}: cannot be written: {error}") from error
    return 0
