"""Mapping file (TOML) that names the wrist and fingers of a hand model (docs/hands.md)."""

import tomllib
from pathlib import Path
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.hand_files.elements import MAX_NUMBER, read_bounded

MAX_BYTES: Final = 64 * 2**10

Name = Annotated[str, Field(min_length=1)]


def _three_numbers(values: object) -> object:
    if (
        not isinstance(values, list)
        or len(values) != 3
        or not all(type(x) in (int, float) and abs(x) <= MAX_NUMBER for x in values)
    ):
        raise ValueError(
            f"got {values!r:.80}, expected three finite numbers of at most {MAX_NUMBER:g}"
        )
    return values


Vector = Annotated[tuple[float, float, float], BeforeValidator(_three_numbers)]


class _Table(FrozenModel):
    @model_validator(mode="before")
    @classmethod
    def _has_known_keys(cls, values: object) -> object:
        if not isinstance(values, dict):
            raise ValueError(f"got {values!r:.80}, expected a table")  # noqa: TRY004 - pydantic's
        # Before all else: an unknown key often explains why another is missing.
        for key in values:
            if key not in cls.model_fields:
                valid = ", ".join(sorted(cls.model_fields))
                raise ValueError(f"unknown key {key!r}; valid: {valid}")
        return values


class _ModelPart(_Table):
    """A table that names one part of the model: a link (of MJCF: a body) or a site."""

    link: Name | None = None
    body: Name | None = None

    @model_validator(mode="after")
    def _names_one_part(self) -> "_ModelPart":
        parts = [part for part in ("link", "body", "site") if part in type(self).model_fields]
        named = [part for part in parts if part in self.model_fields_set]
        if len(named) != 1:
            raise ValueError(
                f"got {' and '.join(named) or 'none'}, expected one of {', '.join(parts)}"
            )
        return self

    @property
    def link_name(self) -> str:
        """The link or body; empty where a site is named."""
        return self.link or self.body or ""


class TipMapping(_ModelPart):
    """Fingertip: a link (body) or a site, and an offset in its frame."""

    site: Name | None = None
    offset_m: Vector = (0.0, 0.0, 0.0)


class FingerMapping(_Table):
    """A finger: its chain of the tracked skeleton, joints from the wrist outwards, its tip."""

    chain: Name
    joints: tuple[str, ...]
    knuckle: Name
    pip: Name
    dip: Name
    tip: TipMapping


class WristMapping(_ModelPart):
    """The wrist's link, and our wrist axes in its frame."""

    fingers_along: Vector
    thumb_side: Vector
    origin_m: Vector = (0.0, 0.0, 0.0)


class HandMapping(_Table):
    """A hand: side, wrist and fingers."""

    side: Name
    wrist: WristMapping
    fingers: tuple[FingerMapping, ...]


def read_mapping(path: Path) -> HandMapping:
    """Read the mapping of one hand, of at most 64 KiB."""
    try:
        text = read_bounded(path, MAX_BYTES).decode("utf-8-sig")
        return HandMapping.model_validate(tomllib.loads(text))
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path.name}: got invalid UTF-8: {error}") from error
    # Deeply nested brackets hit the parser's recursion limit.
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InvalidInputError(f"{path.name}: got invalid TOML: {error}") from error
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "missing":
            message = "got none, expected one"
        elif problem["type"] != "value_error":
            message = f"got {problem['input']!r:.80}: {message}"
        raise InvalidInputError(f"{path.name} {where}: {message}") from error
