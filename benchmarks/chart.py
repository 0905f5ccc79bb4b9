"""SVG charts of time against error."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from benchmarks.figures import Figure

_PANEL_INCHES = (5.2, 4.2)
# Texts stay texts, and equal figures give equal files.
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "benchmarks",
    "font.size": 9,
}


@dataclass(frozen=True)
class Point:
    """One design: its median time with the spread of the rounds, and its error."""

    label: str
    time: float
    time_low: float
    time_high: float
    error: float
    is_ours: bool

    @classmethod
    def of(cls, label: str, time: Figure, error: float, *, is_ours: bool) -> "Point":
        """The point of a design whose time was measured in several rounds."""
        return cls(label, time.median, time.low, time.high, error, is_ours)


@dataclass(frozen=True)
class Panel:
    """One panel: time on the x axis (logarithmic), error on the y axis; lower left is best."""

    title: str
    time_label: str
    error_label: str
    points: Sequence[Point]


def draw(panels: Sequence[Panel], *, title: str) -> str:
    """SVG of panels side by side, our designs as stars; panels without points are omitted."""
    import matplotlib as mpl
    from matplotlib import figure

    panels = [panel for panel in panels if panel.points]
    width, height = _PANEL_INCHES
    with mpl.rc_context(_STYLE):
        picture = figure.Figure((width * len(panels), height), layout="constrained")
        for index, panel in enumerate(panels, 1):
            axes = picture.add_subplot(1, len(panels), index)
            axes.set(title=panel.title, xlabel=panel.time_label, ylabel=panel.error_label)
            axes.set_prop_cycle(color=mpl.colormaps["tab20"](range(20)))
            for point in panel.points:
                spread = [[point.time - point.time_low], [point.time_high - point.time]]
                marker = "*" if point.is_ours else "o"
                drawn = axes.errorbar(
                    point.time, point.error, xerr=spread, fmt=marker, label=point.label
                )
                drawn.lines[0].set_gid(f"{panel.title}: {point.label}")
            axes.set_xscale("log")
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
            axes.legend(fontsize="small")
        text = io.StringIO()
        picture.savefig(text, format="svg", metadata={"Date": None, "Title": title})
    return text.getvalue()
