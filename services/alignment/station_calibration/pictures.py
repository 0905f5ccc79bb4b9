"""SVG pictures of calibration results: coverage, residuals, rotations, taxel maps."""

from collections.abc import Sequence
from functools import partial
from html import escape

import numpy as np

from dextouch.tactile import hand_canvas
from dextouch.tactile.layout import Side, select_taxels
from services.alignment.calibration.tactile_gain import GloveCalibration, filled_gain
from services.alignment.calibration.tactile_tare import STATES
from services.alignment.station_calibration.boards import (
    VIEWS_PER_REGION,
    BoardView,
    Coverage,
    TurnCoverage,
)

INK, LINE, GOOD, BAD, FAINT = "#1e293b", "#cbd5e1", "#0f766e", "#c2410c", "#94a3b8"
_WIDTH, _ROW, _CELL = 480.0, 18.0, 9
_RESIDUAL_SCALE = 100.0
# Both types: the run-time checks of the tests do not accept an int as a float.
Px = int | float
_COLOURS = ("#0f766e", "#1e293b", "#7c3aed", "#c2410c", "#e2e8f0", "#d97706", "#facc15")
_STATE_COLOURS = dict(zip(STATES, _COLOURS, strict=True))


def coverage_picture(
    views: Sequence[BoardView], coverage: Coverage, size_px: tuple[int, int]
) -> str:
    """Picture of corner positions, board tilts and advice."""
    scale = _WIDTH / size_px[0]
    width, height = _WIDTH / 3, size_px[1] * scale / 3
    image = []
    for (row, column), count in np.ndenumerate(coverage.views_by_region):
        x, y = column * width, row * height
        fill = "#fee2e2" if count < VIEWS_PER_REGION else "#f0fdf4"
        image += [_box(x, y, width, height, fill), _text(x + 6, y + 16, f"{count} views")]
    image += [_dots(view.pixels * scale) for view in views]
    tilts = _polar(coverage.tilts_rad, 110, 60, "tilt of the board: right, down")
    todo = coverage.todo or ("Nothing: the views cover the camera.",)
    bottom = max(3 * height, 240.0) + 60
    return _page(
        _WIDTH + 300,
        bottom + 30 + _ROW * (len(todo) + 1),
        f"{len(views)} views of the board, {size_px[0]} by {size_px[1]} px",
        [_at(16, 40, image), _at(_WIDTH + 40, 60, tilts), _at(16, bottom + 10, _advice(todo))],
    )


def residual_picture(
    views: Sequence[BoardView], residuals_px: Sequence[np.ndarray], size_px: tuple[int, int]
) -> str:
    """Picture of corner residuals, enlarged 100 times, and RMS by photo."""
    scale = _WIDTH / size_px[0]
    height = size_px[1] * scale
    image = [_box(0, 0, _WIDTH, height, "none")]
    for view, residual in zip(views, residuals_px, strict=True):
        ends = np.hstack([view.pixels * scale, residual * _RESIDUAL_SCALE * scale])
        image.append(_path("".join("M{:.1f} {:.1f}l{:.1f} {:.1f}".format(*e) for e in ends), BAD))
    rms = np.array([np.sqrt((residual**2).sum(axis=1).mean()) for residual in residuals_px])
    rows = _bars(rms, [view.name for view in views], "px", 440)
    return _page(
        _WIDTH + 500,
        60 + max(height, _ROW * len(rms)),
        "Residuals of the corners, 100 times enlarged; RMS of each photo",
        [_at(16, 40, image), _at(_WIDTH + 40, 40, rows)],
    )


def turns_picture(coverage: TurnCoverage, names: Sequence[str], off_mm: np.ndarray | None) -> str:
    """Picture of tracker rotations, and the error of each view."""
    parts = []
    for index, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        title = f"turns about {'xyz'[a]} (right) and {'xyz'[b]} (down)"
        parts.append(
            _at(16 + 220 * index, 60, _polar(coverage.turns_rad[:, (a, b)], 90, 90, title))
        )
    todo = coverage.todo or ("Nothing: the turns show the mount.",)
    parts.append(_at(16, 280, _advice(todo)))
    top = 320 + _ROW * len(todo)
    if off_mm is not None:
        parts.append(_text(16, top, "How far each view puts the board from its mean", bold=True))
        parts.append(_at(16, top + 10, _bars(off_mm, names, "mm", 640)))
        top += 10 + _ROW * len(names)
    return _page(700, top + 20, f"Turns of the tracker, {len(names)} views", parts)


def glove_picture(found: GloveCalibration) -> str:
    """Maps of tare, noise, gain and state of all taxels in hand layout."""
    side, level = found.tare.side, found.tare.level
    select = partial(select_taxels, side=side)
    maps = {
        "tare, counts": select(level.mean_counts),
        "noise of a reading, counts": select(level.noise_counts),
    }
    if found.gain is not None:
        maps["gain, counts a kPa"] = filled_gain(found.gain)
    parts = []
    for index, (title, values) in enumerate(maps.items()):
        # A saturated taxel must not compress the colour range of the others.
        low, high = (float(v) for v in np.percentile(values, (2, 98)))
        level_of = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
        fills = [f"hsl({220 - 180 * v:.0f} 70% {35 + 30 * v:.0f}%)" for v in level_of]
        words = f"{title}: mostly {low:.3g} … {high:.3g}"
        parts.append(_at(16 + 260 * index, 60, _taxels(values, fills, side, words)))
    if found.gain is not None:
        numbers = found.num_by_state()
        fills = [_STATE_COLOURS[STATES[int(state)]] for state in found.gain.state]
        words = ", ".join(f"{n} {name}" for name, n in numbers.items())
        parts.append(_at(16 + 260 * 3, 60, _taxels(found.gain.state, fills, side, words)))
        for index, name in enumerate(numbers):
            y = 330 + 16 * index
            parts.append(_box(796, y, 10, 10, _STATE_COLOURS[name]))
            parts.append(_text(812, y + 10, name, colour=INK if name == "ok" else BAD))
    return _page(16 + 260 * 4, 450, f"Glove {side}, seen from the palm", parts)


def _taxels(values: np.ndarray, fills: Sequence[str], side: Side, title: str) -> list[str]:
    """Boxes of all taxels in hand layout, with their values as hover texts."""
    canvas = hand_canvas(np.arange(len(values), dtype=np.float32), side=side)
    parts = [_text(0, -6, title)]
    for row, column in np.argwhere(~np.isnan(canvas)):
        taxel = int(canvas[row, column])
        box = {"x": column * _CELL, "y": row * _CELL, "width": _CELL - 1, "height": _CELL - 1}
        hover = _tag("title", f"{values[taxel]:.4g}")
        parts.append(_tag("rect", hover, **box, fill=fills[taxel]))
    return parts


def _advice(todo: Sequence[str]) -> list[str]:
    lines = [_text(0, _ROW * (index + 1), words) for index, words in enumerate(todo)]
    return [_text(0, 0, "What to do next", bold=True), *lines]


def _bars(values: np.ndarray, labels: Sequence[str], unit: str, width: Px) -> list[str]:
    """Horizontal bars with label and value."""
    lengths = (width - 220) * values / max(float(np.max(values, initial=0.0)), 1e-12)
    parts = []
    for index, (value, label, length) in enumerate(zip(values, labels, lengths, strict=True)):
        y = _ROW * index
        parts.append(_text(0, y + 12, label[:20]))
        parts.append(_box(150, y + 3, max(length, 0.5), 11, FAINT, stroke="none"))
        parts.append(_text(156 + length, y + 12, f"{value:.3g} {unit}"))
    return parts


def _polar(points_rad: np.ndarray, radius: Px, full_deg: Px, title: str) -> list[str]:
    """Directions [n, 2] in a polar plot with three rings; farther ones lie on the rim."""
    middle, parts = radius + 4, [_text(0, -6, title)]
    for ring in (1 / 3, 2 / 3, 1):
        r, degrees = radius * ring, full_deg * ring
        parts.append(_tag("circle", cx=middle, cy=middle, r=r, fill="none", stroke=LINE))
        parts.append(_text(middle + 2, middle - r + 12, f"{degrees:.0f}°", colour=FAINT))
    share = np.rad2deg(points_rad) / full_deg
    share /= np.maximum(1.0, np.linalg.norm(share, axis=1, keepdims=True))
    return [*parts, _dots(middle + share * radius, width=6)]


def _dots(points: np.ndarray, width: Px = 3) -> str:
    """Points [n, 2] as one path, which is compact for thousands of corners."""
    return _path("".join(f"M{x:.1f} {y:.1f}h0" for x, y in points), GOOD, width, "round")


def _path(d: str, stroke: str, width: Px = 1, cap: str = "butt") -> str:
    return _tag("path", d=d, stroke=stroke, stroke_width=width, stroke_linecap=cap, fill="none")


def _box(x: Px, y: Px, width: Px, height: Px, fill: str, *, stroke: str = LINE) -> str:
    return _tag("rect", x=x, y=y, width=width, height=height, fill=fill, stroke=stroke)


def _text(x: Px, y: Px, words: str, *, bold: bool = False, colour: str = INK) -> str:
    weight = "bold" if bold else "normal"
    return _tag("text", escape(words), x=x, y=y, fill=colour, font_weight=weight)


def _at(x: Px, y: Px, parts: Sequence[str]) -> str:
    return _tag("g", "".join(parts), transform=f"translate({x:.1f} {y:.1f})")


def _page(width: Px, height: Px, title: str, parts: Sequence[str]) -> str:
    """A complete SVG document."""
    paper = _tag("rect", width=width, height=height, fill="white")
    return _tag(
        "svg",
        paper + _text(16, 22, title, bold=True) + "".join(parts),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width:.0f} {height:.0f}",
        width=width,
        height=height,
        role="img",
        aria_label=title,
        font_family="sans-serif",
        font_size=12,
        fill=INK,
    )


def _tag(name: str, inner: str = "", **attributes: object) -> str:
    """An element; numbers are written with one decimal, names with dashes."""
    given = (
        f'{key.replace("_", "-")}="{escape(value) if isinstance(value, str) else f"{value:.1f}"}"'
        for key, value in attributes.items()
    )
    return f"<{name} {' '.join(given)}>{inner}</{name}>"
