"""Tables of measured figures as Markdown and JSON, with intervals over training seeds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

# References shown beside the models, with their headings; the JSON has all.
NOT_AVAILABLE: Final = "n/a"
REFERENCES_SHOWN: Final = {"copy": "copy", "warp": "warped start", "codec": "codec alone"}


@dataclass(frozen=True)
class Measured:
    """A figure measured once for each training seed; NaN where it is not available.

    `missing` is what is shown then: the reason, if it is known.
    """

    values: tuple[float, ...]
    missing: str = NOT_AVAILABLE

    @property
    def mean(self) -> float:
        """Mean over seeds."""
        return float(np.mean(self.values))

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval of the mean over seeds (Student's t); NaN for one seed."""
        from scipy.stats import t

        num = len(self.values)
        if num < 2:
            return math.nan
        spread = float(np.std(self.values, ddof=1)) / math.sqrt(num)
        return float(t.ppf(0.975, num - 1)) * spread

    def less(self, other: "Measured") -> "Measured":
        """Differences, seed by seed."""
        return Measured(tuple(a - b for a, b in zip(self.values, other.values, strict=True)))

    def text(self, *, signed: bool = False) -> str:
        """Mean and interval, with as many digits as the interval has meaning."""
        if not math.isfinite(self.mean):
            return self.missing
        sign = "+" if signed else ""
        if not math.isfinite(self.half_width):
            return f"{self.mean:{sign}.4g}"
        # Seeds that agree leave the rounding of their mean.
        is_zero = self.half_width <= 1e-9 * max(map(abs, self.values))
        digits = 4 if is_zero else max(0, 1 - math.floor(math.log10(self.half_width)))
        return f"{self.mean:{sign}.{digits}f} ± {self.half_width:.{digits}f}"


@dataclass(frozen=True)
class Row:
    """A row of a table: a figure in every column, with the paper's number if it has one.

    `references` are predictions without a model; NaN where a figure is not available.
    """

    name: str
    cells: Mapping[str, Measured]
    paper: Mapping[str, float | None]
    higher_is_better: bool | None = None
    references: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_available(self) -> bool:
        """Whether any column has a figure, or a reason why it has none."""
        return any(
            math.isfinite(cell.mean) or cell.missing != NOT_AVAILABLE
            for cell in self.cells.values()
        )


@dataclass(frozen=True)
class Page:
    """One table; differences of its columns from `base` are shown below it."""

    title: str
    rows: tuple[Row, ...]
    base: str | None = None

    def markdown(self) -> str:
        """Markdown of the table; rows without any figure are named below it."""
        columns = list(self.rows[0].cells)
        shown = [row for row in self.rows if row.is_available]
        absent = [row.name for row in self.rows if not row.is_available]
        beside = [one for one in REFERENCES_SHOWN if one in self.rows[0].references]
        head = ["", *columns, *(REFERENCES_SHOWN[one] for one in beside)]
        lines = [f"## {self.title}", "", *_markdown_head(head)]
        for row in shown:
            cells = [_with_paper(row.cells[one], row.paper.get(one)) for one in columns]
            cells += [_reference(row.references.get(one, math.nan)) for one in beside]
            lines.append(_markdown_row([_name(row), *cells]))
        if absent:
            lines += ["", f"Not available: {', '.join(absent)}."]
        if self.base is not None:
            others = [one for one in columns if one != self.base]
            lines += ["", f"Difference from {self.base}, seed by seed:", ""]
            lines += _markdown_head(["", *others])
            for row in shown:
                base = row.cells[self.base]
                cells = [row.cells[one].less(base).text(signed=True) for one in others]
                lines.append(_markdown_row([_name(row), *cells]))
        return "\n".join([*lines, ""])

    def to_json(self) -> dict[str, Any]:
        """The values of every seed, and the paper's numbers."""
        return {
            "title": self.title,
            "rows": [
                {
                    "name": row.name,
                    "higher_is_better": row.higher_is_better,
                    "values": {name: _finite(cell.values) for name, cell in row.cells.items()},
                    "paper": dict(row.paper),
                    "references": {
                        name: value if math.isfinite(value) else None
                        for name, value in row.references.items()
                    },
                }
                for row in self.rows
            ],
        }


def _finite(values: Sequence[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]


def _name(row: Row) -> str:
    arrow = {True: " ↑", False: " ↓", None: ""}[row.higher_is_better]
    return f"{row.name}{arrow}"


def _reference(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else NOT_AVAILABLE


def _with_paper(cell: Measured, paper: float | None) -> str:
    return cell.text() if paper is None else f"{cell.text()} (paper {paper:g})"


def _markdown_head(cells: Sequence[str]) -> list[str]:
    return [_markdown_row(cells), "|" + "---|" * len(cells)]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
