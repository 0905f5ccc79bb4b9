"""Templates of report pages, charts, LaTeX and comments, and how these show numbers."""

import math
from functools import cache
from typing import Final

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

UNDEFINED: Final = "undefined"
_LATEX: Final = {ord(letter): rf"\{letter}" for letter in "#$%&_{}"} | {
    ord("\\"): r"\textbackslash{}",
    ord("~"): r"\textasciitilde{}",
    ord("^"): r"\textasciicircum{}",
    # In LaTeX's default encoding of fonts these are other characters.
    ord("<"): r"\textless{}",
    ord(">"): r"\textgreater{}",
    ord("|"): r"\textbar{}",
}


@cache
def environment() -> Environment:
    """Where templates are found; pages and pictures are escaped, text and LaTeX are not."""
    found = Environment(
        loader=PackageLoader("services.evaluation", "reporting/templates"),
        autoescape=select_autoescape(["html.j2", "svg.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"figure": figure, "latex": escape_latex, "repr": repr}
    return found


def rendered(template: str, **values: object) -> str:
    """Text of a template."""
    return environment().get_template(template).render(values)


def escape_latex(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return text.translate(_LATEX)


def is_number(value: object) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def figure(value: object, digits: int = 3) -> str:
    """Format a figure with three significant digits; non-finite values are "undefined".

    The reason of an undefined figure stays: "undefined (2 policies)".
    """
    if not is_number(value):
        return value if isinstance(value, str) and value.startswith(UNDEFINED) else UNDEFINED
    number = float(str(value))
    if number != 0 and not 1e-3 <= abs(number) < 1e5:
        return f"{number:.{digits - 1}e}"
    decimals = digits - 1 - math.floor(math.log10(abs(number))) if number else 1
    return f"{number:.{max(0, min(decimals, 4))}f}"
