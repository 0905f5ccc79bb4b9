r"""Text that people type: characters that change how other text is shown are refused, or escaped.

Control characters can change a terminal or forge lines of a log, and bidirectional marks the order
in which a line is read. Requests refuse them (`FreeText`, `FreeLines`); what was stored before
stays readable, and is escaped where it is printed (`printable`). Schemas limit lengths.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Final

from pydantic import AfterValidator, BaseModel, Field

# Control characters, line and paragraph separators, and format characters without a look of their
# own. The zero-width joiners U+200C and U+200D are not among them: Persian, Indic languages and
# emoji are written with them.
_FORMAT: Final = (
    "\u00ad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\U000e0001\U000e0020-\U000e007f"
)
_IN_LINES: Final = "\x00-\x08\x0b-\x1f\x7f-\x9f" + _FORMAT
_IN_A_LINE: Final = "\x00-\x1f\x7f-\x9f" + _FORMAT
# Halves of UTF-16 pairs, which no encoding can hold; JSON can, but not a pattern of its schema.
_SURROGATES: Final = "\ud800-\udfff"
_UNSAFE_IN_LINES: Final = re.compile(f"[{_IN_LINES}{_SURROGATES}]")
_UNSAFE_IN_A_LINE: Final = re.compile(f"[{_IN_A_LINE}{_SURROGATES}]")


def check_line(text: str) -> str:
    """The text; raises ValueError if it is not one line of visible characters."""
    return _checked(text, _UNSAFE_IN_A_LINE, "visible characters in one line")


def check_lines(text: str) -> str:
    """The text; raises ValueError if it has others than visible characters, tabs and newlines."""
    return _checked(text, _UNSAFE_IN_LINES, "visible characters, tabs and newlines")


def check_texts(model: BaseModel) -> None:
    """Raise ValueError if any text in a model, also as a name in a mapping, is not one line."""
    for text in texts_in(model):
        check_line(text)


def printable(text: str, *, lines: bool = False) -> str:
    r"""The text with the characters that requests refuse escaped as in JSON, such as `\u001b`.

    With `lines`, tabs and newlines stay.
    """
    if text.isascii() and text.isprintable():
        return text
    unsafe = _UNSAFE_IN_LINES if lines else _UNSAFE_IN_A_LINE
    return unsafe.sub(lambda found: json.dumps(found[0])[1:-1], text)


def _checked(text: str, unsafe: re.Pattern[str], expected: str) -> str:
    if found := unsafe.search(text):
        raise ValueError(
            f"got the character U+{ord(found[0]):04X} at position {found.start()}, which changes "
            f"how text is shown; expected {expected}"
        )
    return text


def texts_in(value: object) -> Iterator[str]:
    """All texts in a model, a mapping (names too) or a list, at any depth."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, BaseModel):
        yield from texts_in([one for _, one in value])
    elif isinstance(value, Mapping):
        yield from texts_in([*value.keys(), *value.values()])
    elif isinstance(value, Iterable) and not isinstance(value, bytes):
        for one in value:
            yield from texts_in(one)


FreeText = Annotated[
    str, AfterValidator(check_line), Field(json_schema_extra={"pattern": f"^[^{_IN_A_LINE}]*$"})
]
FreeLines = Annotated[
    str, AfterValidator(check_lines), Field(json_schema_extra={"pattern": f"^[^{_IN_LINES}]*$"})
]
