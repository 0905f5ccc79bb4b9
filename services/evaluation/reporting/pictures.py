"""Image and array data of a report: head images, taxel maps, residuals and actions."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from markupsafe import Markup
from PIL import Image, ImageDraw

from dextouch.episodes import EpisodeReader
from dextouch.hands.actions import unpack_action
from dextouch.images import encode_jpeg
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile import colour
from dextouch.tactile.layout import (
    CONTACT_THRESHOLD_KPA,
    DEXTOUCH_V1,
    FINGERS,
    SIDES,
    Side,
    TactileLayout,
)
from services.evaluation.rendering import is_number, rendered
from services.evaluation.reporting.policy_picture import NAMESPACE, Rate, policy_picture

# Photographs larger than this are embedded as JPEG.
MAX_PNG_SIDE_PX = 256
MAX_POINTS = 600
NUM_STYLES = 8
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 10, 36
_PALETTE = (
    "#3658a7", "#d0652b", "#2d8a6d", "#a4407f", "#8a7a1c", "#4b96b8", "#7b5bb5", "#6b6f76",
)  # fmt: skip
_KEY_PX = 24
_WIDTH, _HEIGHT = 560, 240
# Pressure at the end of `colour`'s scale.
FULL_SCALE_KPA: Final = 40.0
MOVING_S: Final = 5.0
MAX_MOVING_BYTES: Final = 1_500_000
MAX_MOVING: Final = 8
# A hand and its unloaded taxels, seen on light and on dark pages.
_HAND: Final = (138, 144, 156, 64)
_UNLOADED: Final = (138, 144, 156, 132)
_BEHIND: Final = (24, 27, 34)
_GAP_PX: Final = 16
# S2 of every finger is abduction; the other three joints are flexion.
_FLEXION_HINGES = [0, 2, 3]


@dataclass(frozen=True)
class EpisodePicture:
    """A few moments of one episode."""

    title: str
    times_s: Float64[np.ndarray, " n"]
    images: UInt8[np.ndarray, "n h w 3"]
    tactile_kpa: Float32[np.ndarray, "n 2 taxels"]
    layout: TactileLayout = DEXTOUCH_V1


@dataclass(frozen=True)
class ActionPicture:
    """Actions of one episode on the model grid; commanded ones only for robots."""

    times_s: Float64[np.ndarray, " n"]
    measured: Float64[np.ndarray, "n 67"]
    commanded: Float64[np.ndarray, "n 67"] | None = None


@dataclass(frozen=True)
class PredictionPicture:
    """Moments of one held-out window, true and predicted; of a moving picture all steps."""

    title: str
    times_s: Float64[np.ndarray, " n"]
    true_images: UInt8[np.ndarray, "n h w 3"]
    predicted_images: UInt8[np.ndarray, "n h w 3"]
    true_tactile_kpa: Float32[np.ndarray, "n 2 taxels"]
    predicted_tactile_kpa: Float32[np.ndarray, "n 2 taxels"]
    layout: TactileLayout = DEXTOUCH_V1


@dataclass(frozen=True)
class ReportPictures:
    """Data of all pictures of a report; missing ones are omitted from the page.

    `clock_residuals_ms` maps a stream to its reference times (s) and residuals (ms), [2, n].
    """

    episodes: tuple[EpisodePicture, ...] = ()
    clock_residuals_ms: Mapping[str, Float64[np.ndarray, "2 n"]] = field(default_factory=dict)
    actions: ActionPicture | None = None
    predictions: tuple[PredictionPicture, ...] = ()
    moving: tuple[PredictionPicture, ...] = ()


@dataclass(frozen=True)
class Moment:
    """One column of a strip: caption, head image, and taxel maps of both hands."""

    caption: str
    image: str
    touch: str


def moments(
    times_s: np.ndarray, images: np.ndarray, tactile_kpa: np.ndarray, layout: TactileLayout
) -> list[Moment]:
    """Columns of a strip, as data URLs of embedded images."""
    return [
        Moment(
            f"{time:.2f} s", data_address(image), data_address(hands_image(taxels, layout=layout))
        )
        for time, image, taxels in zip(times_s, images, tactile_kpa, strict=True)
    ]


def data_address(image: UInt8[np.ndarray, "h w channels"]) -> str:
    """Data URL of an image: RGB, or RGBA with opacity."""
    if image.shape[2] == 3 and max(image.shape[:2]) > MAX_PNG_SIDE_PX:
        return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(image)).decode()
    png = io.BytesIO()
    Image.fromarray(image).save(png, "PNG")
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()


def hands_image(
    tactile_kpa: np.ndarray, *, cell_px: int = 4, layout: TactileLayout = DEXTOUCH_V1
) -> UInt8[np.ndarray, "h w 4"]:
    """Both hands [2, taxels] side by side as the dashboard draws them, transparent around them.

    Taxels below half the contact threshold have the colour of the unloaded hand.
    """
    hands = []
    for taxels, side in zip(tactile_kpa, SIDES, strict=True):
        picture = _unloaded_hand(layout, side, cell_px).copy()
        canvas = layout.hand_canvas(taxels, side=side)
        rows, columns = np.nonzero(np.nan_to_num(canvas) >= CONTACT_THRESHOLD_KPA / 2)
        colours = colour(canvas[rows, columns]).tolist()
        drawn = ImageDraw.Draw(picture)
        for row, column, rgb in zip(rows.tolist(), columns.tolist(), colours, strict=True):
            drawn.rounded_rectangle(_cell(row, column, cell_px), cell_px / 2, (*rgb, 255))
        hands.append(
            picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.BOX)
        )
    return np.concatenate([np.asarray(hand) for hand in hands], axis=1)


def _cell(row: int, column: int, cell_px: int) -> tuple[float, ...]:
    """Corners of a taxel in a picture of twice the size with a margin of one cell."""
    x, y, gap = 2 * cell_px * (column + 1), 2 * cell_px * (row + 1), 0.09 * 2 * cell_px
    return x + gap, y + gap, x + 2 * cell_px - 1 - gap, y + 2 * cell_px - 1 - gap


@lru_cache(maxsize=16)
def _unloaded_hand(layout: TactileLayout, side: Side, cell_px: int) -> Image.Image:
    """Silhouette and taxels of a hand without pressure, of twice the size, to be smoothed."""
    rows, columns = layout.canvas
    unit = 2 * cell_px
    picture = Image.new("RGBA", ((columns + 2) * unit, (rows + 2) * unit), (*_HAND[:3], 0))
    drawn = ImageDraw.Draw(picture)
    # Left edge, top, width of each pad, mirrored on the left hand; the palm is drawn last.
    boxes = {}
    for pad in layout.pads:
        (row, column), width = pad.origin, pad.shape[1]
        boxes[pad.part] = column if side == "right" else columns - column - width, row, pad.shape
    palm = boxes.pop("palm", None)
    if palm is not None:
        left, top, (height, width) = palm
        for column, row, shape in boxes.values():
            x = column + shape[1] / 2
            inside = min(max(x, left + 2.5), left + width - 2.5)
            reach = [(x, row + 1.9)]
            reach += [(x, top + 4)] if inside == x else [(x, row + 3), (inside, top + 8)]
            points = [((u + 1) * unit, (v + 1) * unit) for u, v in reach]
            drawn.line(points, _HAND, round(4.9 * unit), joint="curve")
            for u, v in points:
                radius = 2.45 * unit
                drawn.ellipse((u - radius, v - radius, u + radius, v + radius), _HAND)
        corners = (left + 0.5, top + 0.5, left + width + 1.5, top + height + 1.5)
        drawn.rounded_rectangle([unit * corner for corner in corners], 2.6 * unit, _HAND)
    for row, column in np.argwhere(
        np.isfinite(layout.hand_canvas(np.zeros(layout.num_taxels), side=side))
    ).tolist():
        drawn.rounded_rectangle(_cell(row, column, cell_px), cell_px / 2, _UNLOADED)
    return picture


def scale_colours() -> list[str]:
    """CSS colours at equal steps of pressure, from none to `FULL_SCALE_KPA`."""
    rows = colour(np.linspace(0.0, FULL_SCALE_KPA, 21)).tolist()
    return ["rgb({} {} {})".format(*rgb) for rgb in rows]


@dataclass(frozen=True)
class Moving:
    """A moving picture of two worlds, real on the left, and its still one."""

    title: str
    moving: str
    still: str
    seconds: float


def moving_picture(pair: PredictionPicture) -> Moving:
    """At most five seconds of a pair with images of all steps, as animated WebP in a data URL.

    A picture of more than `MAX_MOVING_BYTES` is compressed more, then shown at half the rate.
    """
    shown = np.flatnonzero(pair.times_s <= pair.times_s[0] + MOVING_S)
    step_ms = 1000.0 * float(np.diff(pair.times_s[shown]).mean()) if len(shown) > 1 else 1000.0
    frames = [_frame(pair, index, index / max(1, len(shown) - 1)) for index in shown.tolist()]
    data = b""
    for quality, stride in ((70, 1), (40, 1), (40, 2), (20, 4)):
        data = _webp(frames[::stride], quality, round(step_ms * stride))
        if len(data) <= MAX_MOVING_BYTES:
            break
    moving, still = (
        "data:image/webp;base64," + base64.b64encode(one).decode()
        for one in (data, _webp([frames[len(frames) // 2]], 80, 0))
    )
    return Moving(pair.title, moving, still, step_ms * len(shown) / 1000)


def _webp(frames: Sequence[Image.Image], quality: int, duration_ms: int) -> bytes:
    file, (first, *others) = io.BytesIO(), frames
    moving = {"save_all": True, "append_images": others, "duration": duration_ms, "loop": 0}
    first.save(file, "WEBP", quality=quality, method=2, **(moving if others else {}))
    return file.getvalue()


def _frame(pair: PredictionPicture, index: int, progress: float) -> Image.Image:
    worlds = (
        (pair.true_images, pair.true_tactile_kpa),
        (pair.predicted_images, pair.predicted_tactile_kpa),
    )
    columns = []
    for images, tactile_kpa in worlds:
        hands = Image.fromarray(hands_image(tactile_kpa[index], cell_px=5, layout=pair.layout))
        image = Image.fromarray(images[index])
        size = (hands.width, round(image.height * hands.width / image.width))
        columns.append((image.resize(size, Image.Resampling.BICUBIC), hands))
    width = columns[0][1].width
    height = max(image.height + hands.height for image, hands in columns)
    # Opaque, since a translucent frame would be blended with the one before it.
    frame = Image.new("RGB", (2 * width + _GAP_PX, height + _GAP_PX), _BEHIND)
    for left, (image, hands) in zip((0, width + _GAP_PX), columns, strict=True):
        frame.paste(image, (left, 0))
        frame.paste(hands, (left, height - hands.height), hands)
    line = (0, height + 6, round(progress * (frame.width - 1)), height + 10)
    ImageDraw.Draw(frame).rectangle(line, _HAND[:3])
    return frame


@dataclass(frozen=True)
class Line:
    """One curve; `style` selects its colour on the page, `dashed` its dash pattern."""

    label: str
    x: np.ndarray
    y: np.ndarray
    style: int = 0
    dashed: bool = False


def ticks(low: float, high: float) -> list[float]:
    """Round numbers in low … high, roughly five of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / 5))
    for factor in (1, 2, 5, 10):
        if (high - low) / (step * factor) <= 6:
            step *= factor
            break
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def line_chart(lines: Sequence[Line], *, x_label: str, y_label: str) -> Markup:
    """Curves over a common axis; long ones are decimated to at most 600 points each."""
    to_px, labels = [], []
    for axis, margin, (first_px, last_px) in (
        ("x", 0.0, (_LEFT, _WIDTH - _RIGHT)),
        ("y", 0.06, (_HEIGHT - _BOTTOM, _TOP)),
    ):
        low, high = _range(np.concatenate([getattr(one, axis) for one in lines]), margin=margin)
        scale = partial(_scaled, first=low, last=high, first_px=first_px, last_px=last_px)
        to_px.append(scale)
        labels.append([(value, scale(value)) for value in ticks(low, high)])
    curves = []
    for line in lines:
        kept = slice(None, None, max(1, -(-len(line.x) // MAX_POINTS)))
        pairs = zip(to_px[0](line.x[kept]), to_px[1](line.y[kept]), strict=True)
        curves.append((line, " ".join("{:.1f},{:.1f}".format(*pair) for pair in pairs)))
    return _drawn(
        "lines.svg.j2",
        curves=curves,
        x_label=x_label,
        y_label=y_label,
        x_ticks=labels[0],
        y_ticks=labels[1],
        right=_WIDTH - _RIGHT,
        top=_TOP,
        bottom=_HEIGHT - _BOTTOM,
    )


def stand_alone(charts: Sequence[Markup], keys: Mapping[str, int]) -> str:
    """One SVG file of line charts side by side, with its own colours and a key of styles."""
    style = {"palette": _PALETTE, "key_px": _KEY_PX}
    return f"{_drawn('stand_alone.svg.j2', charts=charts, keys=keys, **style)}\n"


def _drawn(template: str, **values: object) -> Markup:
    size = {"width": _WIDTH, "height": _HEIGHT, "left": _LEFT, "num_styles": NUM_STYLES}
    # The template escapes labels; the rest are numbers of this module.
    return Markup(rendered(template, **size, **values))  # noqa: S704


def _scaled(value: Any, *, first: float, last: float, first_px: int, last_px: int) -> Any:  # noqa: ANN401 - a number or an array
    return first_px + (value - first) / (last - first) * (last_px - first_px)


def _range(values: np.ndarray, *, margin: float) -> tuple[float, float]:
    """Smallest and largest number with a margin; constant data get a range of their own."""
    low, high = float(values.min()), float(values.max())
    room = (high - low) * margin
    if high - low < 1e-12:
        room = max(abs(high), 1.0) * 0.5
    return low - room, high + room


@dataclass(frozen=True)
class NamedChart:
    """A chart with its title and legend."""

    title: str
    svg: Markup
    names: tuple[str, ...]


def clock_chart(pictures: ReportPictures) -> NamedChart | None:
    """Residuals of every fitted clock over time."""
    residuals = pictures.clock_residuals_ms
    if not residuals:
        return None
    lines = [
        Line(name, residual[0], residual[1], style=index)
        for index, (name, residual) in enumerate(residuals.items())
    ]
    svg = line_chart(lines, x_label="time (s)", y_label="residual (ms)")
    return NamedChart("Clock residuals after the fit", svg, tuple(residuals))


def action_charts(actions: ActionPicture | None) -> list[NamedChart]:
    """Wrist translation and finger flexion of both hands, measured and commanded."""
    if actions is None:
        return []
    kinds = {"reached": actions.measured}
    if actions.commanded is not None:
        kinds["commanded"] = actions.commanded
    charts = []
    for side in SIDES:
        wrist: list[Line] = []
        fingers: list[Line] = []
        for kind, rows in kinds.items():
            dashed = kind == "commanded"
            parts = unpack_action(rows)
            translation_cm = 100 * getattr(parts, f"wrist_{side}")[:, :3]
            joints_rad = getattr(parts, f"joints_{side}_rad").reshape(-1, 5, 4)
            flexion_deg = np.degrees(joints_rad[:, :, _FLEXION_HINGES].mean(axis=2))
            wrist += _lines(("x", "y", "z"), actions.times_s, translation_cm, dashed=dashed)
            fingers += _lines(FINGERS, actions.times_s, flexion_deg, dashed=dashed)
        svg = line_chart(wrist, x_label="time (s)", y_label="from its start (cm)")
        charts.append(NamedChart(f"{side.capitalize()} wrist", svg, ("x", "y", "z")))
        svg = line_chart(fingers, x_label="time (s)", y_label="mean flexion (°)")
        charts.append(NamedChart(f"{side.capitalize()} fingers", svg, FINGERS))
    return charts


def _lines(
    names: Sequence[str], times_s: np.ndarray, columns: np.ndarray, *, dashed: bool
) -> list[Line]:
    kind = "commanded" if dashed else "reached"
    return [
        Line(f"{name}, {kind}", times_s, columns[:, k], style=k, dashed=dashed)
        for k, name in enumerate(names)
    ]


def policy_panels(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Scores of the policies and agreement of the worlds, one panel per task."""
    entries = report.get("policies", [])
    panels = list[dict[str, Any]]()
    for task in dict.fromkeys(str(e["task"]) for e in entries):
        rows = [e for e in entries if e["task"] == task]
        pairs = {
            str(one["policy"]): [(_rate(one, "real"), _rate(one, "imagined"))]
            for one in rows
            if is_number(one.get("real"))
            and is_number(one.get("imagined"))
            and one.get("imagined_comparable", True)
        }
        title = f"{report.get('imagined_world', 'imagined')}, {task.replace('_', ' ')}"
        drawn = policy_picture(pairs, title, "svg").decode() if pairs else ""
        # Names are escaped, the rest are numbers; within a page a picture needs no namespace.
        chart = Markup(drawn.replace(f" {NAMESPACE}", "")) if drawn else None  # noqa: S704
        world = report.get("imagined_world")
        panels.append(
            {
                "task": task,
                "rows": rows,
                "agreement": report.get("agreement", {}).get(task, {}),
                "comments": report.get("comments", {}).get(task, []),
                "chart": chart,
                "rubric": report.get("rubrics", {}).get(world, {}).get(task, {}),
            }
        )
    return panels


def _rate(entry: Mapping[str, Any], world: str) -> Rate:
    low, high = entry.get(f"{world}_interval") or (entry[world], entry[world])
    return float(entry[world]), float(low), float(high)


def episode_picture(reader: EpisodeReader, *, num_moments: int = 8) -> EpisodePicture:
    """Evenly spaced moments of a whole episode, including the first and the last."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=(HEAD_CAMERA,))
    steps = np.unique(np.linspace(0, reader.num_steps - 1, num_moments).round().astype(int))
    attributes = reader.attributes
    outcome = {True: "success", False: "failure", None: "outcome unknown"}[attributes.success]
    return EpisodePicture(
        f"{attributes.task}, {attributes.domain}, {attributes.origin}: {outcome}",
        _seconds(window.t_ref_ns)[steps],
        window.images[HEAD_CAMERA][steps],
        window.tactile_kpa[steps],
        window.tactile_layout,
    )


def episode_pair(
    title: str, true: EpisodeReader, imagined: EpisodeReader, num_moments: int | None = None
) -> PredictionPicture:
    """A true and an imagined episode, at evenly spaced steps that both have.

    Without their number at all steps of the first five seconds, of which moving pictures are.
    """
    num_steps = min(true.num_steps, imagined.num_steps)
    if num_moments is None:
        num_steps = min(num_steps, math.ceil(MOVING_S * imagined.attributes.model_rate_hz) + 1)
    shown = np.linspace(0, num_steps - 1, num_moments or num_steps).round().astype(np.int64)
    left, right = (one.window(0, num_steps, cameras=(HEAD_CAMERA,)) for one in (true, imagined))
    return PredictionPicture(
        title,
        shown / imagined.attributes.model_rate_hz,
        left.images[HEAD_CAMERA][shown],
        right.images[HEAD_CAMERA][shown],
        left.tactile_kpa[shown],
        right.tactile_kpa[shown],
        left.tactile_layout,
    )


def action_picture(reader: EpisodeReader) -> ActionPicture:
    """Actions of a whole episode, including commanded ones where available."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=())
    commanded = None
    if "action_commanded" in reader.streams:
        commanded = reader.read("action_commanded").values
    return ActionPicture(_seconds(window.t_ref_ns), window.actions, commanded)


def _seconds(t_ref_ns: np.ndarray) -> np.ndarray:
    """Seconds since the first timestamp; subtracted in int64 first."""
    return (t_ref_ns - t_ref_ns[0]) / 1e9
