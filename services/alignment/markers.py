"""Markers on objects: poses of the objects in images, and sheets of markers to print.

A single square has two poses that look almost alike (Schweighofer and Pinz, 2006): other markers,
a clearly smaller error, or neighbouring images decide.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from dextouch.errors import InvalidInputError
from dextouch.geometry import Distortion, apply, invert, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector, vector_from_rotation
from dextouch.schemas import MarkerDictionary, ObjectMarker, SceneObject, SceneObjects

# Markers whose corners do not fit the pose within this, or this share of the marker's side, are
# partly hidden, or of another size or place than stated. On rendered markers of 25 to 50 px right
# poses had 0.05 to 0.6 px and those that were off by 10 cm 1.0 px.
MAX_REPROJECTION_PX = 0.7
MAX_REPROJECTION_SHARE = 0.015
# One solution is taken for its smaller error alone if the other's is larger by this factor.
_CLEAR_RATIO = 2.0
# Otherwise the one that turned less since a neighbouring image, if by no more than this.
_MAX_TURN_RAD = np.deg2rad(25.0)
# Of the surroundings in which a marker's edges are fitted: as a share of its width, and enlarged.
_MARGIN, _ZOOM = 0.35, 2
# Images that far apart are not compared.
_MAX_APART_NS = 1_000_000_000
# A pose between two that are alike, but this far from both, is of a marker that was partly hidden.
_JUMP_M, _JUMP_RAD, _JUMP_NS = 0.03, np.deg2rad(20.0), 300_000_000
PAGE_MM: Final = (210.0, 297.0)
# White around a marker, as a share of its side: detectors need about one cell of six.
_WHITE: Final = 0.2
_EDGE_MM, _LABEL_MM = 12.0, 5.0


@dataclass(frozen=True)
class TrackedObject:
    """Poses of an object at the times of the images that show it, and its corners' RMS error."""

    t_ns: Int64[np.ndarray, " n"]
    Ts_world_object: Float64[np.ndarray, "n 4 4"]
    reprojection_px: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class _Candidate:
    T_world_object: Float64[np.ndarray, "4 4"]
    error_px: float


class MarkerDetector:
    """Finds markers of a dictionary in gray images, with unbiased corners.

    Of OpenCV's ways to refine corners, only AprilTag's has no bias: others put objects with 30 to
    40 px a side 3 to 14 mm too far away. It is slow, so that it is given the surroundings of found
    markers.
    """

    def __init__(self, dictionary: MarkerDictionary) -> None:
        kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self._coarse = cv2.aruco.ArucoDetector(kind)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._fine = cv2.aruco.ArucoDetector(kind, parameters)

    def find(self, gray: UInt8[np.ndarray, "h w"]) -> dict[int, list[Float64[np.ndarray, "4 2"]]]:
        """Corners (px, the first pixel spans 0 … 1; from the upper left) of markers by id."""
        found: dict[int, list[np.ndarray]] = {}
        for number, corners in _detected(self._coarse, gray):
            refined = self._refined(gray, number, corners)
            if refined is not None:
                found.setdefault(number, []).append(refined)
        return found

    def _refined(
        self, gray: np.ndarray, number: int, corners: Float64[np.ndarray, "4 2"]
    ) -> Float64[np.ndarray, "4 2"] | None:
        """The corners of a marker by the fit to its edges; None if that does not find it."""
        margin_px = _MARGIN * np.ptp(corners, axis=0).max()
        low = np.floor(corners.min(axis=0) - margin_px).clip(0).astype(int)
        high = np.ceil(corners.max(axis=0) + margin_px).astype(int)
        part = np.ascontiguousarray(gray[low[1] : high[1], low[0] : high[0]])
        enlarged = cv2.resize(part, None, fx=_ZOOM, fy=_ZOOM, interpolation=cv2.INTER_CUBIC)
        # Unlike OpenCV's other corners, these count from the corner of the first pixel.
        near = [
            fitted / _ZOOM + low
            for other, fitted in _detected(self._fine, enlarged)
            if other == number
        ]
        off_px = [np.linalg.norm(one - corners, axis=1).max() for one in near]
        return near[int(np.argmin(off_px))] if off_px and min(off_px) < margin_px else None


def _detected(
    detector: cv2.aruco.ArucoDetector, gray: np.ndarray
) -> list[tuple[int, Float64[np.ndarray, "4 2"]]]:
    corners, ids, _ = detector.detectMarkers(gray)
    # Without any marker, OpenCV gives None.
    numbers = [] if not corners else [int(number) for number in np.ravel(ids)]
    pixels = [one.reshape(4, 2).astype(np.float64) for one in corners]
    return list(zip(numbers, pixels, strict=True))


def gray_image(image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w"]:
    """Luma of an RGB image; a gray one, with or without its channel, as it is."""
    channels = image.reshape(*image.shape[:2], -1)
    is_gray = channels.shape[2] == 1
    return channels[..., 0] if is_gray else cv2.cvtColor(channels, cv2.COLOR_RGB2GRAY)


class MarkerTracker:
    """Finds a task's objects in images of a camera; K in px, pixel centres at half-integers."""

    def __init__(
        self,
        objects: Sequence[SceneObject],
        dictionary: MarkerDictionary,
        K: Float64[np.ndarray, "3 3"],
        distortion: Distortion,
    ) -> None:
        self._objects = [one for one in objects if one.markers]
        self._lens = (K, distortion)
        self._markers = MarkerDetector(dictionary)
        self._seen: dict[str, list[tuple[int, list[_Candidate]]]] = {
            one.name: [] for one in self._objects
        }

    def add(
        self,
        t_ns: int,
        image: UInt8[np.ndarray, "h w *c"],
        T_world_camera: Float64[np.ndarray, "4 4"],
    ) -> None:
        """Look for the objects in one more image; images come in the order of their times."""
        found = self._markers.find(gray_image(image))
        for one in self._objects:
            candidates = list(self._candidates(one, found))
            if candidates:
                placed = [
                    _Candidate(T_world_camera @ c.T_world_object, c.error_px) for c in candidates
                ]
                self._seen[one.name].append((t_ns, placed))

    def tracked(self) -> dict[str, TrackedObject]:
        """Poses of every object that has markers, in the images added so far."""
        return {name: _decided(seen) for name, seen in self._seen.items()}

    def _candidates(
        self, one: SceneObject, found: dict[int, list[np.ndarray]]
    ) -> Iterator[_Candidate]:
        """Poses in the camera that explain all of an object's markers, the best one first."""
        # A marker that is there twice belongs to something else, too.
        markers = [marker for marker in one.markers if len(found.get(marker.id, [])) == 1]
        if not markers:
            return
        Ts_object_marker = [transform_from_pose(np.array(marker.pose)) for marker in markers]
        corners_m = [_corners_m(marker.size_m) for marker in markers]
        points_m = np.concatenate([*map(apply, Ts_object_marker, corners_m)])
        pixels = np.concatenate([found[marker.id][0] for marker in markers])
        poses = []
        for marker, flat, T_object_marker in zip(markers, corners_m, Ts_object_marker, strict=True):
            number, turns, shifts, _ = cv2.solvePnPGeneric(
                flat, found[marker.id][0], *self._lens, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            for turn, shift in zip(turns[:number], shifts[:number], strict=True):
                T_camera_marker = transform(rotation_from_vector(turn.ravel()), shift.ravel())
                T = T_camera_marker @ invert(T_object_marker)
                poses.append(self._refined(points_m, pixels, T))
        poses.sort(key=lambda candidate: candidate.error_px)
        if len(markers) > 1:
            poses = poses[:1]
        side_px = float(np.linalg.norm(np.diff(pixels.reshape(-1, 4, 2), axis=1), axis=-1).mean())
        bound_px = max(MAX_REPROJECTION_PX, MAX_REPROJECTION_SHARE * side_px)
        yield from (candidate for candidate in poses if candidate.error_px <= bound_px)

    def _refined(self, points_m: np.ndarray, pixels: np.ndarray, T: np.ndarray) -> _Candidate:
        """The pose of least squares near T, and its error."""
        turn, shift = cv2.solvePnPRefineLM(
            points_m,
            pixels,
            *self._lens,
            vector_from_rotation(T[:3, :3]).reshape(3, 1),
            T[:3, 3].reshape(3, 1).copy(),
        )
        seen, _ = cv2.projectPoints(points_m, turn, shift, *self._lens)
        error_px = float(np.sqrt(np.square(seen.reshape(-1, 2) - pixels).sum(1).mean()))
        refined = transform(rotation_from_vector(turn.ravel()), shift.ravel())
        in_front = (refined[2, :3] @ points_m.T + refined[2, 3]).min() > 0
        return _Candidate(refined, error_px if in_front else np.inf)


def _corners_m(size_m: float) -> Float64[np.ndarray, "4 3"]:
    """Corners of a marker in its own frame, in the order of OpenCV's IPPE_SQUARE and detector."""
    half = 0.5 * size_m
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def _decided(seen: Sequence[tuple[int, list[_Candidate]]]) -> TrackedObject:
    """One pose of each image, forwards from where it is certain, then backwards."""
    chosen = [_certain(candidates) for _, candidates in seen]
    for order in (range(1, len(seen)), range(len(seen) - 2, -1, -1)):
        step = 1 if order.step > 0 else -1
        for index in order:
            near = chosen[index - step]
            gap_ns = abs(seen[index][0] - seen[index - step][0])
            if chosen[index] is None and near is not None and gap_ns <= _MAX_APART_NS:
                chosen[index] = _nearest(seen[index][1], near)
    taken = [(t_ns, one) for (t_ns, _), one in zip(seen, chosen, strict=True) if one is not None]
    taken = [one for index, one in enumerate(taken) if not _jumps(taken, index)]
    return TrackedObject(
        np.array([t_ns for t_ns, _ in taken], dtype=np.int64),
        np.array([one.T_world_object for _, one in taken]).reshape(-1, 4, 4),
        np.array([one.error_px for _, one in taken]),
    )


def _jumps(taken: Sequence[tuple[int, _Candidate]], index: int) -> bool:
    """Whether a pose is far from both of its neighbours, which are alike."""
    if not 0 < index < len(taken) - 1 or taken[index + 1][0] - taken[index - 1][0] > _JUMP_NS:
        return False
    before, here, after = (one for _, one in taken[index - 1 : index + 2])
    return _is_far(before, here) and _is_far(here, after) and not _is_far(before, after)


def _is_far(a: _Candidate, b: _Candidate) -> bool:
    way_m = np.linalg.norm(a.T_world_object[:3, 3] - b.T_world_object[:3, 3])
    return bool(way_m > _JUMP_M or _turned_rad(a, b) > _JUMP_RAD)


def _turned_rad(a: _Candidate, b: _Candidate) -> float:
    return float(rotation_angle(a.T_world_object[:3, :3].T @ b.T_world_object[:3, :3]))


def _certain(candidates: Sequence[_Candidate]) -> _Candidate | None:
    best = candidates[0]
    if len(candidates) == 1 or candidates[1].error_px >= _CLEAR_RATIO * best.error_px:
        return best
    return None


def _nearest(candidates: Sequence[_Candidate], near: _Candidate) -> _Candidate | None:
    turned_rad = [_turned_rad(near, one) for one in candidates]
    best = int(np.argmin(turned_rad))
    return candidates[best] if turned_rad[best] <= _MAX_TURN_RAD else None


def marker_sheet(objects: SceneObjects) -> str:
    """SVG with all markers on A4 pages; raises InvalidInputError for none, or one too large."""
    printed = {
        (one.name, marker.id, marker.size_m): marker
        for listed in objects.tasks.values()
        for one in listed
        for marker in one.markers
    }
    if not printed:
        raise InvalidInputError("markers: the objects have none to print")
    cells = cells_of_markers(objects)
    places, height_mm = _places([marker.size_m for marker in printed.values()])
    drawn = [
        part
        for ((name, *_), marker), (x_mm, y_mm) in zip(printed.items(), places, strict=True)
        for part in _marker(name, marker, x_mm, y_mm, cells[marker.id])
    ]
    width_mm = PAGE_MM[0]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_mm:g}mm" '
            f'height="{height_mm:g}mm" viewBox="0 0 {width_mm:g} {height_mm:g}">',
            f'<rect width="{width_mm:g}" height="{height_mm:g}" fill="white"/>',
            *drawn,
            "</svg>",
            "",
        ]
    )


def cells_of_markers(objects: SceneObjects) -> dict[int, Bool[np.ndarray, "n n"]]:
    """Which cells of each marker are white, by its id, from its upper left; the border is black."""
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, objects.dictionary))
    side = int(kind.markerSize) + 2
    return {
        marker.id: cv2.aruco.generateImageMarker(kind, marker.id, side) > 0
        for listed in objects.tasks.values()
        for one in listed
        for marker in one.markers
    }


def _places(sizes_m: list[float]) -> tuple[list[tuple[float, float]], float]:
    """Upper left corner (mm) of each black square, in rows, and the height of all pages."""
    places, x_mm, y_mm, row_mm, page = [], _EDGE_MM, _EDGE_MM, 0.0, 0
    for size_m in sizes_m:
        whole_mm = 1e3 * size_m * (1 + 2 * _WHITE)
        if whole_mm + 2 * _EDGE_MM + _LABEL_MM > PAGE_MM[0]:
            raise InvalidInputError(
                f"markers: one has a side of {1e3 * size_m:g} mm, expected what fits an A4 page"
            )
        if x_mm + whole_mm > PAGE_MM[0] - _EDGE_MM:
            x_mm, y_mm, row_mm = _EDGE_MM, y_mm + row_mm, 0.0
        if y_mm + whole_mm + _LABEL_MM > (page + 1) * PAGE_MM[1] - _EDGE_MM:
            page += 1
            x_mm, y_mm, row_mm = _EDGE_MM, page * PAGE_MM[1] + _EDGE_MM, 0.0
        margin_mm = 1e3 * size_m * _WHITE
        places.append((x_mm + margin_mm, y_mm + margin_mm))
        x_mm += whole_mm + 2.0
        row_mm = max(row_mm, whole_mm + _LABEL_MM + 2.0)
    return places, (page + 1) * PAGE_MM[1]


def _marker(
    name: str, marker: ObjectMarker, x_mm: float, y_mm: float, is_white: Bool[np.ndarray, "n n"]
) -> Iterator[str]:
    side_mm = 1e3 * marker.size_m
    cell_mm, margin_mm = side_mm / len(is_white), side_mm * _WHITE
    whole_mm = side_mm + 2 * margin_mm
    yield (
        f'<rect x="{x_mm - margin_mm:.3f}" y="{y_mm - margin_mm:.3f}" width="{whole_mm:.3f}" '
        f'height="{whole_mm:.3f}" fill="white" stroke="#999" stroke-width="0.1" '
        'stroke-dasharray="1 1"/>'
    )
    yield f'<rect x="{x_mm:.3f}" y="{y_mm:.3f}" width="{side_mm:.3f}" height="{side_mm:.3f}"/>'
    for row, column in np.argwhere(is_white).tolist():
        yield (
            f'<rect x="{x_mm + column * cell_mm:.3f}" y="{y_mm + row * cell_mm:.3f}" '
            f'width="{cell_mm:.3f}" height="{cell_mm:.3f}" fill="white"/>'
        )
    yield (
        f'<text x="{x_mm - margin_mm:.3f}" y="{y_mm + side_mm + margin_mm + 3.2:.3f}" '
        f'font-family="sans-serif" font-size="3">{escape(name)} · id {marker.id} · '
        f"{side_mm:g} mm · up ↑</text>"
    )
