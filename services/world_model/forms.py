"""Which form of the world model a command line is about, and so which settings it has."""

import os
from pathlib import Path
from typing import Final

from dextouch.command_line import CommandParser
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.serving import CommandSettings, configuration_path, read_configuration, section_of
from services.world_model.paper_settings import AdaptCommand, TrainCommand
from services.world_model.presets import PRESETS
from services.world_model.settings import AdaptStateCommand, TrainStateCommand

STATE: Final = "state"


def train_settings(arguments: list[str]) -> type[TrainStateCommand] | type[TrainCommand]:
    """Settings of `dextouch train world-model`: of the form that --preset names.

    Raises:
        UnknownNameError: no such preset.
        InvalidInputError: the configuration file has settings of a form that is not trained.
    """
    preset = _value(arguments, "preset", TrainCommand) or STATE
    if preset not in (STATE, *PRESETS):
        raise UnknownNameError("preset", preset, [STATE, *PRESETS])
    if preset != STATE:
        return TrainCommand
    path, section = configuration_path(), section_of(TrainCommand)
    # Nothing would read them.
    if path is not None and read_configuration(path).get(section, {"preset": STATE}) != {
        "preset": STATE
    }:
        raise InvalidInputError(
            f"{path}: [{section}] has settings of the paper's form, and no preset of it is named; "
            f'add preset = "tiny" there, or move them to [{section_of(TrainStateCommand)}]'
        )
    return TrainStateCommand


def adapt_settings(arguments: list[str]) -> type[AdaptStateCommand] | type[AdaptCommand]:
    """Settings of `dextouch train adapt`: of the form of the checkpoint --init."""
    init = _value(arguments, "init", AdaptStateCommand, AdaptCommand)
    if init is None:
        return AdaptStateCommand
    from services.world_model.checkpoints import is_state_checkpoint

    return AdaptStateCommand if is_state_checkpoint(Path(init)) else AdaptCommand


def _value(arguments: list[str], name: str, *classes: type[CommandSettings]) -> str | None:
    """One setting, before it is known which class it is of: a flag, or configured."""
    parser = CommandParser(add_help=False, allow_abbrev=False)
    parser.add_argument(f"--{name}", dest="value")
    value: str | None = parser.parse_known_args(arguments)[0].value
    path = configuration_path()
    for section in map(section_of, classes):
        kept = {} if path is None else read_configuration(path).get(section, {})
        value = value or os.environ.get(f"DEXTOUCH_{section}_{name}".upper()) or kept.get(name)
    return value
