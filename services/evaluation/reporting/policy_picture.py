"""Policies in two worlds as a picture: imagined over real success, for pages and for papers."""

import io
from collections.abc import Mapping, Sequence
from math import cos, pi, sin
from typing import Final, Literal, NamedTuple

from PIL import Image, ImageDraw, ImageFont

from services.evaluation.rendering import rendered

Format = Literal["svg", "png", "tex"]
# A success rate with the ends of its interval.
Rate = tuple[float, float, float]
# Real and imagined rates of every policy, in the tasks that are shown.
Pairs = Mapping[str, Sequence[tuple[Rate, Rate]]]
# Okabe and Ito's colours, which colour-blind readers tell apart; shapes serve prints in gray.
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#767676")
# By their name in pgfplots: corners, angle of the first one and radius in points.
MARKS: Final = {
    "*": (24, 0.0, 4.0),
    "square*": (4, pi / 4, 4.6),
    "diamond*": (4, 0.0, 5.2),
    "triangle*": (3, -pi / 2, 5.2),
}
# In points; a column of a paper is about as wide.
LEFT, TOP, SIDE, ROW, WIDTH = 30.0, 38.0, 220.0, 15.0, 260
INK, QUIET, GRID = "#1b1e24", "#5b6270", "#c9ccd2"
NAMESPACE: Final = 'xmlns="http://www.w3.org/2000/svg"'
SHADES: Final = {INK: 1.0, QUIET: 0.7, GRID: 0.25}
# Width of a letter over its size, on average, in wide sans-serif fonts.
LETTER: Final = 0.62
# PNGs have 300 dots an inch, drawn twice as large.
DOTS, OVERSAMPLING = 300 / 72, 2


class _Shape(NamedTuple):
    """A line, a filled polygon or, with `text`, a text of size `width`; in points from the top."""

    points: Sequence[tuple[float, float]]
    colour: str
    width: float = 0.0
    text: str = ""
    anchor: Literal["start", "middle", "end"] = "start"


def policy_picture(pairs: Pairs, title: str, form: Format) -> bytes:
    """The picture in one format; policies without rates get neither a mark nor a name."""
    if form == "tex":
        styles = {
            name: (list(MARKS)[k % len(MARKS)], tuple(bytes.fromhex(COLOURS[k % len(COLOURS)][1:])))
            for k, name in enumerate(pairs)
        }
        return rendered("policies.tex.j2", pairs=pairs, title=title, styles=styles).encode()
    shapes = _shapes(pairs, title)
    height = round(TOP + SIDE + 34 + ROW * sum(map(bool, pairs.values())))
    if form == "png":
        return _png(shapes, height)
    size = {"width": WIDTH, "height": height}
    drawn = rendered("policies.svg.j2", shapes=shapes, shades=SHADES, ink=INK, **size)
    return drawn.encode()


def _shapes(pairs: Pairs, title: str) -> list[_Shape]:
    def at(x: float, y: float) -> tuple[float, float]:
        return LEFT + SIDE * x, TOP + SIDE * (1 - y)

    bottom = TOP + SIDE
    shapes = [_label((LEFT, 14.0), 11.0, title), _label((4.0, 31.0), 9.0, "imagined success")]
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        (x, _), (_, y) = at(tick, 0.0), at(0.0, tick)
        shapes += [
            _Shape([at(tick, 0.0), at(tick, 1.0)], GRID, 0.6),
            _Shape([at(0.0, tick), at(1.0, tick)], GRID, 0.6),
            _Shape([(x, bottom + 12)], QUIET, 8.0, f"{tick:g}", "middle"),
            _Shape([(LEFT - 5, y + 3)], QUIET, 8.0, f"{tick:g}", "end"),
        ]
    shapes.append(_Shape([at(0.0, 0.0), at(1.0, 1.0)], QUIET, 0.8))
    shapes.append(_Shape([(LEFT + SIDE, bottom + 25)], INK, 9.0, "real success", "end"))
    row = bottom + 38
    for index, (name, found) in enumerate(pairs.items()):
        colour = COLOURS[index % len(COLOURS)]
        for (x, x_low, x_high), (y, y_low, y_high) in found:
            shapes.append(_Shape([at(x_low, y), at(x_high, y)], colour, 1.0))
            shapes.append(_Shape([at(x, y_low), at(x, y_high)], colour, 1.0))
            shapes.append(_Shape(_corners(index, *at(x, y)), colour))
        if found:
            shapes.append(_Shape(_corners(index, LEFT + 5, row), colour))
            shapes.append(_label((LEFT + 16, row + 3), 9.0, name))
            row += ROW
    return shapes


def _label(begin: tuple[float, float], size: float, text: str) -> _Shape:
    """A text in ink, smaller where it would be wider than the picture."""
    return _Shape([begin], INK, min(size, (WIDTH - begin[0]) / (LETTER * max(1, len(text)))), text)


def _corners(index: int, x: float, y: float) -> list[tuple[float, float]]:
    """The mark of a policy, the same in all pictures of a study."""
    num, first_rad, radius = list(MARKS.values())[index % len(MARKS)]
    turns = [first_rad + 2 * pi * k / num for k in range(num)]
    return [(x + radius * cos(turn), y + radius * sin(turn)) for turn in turns]


def _png(shapes: Sequence[_Shape], height: int) -> bytes:
    scale = DOTS * OVERSAMPLING
    sheet = Image.new("RGB", (round(WIDTH * scale), round(height * scale)), "white")
    draw = ImageDraw.Draw(sheet)
    for points, colour, width, text, anchor in shapes:
        scaled = [(x * scale, y * scale) for x, y in points]
        if text:
            font = ImageFont.load_default(width * scale)
            place = {"start": "ls", "middle": "ms", "end": "rs"}[anchor]
            draw.text(scaled[0], text, colour, font, place)
        elif width:
            draw.line(scaled, colour, max(1, round(width * scale)))
        else:
            draw.polygon(scaled, colour)
    made = io.BytesIO()
    smaller = sheet.resize((round(WIDTH * DOTS), round(height * DOTS)), Image.Resampling.LANCZOS)
    smaller.save(made, "PNG", dpi=(300, 300))
    return made.getvalue()
