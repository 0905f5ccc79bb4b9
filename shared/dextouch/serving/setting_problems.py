"""Problems of settings in the words of their user: the option, what it got, what it expects."""

import re
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError

from dextouch.schemas import first_problems

MAX_PROBLEMS: Final = 5
MAX_SHOWN: Final = 60
# What pydantic expects, by the type of its error; `ctx` has the numbers and names.
_EXPECTED: Final = {
    "int_parsing": "a whole number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "string_type": "a text",
    "path_type": "a path",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "string_too_short": "at least {min_length} characters",
    "string_too_long": "at most {max_length} characters",
    "string_pattern_mismatch": "text of the form {pattern}",
    "too_short": "at least {min_length} entries",
    "too_long": "at most {max_length} entries",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "union_tag_invalid": "one of {expected_tags}",
}
# Names of settings whose values are not repeated.
_SECRET: Final = re.compile(r"key|token|secret|password|url", re.IGNORECASE)


def told_problems(error: ValidationError) -> str:
    """The first problems of settings in one line, without values that may be secret."""
    if error.error_count() > MAX_PROBLEMS:
        return first_problems(error)
    return "; ".join(_told(item) for item in error.errors(include_url=False))


def _told(item: Mapping[str, Any]) -> str:
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
    shown = repr(value)
    return shown if len(shown) <= MAX_SHOWN else f"{shown[:MAX_SHOWN]}…"
