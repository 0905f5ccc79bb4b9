"""SVG primitives for calibration pictures."""

from collections.abc import Sequence
from html import escape

import numpy as np

# Both types: the run-time checks of the tests do not accept an int as a float.
Px = int | float
INK, LINE, GOOD, BAD, FAINT = "#1e293b", "#cbd5e1", "#0f766e", "#c2410c", "#94a3b8"


def page(width: Px, height: Px, title: str, parts: Sequence[str]) -> str:
    """A complete SVG document."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" role="img" aria-label="{escape(title)}" '
        f'font-family="sans-serif" font-size="12" fill="{INK}">'
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="white"/>'
        f"{text(16, 22, title, bold=True)}{''.join(parts)}</svg>\n"
    )


def group(x: Px, y: Px, parts: Sequence[str]) -> str:
    """Translated group of parts."""
    return f'<g transform="translate({x:.1f} {y:.1f})">{"".join(parts)}</g>'


def text(x: Px, y: Px, words: str, *, bold: bool = False, colour: str = INK) -> str:
    """One line of text starting at x."""
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}"{weight}>{escape(words)}</text>'


def rectangle(box: tuple[Px, Px, Px, Px], *, fill: str, stroke: str = LINE) -> str:
    """A box x, y, width, height."""
    x, y, width, height = box
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
        f'fill="{fill}" stroke="{stroke}"/>'
    )


def dots(points: np.ndarray, *, colour: str = GOOD, radius: Px = 1.5) -> str:
    """Points [n, 2] as one path, which is compact for thousands of corners."""
    marks = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return (
        f'<path d="{marks}" stroke="{colour}" stroke-width="{2 * radius:.1f}" '
        'stroke-linecap="round" fill="none"/>'
    )


def arrows(starts: np.ndarray, vectors: np.ndarray, *, colour: str = BAD) -> str:
    """Lines from points [n, 2] along vectors [n, 2]."""
    marks = "".join(
        f"M{x:.1f} {y:.1f}l{u:.1f} {v:.1f}" for (x, y), (u, v) in zip(starts, vectors, strict=True)
    )
    return f'<path d="{marks}" stroke="{colour}" fill="none"/>'


def bars(values: np.ndarray, labels: Sequence[str], *, unit: str, width: Px) -> list[str]:
    """Horizontal bars with label and value; 18 px per row."""
    longest = max(float(np.max(values)), 1e-12) if len(values) else 1.0
    parts = []
    for index, (value, label) in enumerate(zip(values, labels, strict=True)):
        y = 18 * index
        length = (width - 220) * float(value) / longest
        parts += [
            text(0, y + 12, label[:20]),
            rectangle((150, y + 3, max(length, 0.5), 11), fill=FAINT, stroke="none"),
            text(156 + length, y + 12, f"{value:.3g} {unit}"),
        ]
    return parts


def polar(points_rad: np.ndarray, *, radius: Px, full_rad: Px, title: str) -> list[str]:
    """Directions [n, 2] in a polar plot with rings every third of `full_rad`."""
    middle = radius + 4
    parts = [text(0, -6, title)]
    for ring in (1, 2, 3):
        parts.append(
            f'<circle cx="{middle}" cy="{middle}" r="{radius * ring / 3:.1f}" fill="none" '
            f'stroke="{LINE}"/>'
        )
        degrees = np.rad2deg(full_rad * ring / 3)
        parts.append(
            text(middle + 2, middle - radius * ring / 3 + 12, f"{degrees:.0f}°", colour=FAINT)
        )
    length = np.linalg.norm(points_rad, axis=1, keepdims=True)
    inside = points_rad * np.minimum(1.0, full_rad / np.maximum(length, 1e-12))
    parts.append(dots(middle + inside / full_rad * radius, radius=3))
    return parts


def cells(
    values: np.ndarray, colours: Sequence[Sequence[str]], *, size: Px, title: str
) -> list[str]:
    """A grid of small boxes with hover texts; NaN cells are omitted."""
    parts = [text(0, -6, title)]
    for (row, column), value in np.ndenumerate(values):
        if np.isnan(value):
            continue
        parts.append(
            f'<rect x="{column * size:.1f}" y="{row * size:.1f}" width="{size - 1:.1f}" '
            f'height="{size - 1:.1f}" fill="{colours[row][column]}">'
            f"<title>{value:.4g}</title></rect>"
        )
    return parts
