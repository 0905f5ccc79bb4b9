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

from dextouch.errors import InvalidInputError, LimitExceededError, UnknownNameError
from dextouch.hands.hand_files.reading import read_bounded

MAX_BYTES: Final = 8 * 2**20
MAX_DEPTH: Final = 100
MAX_ELEMENTS: Final = 20_000
# Far above any length, angle or direction, yet sums and products stay finite.
MAX_NUMBER: Final = 1e6
# float() also accepts "nan", "inf", "1_0" and digits of other scripts.
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Element:
    """One XML element."""

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
        """The only child with that tag, or None.

        Raises:
            InvalidInputError: several children.
        """
        found = list(self.each(tag))
        if len(found) > 1:
            raise self.refusal(f"got {len(found)} <{tag}>, expected at most one")
        return found[0] if found else None

    def text(self, name: str) -> str:
        """A required attribute.

        Raises:
            InvalidInputError: missing or empty.
        """
        value = self.attributes.get(name)
        if not value:
            raise self.refusal(f"got no {name!r}, expected one; name it in the model")
        return value

    def choice(self, name: str, *valid: str) -> str:
        """An attribute with a fixed set of values; the first one is the default.

        Raises:
            UnknownNameError: another value.
        """
        value = self.attributes.get(name, valid[0])
        if value not in valid:
            raise UnknownNameError(f"value of {name!r} in {self}:", value, list(valid))
        return value

    def numbers(self, name: str, count: int) -> tuple[float, ...] | None:
        """Numbers of an attribute; None if it is absent.

        Raises:
            InvalidInputError: another count, or a number that is not finite or above 1e6.
        """
        text = self.attributes.get(name)
        if text is None:
            return None
        words = text.split()
        if len(words) == count and all(_NUMBER.fullmatch(word) for word in words):
            values = tuple(float(word) for word in words)
            if all(abs(value) <= MAX_NUMBER for value in values):
                return values
        raise self.refusal(
            f"got {name}={text[:80]!r}, expected {count} finite numbers of at most {MAX_NUMBER:g}"
        )


class _Builder:
    def __init__(self, file: str) -> None:
        self._file = file
        self._open: list[Element] = []
        self._count = 0
        self.root: Element | None = None
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype

    def parse(self, data: bytes) -> Element:
        try:
            self._parser.Parse(data, True)  # noqa: FBT003 - takes no keywords
        except expat.ExpatError as error:
            raise InvalidInputError(
                f"{self._file} line {error.lineno}: got invalid XML "
                f"({expat.ErrorString(error.code)}); is the file complete?"
            ) from error
        except (ValueError, LookupError) as error:
            raise InvalidInputError(
                f"{self._file}: got an unknown text encoding: {error}"
            ) from error
        if self.root is None:
            raise InvalidInputError(f"{self._file}: got no XML element")
        return self.root

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if len(self._open) >= MAX_DEPTH or self._count > MAX_ELEMENTS:
            raise LimitExceededError(
                f"{self._line()}: got more than {MAX_DEPTH} nested or {MAX_ELEMENTS} XML elements"
            )
        element = Element(tag, attributes, self._line())
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop()

    def _doctype(self, *_: object) -> None:
        raise InvalidInputError(
            f"{self._line()}: got a document type; entities are never read, remove the declaration"
        )

    def _line(self) -> str:
        return f"{self._file} line {self._parser.CurrentLineNumber}"


def read_elements(path: Path) -> Element:
    """Read an XML file and return its root element.

    Raises:
        NotFoundError, StorageError: a missing or unreadable file.
        LimitExceededError: over 8 MiB, 100 levels or 20 000 elements.
        InvalidInputError: invalid XML, or a document type.
    """
    return _Builder(path.name).parse(read_bounded(path, MAX_BYTES))
