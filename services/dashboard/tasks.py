"""Tasks that the recorder offers, with their instructions, goals and reset times, from TOML."""

import tomllib
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, ValidationError

from dextouch.errors import InvalidInputError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems

# The twin's tasks.
DEFAULT_TASKS: Final = Path(__file__).with_name("tasks.toml")


class TaskChoice(FrozenModel):
    """A task of the list; `goal` and `reset_s` are used in place of those of the settings."""

    name: FreeText = Field(min_length=1, max_length=128)
    instructions: tuple[Annotated[FreeText, Field(min_length=1, max_length=2000)], ...] = Field(
        min_length=1
    )
    goal: int | None = Field(default=None, ge=0, le=1_000_000)
    reset_s: float | None = Field(default=None, ge=0, le=3600)


class _TaskFile(FrozenModel):
    tasks: tuple[TaskChoice, ...] = Field(min_length=1, max_length=1000)


def load_tasks(path: Path | None) -> tuple[TaskChoice, ...]:
    """Tasks of a file; by default those of the twin.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML or has other fields.
    """
    path = path or DEFAULT_TASKS
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return _TaskFile.model_validate(tables).tasks
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"task file {path}: cannot be read: {error}") from error
    except ValidationError as error:
        raise InvalidInputError(
            f"task file {path}: {first_problems(error)}; expected tables [[tasks]] with name, "
            "instructions and optionally goal and reset_s"
        ) from error
