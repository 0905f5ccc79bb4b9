"""SVG charts of time against error."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from benchmarks.figures import Figure

_WIDTH, _HEIGHT = 460, 340
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 18, 34, 48
# Approximate mean width of a letter at the chart's font size.
_CHARACTER_PX = 6.6
_OURS, _RIVAL, _LINE, _TEXT = "#c2410c", "#475569", "#cbd5e1", "#1e293b"


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
    """SVG of panels side by side; panels without points are omitted."""
    panels = [panel for panel in panels if panel.points]
    width = _WIDTH * max(1, len(panels))
    body = [
        f'<g transform="translate({index * _WIDTH} 0)">{"".join(_panel(panel))}</g>'
        for index, panel in enumerate(panels)
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {_HEIGHT}" '
        f'width="{width}" height="{_HEIGHT}" role="img" aria-label="{escape(title)}" '
        f'font-family="sans-serif" font-size="11" fill="{_TEXT}">'
        f'<rect width="{width}" height="{_HEIGHT}" fill="white"/>{"".join(body)}</svg>\n'
    )


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers 1, 2, 5 × 10ⁿ within low … high, both above zero."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    numbers = [factor * 10.0**n for n in range(first, last + 1) for factor in (1, 2, 5)]
    return [number for number in numbers if low <= number <= high]


def linear_ticks(low: float, high: float) -> list[float]:
    """About five round numbers within low … high."""
    step = 10.0 ** math.floor(math.log10((high - low) / 5))
    step *= next((f for f in (1, 2, 5) if (high - low) / (step * f) <= 6), 10)
    return [step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


class _Axes:
    """Mapping of time and error to pixels."""

    def __init__(self, points: Sequence[Point]) -> None:
        self.low = min(point.time_low for point in points) / 1.5
        self.high = max(point.time_high for point in points) * 1.5
        self.error_high = max(max(point.error for point in points) * 1.15, 1e-6)

    def x_px(self, time: float) -> float:
        share = math.log(time / self.low) / math.log(self.high / self.low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    def y_px(self, error: float) -> float:
        return _HEIGHT - _BOTTOM - error / self.error_high * (_HEIGHT - _BOTTOM - _TOP)


def _panel(panel: Panel) -> list[str]:
    axes = _Axes(panel.points)
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts = [f'<text x="{_LEFT}" y="20" font-weight="bold">{escape(panel.title)}</text>']
    for number in linear_ticks(0.0, axes.error_high):
        y = axes.y_px(number)
        parts.append(
            f'<path d="M{_LEFT} {y:.1f}H{right}" stroke="{_LINE}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{number:g}</text>'
        )
    for number in log_ticks(axes.low, axes.high):
        x = axes.x_px(number)
        parts.append(
            f'<path d="M{x:.1f} {_TOP}V{bottom}" stroke="{_LINE}"/>'
            f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{number:g}</text>'
        )
    middle_x, middle_y = (_LEFT + right) / 2, (_TOP + bottom) / 2
    parts.append(
        f'<text x="{middle_x}" y="{_HEIGHT - 12}" text-anchor="middle">'
        f"{escape(panel.time_label)}</text>"
        f'<text transform="translate(16 {middle_y}) rotate(-90)" text-anchor="middle">'
        f"{escape(panel.error_label)}</text>"
    )
    return parts + _points(panel.points, axes)


def _points(points: Sequence[Point], axes: _Axes) -> list[str]:
    """Dots with whiskers, with labels placed to avoid dots and other labels."""
    parts = []
    dots = [(axes.x_px(point.time), axes.y_px(point.error)) for point in points]
    taken = [(x - 6, y - 6, x + 6, y + 6) for x, y in dots]
    for point, (x, y) in zip(points, dots, strict=True):
        colour = _OURS if point.is_ours else _RIVAL
        left, baseline = _label_place(len(point.label) * _CHARACTER_PX, x, y, taken)
        parts.append(
            f'<path d="M{axes.x_px(point.time_low):.1f} {y:.1f}H{axes.x_px(point.time_high):.1f}" '
            f'stroke="{colour}" stroke-width="2"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}">'
            f"<title>{escape(point.label)}: {point.time:.3g}, {point.error:.3g}</title></circle>"
            f'<text x="{left:.1f}" y="{baseline:.1f}" fill="{colour}">{escape(point.label)}</text>'
        )
    return parts


def _label_place(
    width: float, x: float, y: float, taken: list[tuple[float, float, float, float]]
) -> tuple[float, float]:
    """Left end and baseline of a label near its dot; adds its box to `taken`."""
    right = _WIDTH - _RIGHT
    for row in (0, 1, -1, 2, -2, 3, -3, 4):
        baseline = y - 9 + 13 * row + (6 if row > 0 else 0)
        for left in (x - 4, x - width + 4):
            box = (left, baseline - 10, left + width, baseline + 3)
            inside = left >= _LEFT - 8 and left + width <= right + 8 and baseline > _TOP - 4
            if inside and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                return left, baseline
    return max(_LEFT, min(x, right - width)), y - 9


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
