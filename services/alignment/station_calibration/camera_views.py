"""Views of a board from photos or a station, the intrinsics they give, and pictures (SVG)."""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from html import escape
from itertools import count
from pathlib import Path

import numpy as np

from dextouch.clients import HttpLink
from dextouch.errors import NotFoundError, StaleDataError
from dextouch.geometry import NUM_DISTORTION
from dextouch.schemas import CameraList, StationHealth
from dextouch.tactile.layout import Side, TactileLayout
from services.alignment.calibration.intrinsics import CameraCalibration, calibrate_found
from services.alignment.calibration.tactile_gain import GloveCalibration, filled_gain
from services.alignment.calibration.tactile_tare import STATES
from services.alignment.station_calibration import boards
from services.alignment.station_calibration.record import (
    Say,
    named_matrix,
    read_matrices,
    write_entry,
    write_picture,
)

# OpenCV's pixel origin is the centre of the first pixel, DexTouch's its corner.
PIXEL_SHIFT_PX = 0.5
LIVE_PERIOD_S = 0.2
# Devices that were just started send none at first: chosen, several times what a busy computer
# needs for the first image of a simulated camera.
MAX_FIRST_IMAGE_S = 30.0
WATCH_PERIOD_S = 1.0
# A board that moved by more between two live images is motion-blurred (0.5 px at 6 px).
MAX_MOTION_PX = 1.5
# Views nearer to a kept one than this share of the image diagonal are redundant.
MIN_NEWS = 0.04
MAX_VIEWS = 80
# Number of live images without a new view (4 s and more) after which a hint is printed.
TELL_AFTER_IMAGES = 20
# Of a print along one axis; less moves mounts by less than their sigma.
MIN_TOLD_STRETCH = 0.003
# Of pictures.
INK, LINE, GOOD, BAD, FAINT = "#1e293b", "#cbd5e1", "#0f766e", "#c2410c", "#94a3b8"
_WIDTH, _ROW, _CELL = 480.0, 18.0, 9
_RESIDUAL_SCALE = 100.0
# Both types: the run-time checks of the tests do not accept an int as a float.
Px = int | float
_COLOURS = ("#0f766e", "#1e293b", "#7c3aed", "#c2410c", "#e2e8f0", "#d97706", "#facc15")
_STATE_COLOURS = dict(zip(STATES, _COLOURS, strict=True))

Arrivals = Iterator[tuple[str, bytes]]
Wait = Callable[[float], None]


def calibrate_photos(options: argparse.Namespace, *, say: Say = print) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case."""
    paths = boards.photo_paths(options.photos)
    if not paths:
        raise NotFoundError(
            f"{options.photos}: holds no photo; expected {', '.join(boards.SUFFIXES)}"
        )
    photos = boards.read_photos(paths, boards.parse_board(options.board))
    coverage, path = write_coverage(photos.views, photos.size_px, options.to, options.camera)
    say(f"board found in {len(photos.views)} of {len(photos)} photos ({photos.pattern})")
    photos.tell_left_out(say)
    for words in coverage.todo:
        say(f"next: {words}")
    say(f"coverage: {path}")
    report: dict[str, object] = {
        "num_photos": len(photos),
        "num_with_board": len(photos.views),
        "without_board": list(photos.without_board),
        "blurred": list(photos.blurred),
        "board_kind": photos.pattern,
        "views_by_region": coverage.views_by_region.tolist(),
        "next": list(coverage.todo),
    }
    if options.check:
        return report
    result = calibrate_found(photos.corners())
    for index in sorted(set(range(len(photos.views))) - set(result.used_images)):
        say(f"  corners of {photos.views[index].name} do not fit the others: left out")
    lens = boards.Lens(result.K, result.distortion)
    coverage, _ = write_coverage(photos.views, photos.size_px, options.to, options.camera, lens)
    residuals = [boards.reprojection(view, lens) for view in photos.views]
    picture = residual_picture(photos.views, residuals, photos.size_px)
    write_picture(options.to, f"residuals_{options.camera}.svg", picture)
    return report | keep_camera(result, photos, coverage, options, say=say)


def write_coverage(
    views: Sequence[boards.BoardView],
    size_px: tuple[int, int],
    folder: Path,
    camera: str,
    lens: boards.Lens | None = None,
) -> tuple[boards.Coverage, Path]:
    """Coverage by these views, and the path of its picture; arguments as `camera_coverage`."""
    coverage = boards.camera_coverage(views, size_px, lens)
    picture = coverage_picture(views, coverage, size_px)
    return coverage, write_picture(folder, f"coverage_{camera}.svg", picture)


def keep_camera(
    result: CameraCalibration,
    photos: boards.Photos,
    coverage: boards.Coverage,
    options: argparse.Namespace,
    *,
    say: Say = print,
) -> dict[str, object]:
    """Write the intrinsics of a camera to the calibration folder, say them and return the facts."""
    K, sigma = result.K.copy(), result.sigma_fxfycxcy_px
    K[:2, 2] += PIXEL_SHIFT_PX
    fx, fy, cx, cy = (float(v) for v in K[[0, 1, 0, 1], [0, 1, 2, 2]])
    name = f"K_{options.camera}"
    facts: dict[str, object] = {
        "camera": options.camera,
        "board": asdict(boards.parse_board(options.board)),
        "num_views": len(result.used_images),
        "fx_fy_cx_cy_px": [fx, fy, cx, cy],
        "sigma_fx_fy_cx_cy_px": sigma.tolist(),
        "distortion_k1_k2_p1_p2_k3": result.distortion.tolist(),
        "sigma_distortion": result.sigma_distortion.tolist(),
        "rms_px": result.rms_px,
        "board_bend_mm": result.board_bend_m * 1e3,
        "board_stretch": result.board_stretch,
        "board_kind": photos.pattern,
        "image_size_px": list(photos.size_px),
        "views_by_region": coverage.views_by_region.tolist(),
        "next": list(coverage.todo),
    }
    matrices = {
        name: K,
        f"{name}_sigma_px": sigma,
        f"distortion_{options.camera}": result.distortion,
        f"image_size_{options.camera}_px": np.array(photos.size_px, dtype=np.float64),
    }
    write_entry(options.to, name, matrices, facts)
    say(
        f"{name}: fx {fx:.2f} ± {sigma[0]:.2f}, fy {fy:.2f} ± {sigma[1]:.2f}, "
        f"cx {cx:.2f} ± {sigma[2]:.2f}, cy {cy:.2f} ± {sigma[3]:.2f} px "
        f"({len(result.used_images)} views, residual {result.rms_px:.3f} px RMS)"
    )
    if abs(result.board_stretch) > MIN_TOLD_STRETCH:
        say(
            f"  the print is longer along its columns' axis by {result.board_stretch:+.2%}, as K "
            "takes into account; print it to scale before you calibrate the mount"
        )
    return facts


def read_lens(folder: Path, camera: str) -> tuple[boards.Lens, tuple[int, int]]:
    """OpenCV's lens of a calibrated camera, and width and height of its images (px)."""
    try:
        matrices = read_matrices(folder)
        K = named_matrix(matrices, f"K_{camera}", (3, 3))
        distortion = named_matrix(matrices, f"distortion_{camera}", (1, NUM_DISTORTION))
        width_px, height_px = named_matrix(matrices, f"image_size_{camera}_px", (1, 2))[0]
    except NotFoundError as error:
        raise NotFoundError(
            f"{folder}: no calibration there of the lens of camera {camera}. "
            f"First: the row 'Camera {camera}: lens' of the Calibration page, Guided run; or in a "
            f"shell: dextouch station calibrate camera --camera {camera} --to {folder}"
        ) from error
    K[:2, 2] -= PIXEL_SHIFT_PX
    return boards.Lens(K, distortion[0]), (int(width_px), int(height_px))


class Session:
    """Growing set of views of one camera, with its coverage picture in the calibration folder.

    `live` is the folder in which images of a running station are kept, in new positions of a static
    board; None for photos, which are kept already.

    Attributes:
        coverage: of the views that are kept; None before the first.
        size_px: width and height of the newest image.
        todo: what to do next; empty if the coverage is sufficient.
        newest: board in the newest image; None if there is none.
        hint: why the newest image was not kept; empty if it was.
    """

    def __init__(
        self, options: argparse.Namespace, live: Path | None = None, *, say: Say = print
    ) -> None:
        self.views: list[boards.BoardView] = []
        self.coverage: boards.Coverage | None = None
        self.size_px = (0, 0)
        self.newest: boards.BoardView | None = None
        self.hint = ""
        self.todo: tuple[str, ...] = ("hold the board in front of the camera",)
        self._options, self._board, self._live = options, boards.parse_board(options.board), live
        self._say = say
        self._num_idle = 0
        self._first = 0
        if live is not None:
            live.mkdir(parents=True, exist_ok=True)
            self._first = len(list(live.glob("live_*.jpg")))

    @property
    def is_enough(self) -> bool:
        """Whether coverage is sufficient, or the maximum number of views is reached."""
        return not self.todo or len(self.views) >= MAX_VIEWS

    def collect(self, arrivals: Arrivals) -> None:
        """Process photos or live images as they come, until coverage is sufficient."""
        for name, data in arrivals:
            self.add(name, data)
            if self.is_enough:
                return

    def add(self, name: str, data: bytes) -> None:
        """Process one photo or live image."""
        photo = boards.decode_photo(data, where=name)
        self.size_px = (photo.shape[1], photo.shape[0])
        view = boards.find_board(name, photo, self._board)
        self.hint, self.newest = self._why_not(view, photo), view
        if view is None or self.hint:
            self._tell(name, self.hint)
            return
        if self._live is not None:
            (self._live / f"live_{self._first + len(self.views):04d}.jpg").write_bytes(data)
        self._keep(view)

    def _why_not(self, view: boards.BoardView | None, photo: np.ndarray) -> str:
        if self._live is None:
            return "no board" if view is None else "blurred, left out" * view.is_blurred
        if view is None:
            return "no board in the last image; does --board match this board?"
        before = self.newest
        if before is None or motion_px(view, before) > MAX_MOTION_PX or view.is_blurred:
            return "the board in the last image moves or is blurred; hold it still"
        needed_px = MIN_NEWS * float(np.hypot(*photo.shape))
        is_new = all(motion_px(view, kept) > needed_px for kept in self.views)
        return "" if is_new else "the board is where it was; hold it elsewhere"

    def _tell(self, name: str, why: str) -> None:
        self._num_idle += 1
        if self._live is None:
            self._say(f"{name}: {why}")
        elif self._num_idle % TELL_AFTER_IMAGES == 0:
            self._say(why)

    def _keep(self, view: boards.BoardView) -> None:
        self.views.append(view)
        self._num_idle = 0
        options = self._options
        coverage, path = write_coverage(self.views, self.size_px, options.to, options.camera)
        if coverage.todo != self.todo or len(self.views) == 1:
            self._say(
                f"{len(self.views)} views ({path}); next: {'; '.join(coverage.todo) or 'done'}"
            )
        self.coverage, self.todo = coverage, coverage.todo


def motion_px(a: boards.BoardView, b: boards.BoardView) -> float:
    """Mean displacement of common corners; infinity if there are none."""
    pixels_b = dict(zip(map(tuple, b.points_board.tolist()), b.pixels, strict=True))
    pairs = zip(map(tuple, a.points_board.tolist()), a.pixels, strict=True)
    moved = [np.linalg.norm(pixel - pixels_b[at]) for at, pixel in pairs if at in pixels_b]
    return float(np.mean(moved)) if moved else float("inf")


def folder_arrivals(folder: Path, *, wait: Wait = time.sleep) -> Arrivals:
    """Yield the photos of a folder, then new ones, indefinitely."""
    seen: set[Path] = set()
    while True:
        for path in boards.photo_paths(folder):
            if path not in seen:
                seen.add(path)
                yield path.name, path.read_bytes()
        wait(WATCH_PERIOD_S)


def station_arrivals(link: HttpLink, camera: str, *, wait: Wait = time.sleep) -> Arrivals:
    """Yield new images of a station's camera at 5 Hz, indefinitely, skipping repeated ones.

    Raises NotFoundError: no such camera, or no image within 30 s.
    """
    wait_for_camera(link, camera, wait=wait)
    last = b""
    for number in count():
        data = live_image(link, camera)
        if data and data != last:
            last = data
            yield f"live image {number}", data
        wait(LIVE_PERIOD_S)


def wait_for_camera(link: HttpLink, camera: str, *, wait: Wait) -> None:
    """Wait for the first image of a station's camera.

    Raises NotFoundError: none within 30 s, or at once if the station has no such camera.
    """
    reply = link.request("GET", "/v1/health")
    health = StationHealth.model_validate_json(reply.body, extra="ignore")
    names = [
        stream.stream.removeprefix("camera_")
        for stream in health.streams
        if stream.stream.startswith("camera_")
    ]
    if camera not in names:
        listed = ", ".join(sorted(names)) or "none"
        raise NotFoundError(f"camera {camera!r}: the station has no such camera; it has: {listed}")
    for _ in range(round(MAX_FIRST_IMAGE_S / LIVE_PERIOD_S)):
        try:
            live_image(link, camera)
        except NotFoundError:
            wait(LIVE_PERIOD_S)
        else:
            return
    live_image(link, camera)


def live_image(link: HttpLink, camera: str) -> bytes:
    """The newest image (JPEG) of a camera; empty while it pauses, as an old one looks static."""
    path = f"/v1/live/cameras/camera_{camera}"
    try:
        return link.request("GET", path, accept="image/jpeg").body
    except StaleDataError:
        return b""


def image_late_s(link: HttpLink, camera: str) -> float:
    """How much later than at best a camera's newest image arrived; 0 where it has no clock."""
    reply = link.request("GET", "/v1/live/cameras")
    cameras = CameraList.model_validate_json(reply.body, extra="ignore").cameras
    return next((c.late_s for c in cameras if c.name == f"camera_{camera}"), None) or 0.0


def coverage_picture(
    views: Sequence[boards.BoardView], coverage: boards.Coverage, size_px: tuple[int, int]
) -> str:
    """Picture of corner positions, board tilts and advice."""
    scale = _WIDTH / size_px[0]
    width, height = _WIDTH / 3, size_px[1] * scale / 3
    image = []
    for (row, column), num_views in np.ndenumerate(coverage.views_by_region):
        x, y = column * width, row * height
        fill = "#fee2e2" if num_views < boards.VIEWS_PER_REGION else "#f0fdf4"
        image += [_box(x, y, width, height, fill), _text(x + 6, y + 16, f"{num_views} views")]
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
    views: Sequence[boards.BoardView], residuals_px: Sequence[np.ndarray], size_px: tuple[int, int]
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


def turns_picture(
    turns_rad: np.ndarray, todo: Sequence[str], names: Sequence[str], off_mm: np.ndarray | None
) -> str:
    """Picture of camera rotations [pairs, 3], and the error of each view."""
    parts = []
    axes = ("tilt up and down", "turn left and right", "roll")
    for index, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        title = f"{axes[a]} (right), {axes[b]} (down)"
        parts.append(_at(16 + 220 * index, 60, _polar(turns_rad[:, (a, b)], 90, 90, title)))
    todo = todo or ("Nothing: the turns show the mount.",)
    parts.append(_at(16, 280, _advice(todo)))
    top = 320 + _ROW * len(todo)
    if off_mm is not None:
        parts.append(_text(16, top, "How far each view puts the board from its mean", bold=True))
        parts.append(_at(16, top + 10, _bars(off_mm, names, "mm", 640)))
        top += 10 + _ROW * len(names)
    return _page(700, top + 20, f"Turns of the camera, {len(names)} views", parts)


def glove_picture(found: GloveCalibration) -> str:
    """Maps of tare, noise, gain and state of all taxels in hand layout."""
    side, level = found.tare.side, found.tare.level
    layout, select = found.tare.layout, found.tare.select
    maps = {
        "tare, counts": select(level.mean_counts),
        "noise of a reading, counts": select(level.noise_counts),
    }
    if found.gain is not None:
        maps["gain, counts a kPa"] = filled_gain(found.gain, layout)
    parts = []
    for index, (title, values) in enumerate(maps.items()):
        # A saturated taxel must not compress the colour range of the others.
        low, high = (float(v) for v in np.percentile(values, (2, 98)))
        level_of = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
        fills = [f"hsl({220 - 180 * v:.0f} 70% {35 + 30 * v:.0f}%)" for v in level_of]
        words = f"{title}: mostly {low:.3g} … {high:.3g}"
        parts.append(_at(16 + 260 * index, 60, _taxels(values, fills, (side, layout), words)))
    if found.gain is not None:
        numbers = found.num_by_state()
        fills = [_STATE_COLOURS[STATES[int(state)]] for state in found.gain.state]
        words = ", ".join(f"{n} {name}" for name, n in numbers.items())
        parts.append(_at(16 + 260 * 3, 60, _taxels(found.gain.state, fills, (side, layout), words)))
        for index, name in enumerate(numbers):
            y = 330 + 16 * index
            parts.append(_box(796, y, 10, 10, _STATE_COLOURS[name]))
            parts.append(_text(812, y + 10, name, colour=INK if name == "ok" else BAD))
    return _page(16 + 260 * 4, 450, f"Glove {side}, seen from the palm", parts)


def _taxels(
    values: np.ndarray, fills: Sequence[str], hand: tuple[Side, TactileLayout], title: str
) -> list[str]:
    """Boxes of all taxels in hand layout, with their values as hover texts."""
    side, layout = hand
    canvas = layout.hand_canvas(np.arange(len(values), dtype=np.float32), side=side)
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
