"""Mapping file (TOML) that names the wrist and fingers of a hand model (docs/hands.md)."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import Field, ValidationError, model_validator

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.hand_files.reading import read_bounded

MAX_BYTES: Final = 64 * 2**10
# Far above any length or direction.
MAX_NUMBER: Final = 1e6

# Messages say the description of a value as what was expected.
Name = Annotated[str, Field(min_length=1, description="a name")]
Number = Annotated[float, Field(strict=True, ge=-MAX_NUMBER, le=MAX_NUMBER)]
Vector = Annotated[tuple[Number, Number, Number], Field(description="three finite numbers")]
TableT = TypeVar("TableT", bound=FrozenModel)


class _Place(FrozenModel):
    """A table that names one part of the model: a link (of MJCF: a body) or a site."""

    link: Name | None = None
    body: Name | None = None

    @model_validator(mode="after")
    def _names_one_part(self) -> "_Place":
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


class TipMapping(_Place):
    """Fingertip: a link (body) or a site, and an offset in its frame."""

    site: Name | None = None
    offset_m: Vector = (0.0, 0.0, 0.0)


class FingerMapping(FrozenModel):
    """A finger: its chain of the tracked skeleton, joints from the wrist outwards, its tip."""

    chain: Name
    joints: tuple[str, ...] = Field(description="a list of names")
    knuckle: Name
    pip: Name
    dip: Name
    tip: TipMapping


class WristMapping(_Place):
    """The wrist's link, and our wrist axes in its frame."""

    fingers_along: Vector
    thumb_side: Vector
    origin_m: Vector = (0.0, 0.0, 0.0)


class HandMapping(FrozenModel):
    """A hand: side, wrist and fingers."""

    side: Name
    wrist: WristMapping
    fingers: tuple[FingerMapping, ...] = Field(description="a list of tables")


def read_mapping(path: Path) -> HandMapping:
    """Read the mapping of one hand.

    Raises:
        NotFoundError, StorageError: a missing or unreadable file.
        LimitExceededError: over 64 KiB.
        InvalidInputError: not TOML, or a key that is missing or has the wrong type.
        UnknownNameError: an unknown key; the valid ones are listed.
    """
    values = _parse(path)
    if "wrist" in values:
        values["wrist"] = _checked(WristMapping, f"{path.name} [wrist]", values["wrist"])
    if isinstance(values.get("fingers"), list):
        values["fingers"] = [
            _finger(f"{path.name} [[fingers]] {number}", finger)
            for number, finger in enumerate(values["fingers"], 1)
        ]
    return _checked(HandMapping, path.name, values)


def _parse(path: Path) -> dict[str, Any]:
    data = read_bounded(path, MAX_BYTES)
    try:
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path.name}: got invalid UTF-8: {error}") from error
    # Deeply nested brackets hit the parser's recursion limit.
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InvalidInputError(f"{path.name}: got invalid TOML: {error}") from error


def _finger(where: str, values: object) -> FingerMapping:
    if isinstance(values, dict) and "tip" in values:
        values = values | {"tip": _checked(TipMapping, f"{where} tip", values["tip"])}
    return _checked(FingerMapping, where, values)


def _checked(model: type[TableT], where: str, values: object) -> TableT:
    """A validated table, whose own tables are validated already."""
    if not isinstance(values, Mapping):
        raise InvalidInputError(f"{where}: got {values!r:.80}, expected a table")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        # An unknown key often explains why another is missing.
        problems = error.errors(include_url=False)
        problem = min(problems, key=lambda found: found["type"] != "extra_forbidden")
        if not problem["loc"]:
            message = problem["msg"].removeprefix("Value error, ")
            raise InvalidInputError(f"{where}: {message}") from error
        key = str(problem["loc"][0])
        if problem["type"] == "extra_forbidden":
            raise UnknownNameError(f"key in {where}:", key, list(model.model_fields)) from error
        if key not in values:
            raise InvalidInputError(f"{where}: got no {key!r}, expected one") from error
        raise InvalidInputError(
            f"{where}: got {key} = {values[key]!r:.80}, "
            f"expected {model.model_fields[key].description or 'a name'}"
        ) from error
