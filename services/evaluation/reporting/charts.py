"""Small SVG charts that take their colours from the page, and pictures that stand alone."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

MAX_POINTS = 600
NUM_STYLES = 8
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 10, 36
_PALETTE = (
    "#3658a7", "#d0652b", "#2d8a6d", "#a4407f", "#8a7a1c", "#4b96b8", "#7b5bb5", "#6b6f76",
)  # fmt: skip
_KEY_PX = 24


@dataclass(frozen=True)
class Line:
    """One curve; `style` selects its colour on the page, `dashed` its dash pattern."""

    label: str
    x: np.ndarray
    y: np.ndarray
    style: int = 0
    dashed: bool = False


@dataclass(frozen=True)
class Point:
    """One policy in two worlds, with the confidence interval of each score."""

    label: str
    real: float
    imagined: float
    real_interval: tuple[float, float]
    imagined_interval: tuple[float, float]
    style: int = 0


@dataclass(frozen=True)
class _Axes:
    """Scaling from data to picture coordinates."""

    x: tuple[float, float]
    y: tuple[float, float]
    width: int
    height: int

    def to_px(self, x: float, y: float) -> tuple[float, float]:
        right, bottom = self.width - _RIGHT, self.height - _BOTTOM
        return (
            _LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (right - _LEFT),
            bottom - (y - self.y[0]) / (self.y[1] - self.y[0]) * (bottom - _TOP),
        )


def ticks(low: float, high: float, *, about: int = 5) -> list[float]:
    """Round numbers in low … high, roughly `about` of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / about))
    for factor in (1, 2, 5, 10):
        if (high - low) / (step * factor) <= about + 1:
            step *= factor
            break
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def line_chart(
    lines: Sequence[Line], *, x_label: str, y_label: str, width: int = 560, height: int = 240
) -> Markup:
    """Curves over a common axis; long ones are decimated to at most 600 points each."""
    x = np.concatenate([line.x for line in lines])
    y = np.concatenate([line.y for line in lines])
    axes = _Axes(_range(x, margin=0.0), _range(y, margin=0.06), width, height)
    body = [_grid(axes, x_label, y_label)]
    for line in lines:
        stride = max(1, -(-len(line.x) // MAX_POINTS))
        points = " ".join(
            "{:.1f},{:.1f}".format(*axes.to_px(float(a), float(b)))
            for a, b in zip(line.x[::stride], line.y[::stride], strict=True)
        )
        dash = ' stroke-dasharray="4 3"' if line.dashed else ""
        body.append(
            f'<polyline class="curve s{line.style % NUM_STYLES}"{dash} points="{points}">'
            f"<title>{escape(line.label)}</title></polyline>"
        )
    return _svg(body, axes, f"{y_label} over {x_label}")


def agreement_chart(points: Sequence[Point], *, size: int = 300) -> Markup:
    """Imagined over real success, both 0 … 1, with intervals and the identity line."""
    axes = _Axes((-0.04, 1.04), (-0.04, 1.04), size + _LEFT - _TOP, size)
    (x0, y0), (x1, y1) = axes.to_px(0.0, 0.0), axes.to_px(1.0, 1.0)
    body = [
        _grid(axes, "success in the twin", "success imagined"),
        f'<line class="guide" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>',
    ]
    for point in points:
        x, y = axes.to_px(point.real, point.imagined)
        low_x, low_y = axes.to_px(point.real_interval[0], point.imagined_interval[0])
        high_x, high_y = axes.to_px(point.real_interval[1], point.imagined_interval[1])
        body.append(
            f'<g class="s{point.style % NUM_STYLES}"><path class="whisker" '
            f'd="M{low_x:.1f} {y:.1f}H{high_x:.1f}M{x:.1f} {low_y:.1f}V{high_y:.1f}"/>'
            f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="5">'
            f"<title>{escape(point.label)}: real {point.real:.2f}, "
            f"imagined {point.imagined:.2f}</title></circle></g>"
        )
    return _svg(body, axes, "imagined over real success of each policy")


def stand_alone(
    charts: Sequence[Markup], keys: Mapping[str, int], *, width: int = 560, height: int = 240
) -> str:
    """One SVG file of charts of one size side by side, with its own colours and a key of styles."""
    total = width * len(charts)
    style = (
        ".grid{stroke:#e4e5e0}.axis{stroke:#6a7280}text{fill:#4b5563;font:11px sans-serif}"
        ".curve{fill:none;stroke-width:1.6;stroke-linejoin:round}"
    )
    style += "".join(f".curve.s{k}{{stroke:{colour}}}" for k, colour in enumerate(_PALETTE))
    body: list[str] = [
        str(chart).replace("<svg ", f'<svg x="{k * width}" width="{width}" height="{height}" ', 1)
        for k, chart in enumerate(charts)
    ]
    for k, (label, chosen) in enumerate(keys.items()):
        x, y = _LEFT + k * (total - _LEFT) // len(keys), height + _KEY_PX // 2
        body.append(
            f'<path class="curve s{chosen % NUM_STYLES}" d="M{x} {y}h20"/>'
            f'<text x="{x + 26}" y="{y + 4}">{escape(label)}</text>'
        )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {height + _KEY_PX}" '
        f'width="{total}" height="{height + _KEY_PX}"><style>{style}</style>'
        f'<rect width="100%" height="100%" fill="white"/>{"".join(body)}</svg>\n'
    )


def _range(values: np.ndarray, *, margin: float) -> tuple[float, float]:
    """Smallest and largest number with a margin; constant data get a range of their own."""
    low, high = float(values.min()), float(values.max())
    room = (high - low) * margin
    if high - low < 1e-12:
        room = max(abs(high), 1.0) * 0.5
    return low - room, high + room


def _grid(axes: _Axes, x_label: str, y_label: str) -> str:
    right, bottom = axes.width - _RIGHT, axes.height - _BOTTOM
    parts = []
    for value in ticks(*axes.y):
        _, y = axes.to_px(axes.x[0], value)
        parts.append(
            f'<path class="grid" d="M{_LEFT} {y:.1f}H{right}"/>'
            f'<text class="tick" x="{_LEFT - 6}" y="{y + 3.5:.1f}" text-anchor="end">'
            f"{value:.4g}</text>"
        )
    for value in ticks(*axes.x):
        x, _ = axes.to_px(value, axes.y[0])
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">'
            f"{value:.4g}</text>"
        )
    middle_x, middle_y = (_LEFT + right) / 2, (_TOP + bottom) / 2
    parts.append(
        f'<path class="axis" d="M{_LEFT} {bottom}H{right}"/>'
        f'<text class="label" x="{middle_x:.0f}" y="{axes.height - 4}" text-anchor="middle">'
        f"{escape(x_label)}</text>"
        f'<text class="label" transform="translate(12 {middle_y:.0f}) rotate(-90)" '
        f'text-anchor="middle">{escape(y_label)}</text>'
    )
    return "".join(parts)


def _svg(body: Sequence[str], axes: _Axes, title: str) -> Markup:
    # Every label is escaped; the rest are numbers of this module.
    return Markup(  # noqa: S704
        f'<svg class="chart" viewBox="0 0 {axes.width} {axes.height}" role="img" '
        f'aria-label="{escape(title)}">{"".join(body)}</svg>'
    )
