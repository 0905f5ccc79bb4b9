"""Mapping file (TOML) that names the wrist and fingers of a hand model (docs/hands.md)."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.finger_table import Vector3
from dextouch.hands.hand_files.reading import read_bounded

MAX_BYTES: Final = 64 * 2**10
# Far above any length or direction.
MAX_NUMBER: Final = 1e6
_ORIGIN: Final = (0.0, 0.0, 0.0)
_PLACES: Final = ("link", "body", "site")


@dataclass(frozen=True)
class TipMapping:
    """Fingertip: a link (body) or a site, and an offset in its frame."""

    link: str | None
    site: str | None
    offset_m: Vector3


@dataclass(frozen=True)
class FingerMapping:
    """A finger: its chain of the tracked skeleton, joints from the wrist outwards, its tip."""

    chain: str
    joints: tuple[str, ...]
    knuckle: str
    pip: str
    dip: str
    tip: TipMapping


@dataclass(frozen=True)
class HandMapping:
    """A hand: side, the wrist link, our wrist axes in that link's frame, and the fingers."""

    source: str
    side: str
    wrist: str
    fingers_along: Vector3
    thumb_side: Vector3
    origin_m: Vector3
    fingers: tuple[FingerMapping, ...]


class _Table:
    """A validated TOML table: unknown keys are refused, and errors name their location."""

    def __init__(self, where: str, values: Any, keys: tuple[str, ...]) -> None:  # noqa: ANN401
        if not isinstance(values, Mapping):
            raise InvalidInputError(f"{where}: got {values!r:.80}, expected a table")
        for key in values:
            if key not in keys:
                raise UnknownNameError(f"key in {where}:", key, list(keys))
        self.where = where
        self._values = values

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __getitem__(self, key: str) -> Any:  # noqa: ANN401
        if key not in self._values:
            raise InvalidInputError(f"{self.where}: got no {key!r}, expected one")
        return self._values[key]

    def refusal(self, key: str, expected: str) -> InvalidInputError:
        return InvalidInputError(
            f"{self.where}: got {key} = {self[key]!r:.80}, expected {expected}"
        )

    def text(self, key: str) -> str:
        value = self[key]
        if not isinstance(value, str) or not value:
            raise self.refusal(key, "a name")
        return value

    def names(self, key: str) -> tuple[str, ...]:
        value = self[key]
        if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
            raise self.refusal(key, "a list of names")
        return tuple(value)

    def vector(self, key: str) -> Vector3:
        value = self[key]
        if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
            raise self.refusal(key, "three finite numbers")
        x, y, z = map(float, value)
        return x, y, z

    def tables(self, key: str) -> list[Any]:
        value = self[key]
        if not isinstance(value, list):
            raise self.refusal(key, "a list of tables")
        return value

    def one_of(self, *keys: str) -> str:
        found = [key for key in keys if key in self]
        if len(found) != 1:
            raise InvalidInputError(
                f"{self.where}: got {' and '.join(found) or 'none'}, expected one of "
                f"{', '.join(keys)}"
            )
        return found[0]


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    # Comparisons with NaN are false, and integers of any size compare.
    return -MAX_NUMBER <= value <= MAX_NUMBER


def read_mapping(path: Path) -> HandMapping:
    """Read the mapping of one hand.

    Raises:
        NotFoundError, StorageError: a missing or unreadable file.
        LimitExceededError: over 64 KiB.
        InvalidInputError: not TOML, or a key that is missing or has the wrong type.
        UnknownNameError: an unknown key; the valid ones are listed.
    """
    table = _Table(path.name, _parse(path), ("side", "wrist", "fingers"))
    wrist = _Table(
        f"{path.name} [wrist]",
        table["wrist"],
        ("link", "body", "fingers_along", "thumb_side", "origin_m"),
    )
    fingers = tuple(
        _finger(f"{path.name} [[fingers]] {number}", values)
        for number, values in enumerate(table.tables("fingers"), 1)
    )
    return HandMapping(
        source=path.name,
        side=table.text("side"),
        wrist=wrist.text(wrist.one_of("link", "body")),
        fingers_along=wrist.vector("fingers_along"),
        thumb_side=wrist.vector("thumb_side"),
        origin_m=wrist.vector("origin_m") if "origin_m" in wrist else _ORIGIN,
        fingers=fingers,
    )


def _parse(path: Path) -> dict[str, Any]:
    data = read_bounded(path, MAX_BYTES)
    try:
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path.name}: got invalid UTF-8: {error}") from error
    # Deeply nested brackets hit the parser's recursion limit.
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InvalidInputError(f"{path.name}: got invalid TOML: {error}") from error


def _finger(where: str, values: Any) -> FingerMapping:  # noqa: ANN401
    finger = _Table(where, values, ("chain", "joints", "knuckle", "pip", "dip", "tip"))
    tip = _Table(f"{where} tip", finger["tip"], (*_PLACES, "offset_m"))
    kind = tip.one_of(*_PLACES)
    name = tip.text(kind)
    return FingerMapping(
        chain=finger.text("chain"),
        joints=finger.names("joints"),
        knuckle=finger.text("knuckle"),
        pip=finger.text("pip"),
        dip=finger.text("dip"),
        tip=TipMapping(
            link=None if kind == "site" else name,
            site=name if kind == "site" else None,
            offset_m=tip.vector("offset_m") if "offset_m" in tip else _ORIGIN,
        ),
    )
