"""Safe XML reader with source locations: no entities, bounded depth and size.

Built on expat: a document type declaration, and with it every entity, is refused; depth and number
of elements are limited.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

from dextouch.errors import (
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnknownNameError,
)

MAX_BYTES: Final = 8 * 2**20
MAX_DEPTH: Final = 100
MAX_ELEMENTS: Final = 20_000
# Far above any length, angle or direction, yet sums and products stay finite.
MAX_NUMBER: Final = 1e6
# float() also accepts "nan", "inf", "1_0" and digits of other scripts.
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Element:
    """One XML element; what it lacks or holds wrongly raises InvalidInputError with its place."""

    tag: str
    attributes: dict[str, str]
    source: str
    children: list["Element"] = field(default_factory=list, repr=False)

    def __str__(self) -> str:
        name = self.attributes.get("name")
        return f"{self.source}: <{self.tag}{f' name={name!r}' if name else ''}>"

    def refusal(self, message: str) -> InvalidInputError:
        """An error about this element, to be raised."""
        return InvalidInputError(f"{self}: {message}", element=self.tag)

    def each(self, *tags: str) -> Iterator["Element"]:
        """Iterate over children with these tags."""
        return (child for child in self.children if child.tag in tags)

    def child(self, tag: str) -> "Element | None":
        """The only child with that tag, or None."""
        found = list(self.each(tag))
        if len(found) > 1:
            raise self.refusal(f"got {len(found)} <{tag}>, expected at most one")
        return found[0] if found else None

    def text(self, name: str) -> str:
        """A required attribute, not empty."""
        value = self.attributes.get(name)
        if not value:
            raise self.refusal(f"got no {name!r}, expected one; name it in the model")
        return value

    def choice(self, name: str, *valid: str) -> str:
        """An attribute with a fixed set of values; the first one is the default."""
        value = self.attributes.get(name, valid[0])
        if value not in valid:
            raise UnknownNameError(f"value of {name!r} in {self}:", value, list(valid))
        return value

    def numbers(self, name: str, *defaults: float) -> tuple[float, ...]:
        """An attribute of as many finite numbers as there are defaults."""
        text = self.attributes.get(name)
        if text is None:
            return defaults
        words = text.split()
        if len(words) == len(defaults) and all(_NUMBER.fullmatch(word) for word in words):
            values = tuple(float(word) for word in words)
            if all(abs(value) <= MAX_NUMBER for value in values):
                return values
        raise self.refusal(
            f"got {name}={text[:80]!r}, expected {len(defaults)} finite numbers of at most "
            f"{MAX_NUMBER:g}"
        )


def read_elements(path: Path) -> Element:
    """Read an XML file of at most 8 MiB, 100 levels and 20 000 elements; returns the root."""
    parser = expat.ParserCreate()
    document = Element("", {}, path.name)
    ancestors = [document]
    count = 0

    def line() -> str:
        return f"{path.name} line {parser.CurrentLineNumber}"

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(ancestors) > MAX_DEPTH or count > MAX_ELEMENTS:
            raise LimitExceededError(
                f"{line()}: got more than {MAX_DEPTH} nested or {MAX_ELEMENTS} XML elements"
            )
        ancestors[-1].children.append(Element(tag, attributes, line()))
        ancestors.append(ancestors[-1].children[-1])

    def doctype(*_: object) -> None:
        raise InvalidInputError(
            f"{line()}: got a document type; entities are never read, remove the declaration"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: ancestors.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_bounded(path, MAX_BYTES), True)  # noqa: FBT003 - takes no keywords
    except expat.ExpatError as error:
        raise InvalidInputError(
            f"{path.name} line {error.lineno}: got invalid XML "
            f"({expat.ErrorString(error.code)}); is the file complete?"
        ) from error
    except (ValueError, LookupError) as error:
        raise InvalidInputError(f"{path.name}: got an unknown text encoding: {error}") from error
    return document.children[0]


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of limited size."""
    try:
        if not path.exists():
            raise NotFoundError(f"{path}: no such file")
        if not path.is_file():
            raise InvalidInputError(f"{path}: got a folder or device, expected a regular file")
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > max_bytes:
        raise LimitExceededError(
            f"{path}: got more than {max_bytes} bytes, expected a hand's description of at most "
            "that; meshes belong into files of their own"
        )
    return data
