"""SVG pictures of calibration results: coverage, residuals, rotations, taxel maps."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from dextouch.tactile import hand_canvas
from dextouch.tactile.layout import select_taxels
from services.alignment.calibration.tactile_faults import STATES
from services.alignment.calibration.tactile_glove_calibration import GloveCalibration, filled_gain
from services.cli.calibrate.advice import Coverage, TurnCoverage
from services.cli.calibrate.boards import BoardView
from services.cli.calibrate.drawing import (
    BAD,
    GOOD,
    INK,
    LINE,
    arrows,
    bars,
    cells,
    dots,
    group,
    page,
    polar,
    rectangle,
    text,
)

_WIDTH = 480.0
_RESIDUAL_SCALE = 100.0
_STATE_COLOURS = dict(
    zip(
        STATES,
        ("#0f766e", "#1e293b", "#7c3aed", "#c2410c", "#e2e8f0", "#d97706", "#facc15"),
        strict=True,
    )
)


def coverage_picture(
    views: Sequence[BoardView], coverage: Coverage, size_px: tuple[int, int]
) -> str:
    """Picture of corner positions, board tilts and advice."""
    scale = _WIDTH / size_px[0]
    height = size_px[1] * scale
    image = []
    for (row, column), count in np.ndenumerate(coverage.views_by_region):
        box = (column * _WIDTH / 3, row * height / 3, _WIDTH / 3, height / 3)
        image.append(rectangle(box, fill="#fee2e2" if count < 2 else "#f0fdf4"))
        image.append(text(box[0] + 6, box[1] + 16, f"{count} views", colour=INK))
    image += [dots(view.pixels * scale, colour=GOOD) for view in views]
    tilts = polar(
        coverage.tilts_rad,
        radius=110,
        full_rad=float(np.deg2rad(60)),
        title="tilt of the board: right, down",
    )
    advice = [text(0, 0, "What to do next", bold=True)]
    todo = coverage.todo or ("Nothing: the views cover the camera.",)
    advice += [text(0, 18 * (index + 1), words) for index, words in enumerate(todo)]
    bottom = max(height, 240.0) + 60
    return page(
        _WIDTH + 300,
        bottom + 30 + 18 * (len(todo) + 1),
        f"{len(views)} views of the board, {size_px[0]} by {size_px[1]} px",
        [group(16, 40, image), group(_WIDTH + 40, 60, tilts), group(16, bottom + 10, advice)],
    )


def residual_picture(
    views: Sequence[BoardView], residuals_px: Sequence[np.ndarray], size_px: tuple[int, int]
) -> str:
    """Picture of corner residuals, enlarged 100 times, and RMS by photo."""
    scale = _WIDTH / size_px[0]
    height = size_px[1] * scale
    image = [rectangle((0, 0, _WIDTH, height), fill="none", stroke=LINE)]
    for view, residual in zip(views, residuals_px, strict=True):
        image.append(arrows(view.pixels * scale, residual * _RESIDUAL_SCALE * scale))
    rms = np.array([np.sqrt((residual**2).sum(axis=1).mean()) for residual in residuals_px])
    rows = bars(rms, [view.name for view in views], unit="px", width=440)
    return page(
        _WIDTH + 500,
        60 + max(height, 18.0 * len(rms)),
        "Residuals of the corners, 100 times enlarged; RMS of each photo",
        [group(16, 40, image), group(_WIDTH + 40, 40, rows)],
    )


def turns_picture(coverage: TurnCoverage, names: Sequence[str], off_mm: np.ndarray | None) -> str:
    """Picture of tracker rotations, and the error of each view."""
    parts = []
    for index, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        plot = polar(
            coverage.turns_rad[:, (a, b)],
            radius=90,
            full_rad=float(np.deg2rad(90)),
            title=f"turns about {'xyz'[a]} (right) and {'xyz'[b]} (down)",
        )
        parts.append(group(16 + 220 * index, 60, plot))
    lines = coverage.todo or ("Nothing: the turns show the mount.",)
    parts.append(text(16, 280, "What to do next", bold=True))
    parts += [text(16, 298 + 18 * index, words) for index, words in enumerate(lines)]
    top = 320 + 18 * len(lines)
    if off_mm is not None:
        parts.append(text(16, top, "How far each view puts the board from its mean", bold=True))
        parts.append(group(16, top + 10, bars(off_mm, names, unit="mm", width=640)))
        top += 10 + 18 * len(names)
    return page(700, top + 20, f"Turns of the tracker, {len(names)} views", parts)


def glove_picture(found: GloveCalibration) -> str:
    """Maps of tare, noise, gain and state of all taxels in hand layout."""
    side = found.tare.side
    select = partial(select_taxels, side=side)
    level = found.tare.level
    maps = [
        ("tare, counts", select(level.mean_counts)),
        ("noise of a reading, counts", select(level.noise_counts)),
    ]
    if found.gain is not None:
        maps.append(("gain, counts a kPa", filled_gain(found.gain)))
    parts = []
    for index, (title, values) in enumerate(maps):
        # A saturated taxel must not compress the colour range of the others.
        low, high = (float(v) for v in np.percentile(values, (2, 98)))
        canvas = hand_canvas(values, side=side)
        words = f"{title}: mostly {low:.3g} … {high:.3g}"
        parts.append(group(16 + 260 * index, 60, _shaded(canvas, (low, high), words)))
    if found.gain is not None:
        canvas = hand_canvas(found.gain.state, side=side)
        colours = [
            [_STATE_COLOURS[STATES[0 if np.isnan(v) else int(v)]] for v in row] for row in canvas
        ]
        legend = ", ".join(f"{n} {name}" for name, n in found.num_by_state().items())
        parts.append(group(16 + 260 * 3, 60, cells(canvas, colours, size=9, title=legend)))
        for index, name in enumerate(found.num_by_state()):
            y = 330 + 16 * index
            parts.append(rectangle((796, y, 10, 10), fill=_STATE_COLOURS[name], stroke=LINE))
            parts.append(text(812, y + 10, name, colour=INK if name == "ok" else BAD))
    return page(16 + 260 * 4, 450, f"Glove {side}, seen from the palm", parts)


def _shaded(canvas: np.ndarray, limits: tuple[float, float], title: str) -> list[str]:
    low, high = limits
    level = np.nan_to_num((canvas - low) / max(high - low, 1e-12)).clip(0, 1)
    colours = [[f"hsl({220 - 180 * v:.0f} 70% {35 + 30 * v:.0f}%)" for v in row] for row in level]
    return cells(canvas, colours, size=9, title=title)
