"""A sheet of markers to print, in true size, as SVG."""

from collections.abc import Iterator
from html import escape
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool

from dextouch.errors import InvalidInputError
from dextouch.schemas import MarkerDictionary, ObjectMarker, SceneObjects

PAGE_MM: Final = (210.0, 297.0)
# White around a marker, as a share of its side: detectors need about one cell of six.
_MARGIN: Final = 0.2
_EDGE_MM, _LABEL_MM = 12.0, 5.0


def marker_sheet(objects: SceneObjects) -> str:
    """SVG with the markers of all objects on A4 pages below one another.

    Every marker has a dashed line to cut along, and below it the object, its id and side.

    Raises:
        InvalidInputError: there is no marker, or one is larger than the page.
    """
    wanted = {
        (one.name, marker.id, marker.size_m): marker
        for listed in objects.tasks.values()
        for one in listed
        for marker in one.markers
    }
    if not wanted:
        raise InvalidInputError("markers: the objects have none to print")
    cells = cells_of_markers(objects)
    places, height_mm = _places([marker.size_m for marker in wanted.values()])
    drawn = [
        part
        for ((name, *_), marker), (x_mm, y_mm) in zip(wanted.items(), places, strict=True)
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


def marker_cells(dictionary: MarkerDictionary, marker_id: int) -> Bool[np.ndarray, "n n"]:
    """Which cells of a marker are white, row by row from its upper left; the border is black."""
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.generateImageMarker(kind, marker_id, int(kind.markerSize) + 2) > 0


def cells_of_markers(objects: SceneObjects) -> dict[int, Bool[np.ndarray, "n n"]]:
    """`marker_cells` of every marker of the objects, by its id."""
    return {
        marker.id: marker_cells(objects.dictionary, marker.id)
        for listed in objects.tasks.values()
        for one in listed
        for marker in one.markers
    }


def _places(sizes_m: list[float]) -> tuple[list[tuple[float, float]], float]:
    """Upper left corner (mm) of each black square, in rows, and the height of all pages."""
    places, x_mm, y_mm, row_mm, page = [], _EDGE_MM, _EDGE_MM, 0.0, 0
    for size_m in sizes_m:
        whole_mm = 1e3 * size_m * (1 + 2 * _MARGIN)
        if whole_mm + 2 * _EDGE_MM + _LABEL_MM > PAGE_MM[0]:
            raise InvalidInputError(
                f"markers: one has a side of {1e3 * size_m:g} mm, expected what fits an A4 page"
            )
        if x_mm + whole_mm > PAGE_MM[0] - _EDGE_MM:
            x_mm, y_mm, row_mm = _EDGE_MM, y_mm + row_mm, 0.0
        if y_mm + whole_mm + _LABEL_MM > (page + 1) * PAGE_MM[1] - _EDGE_MM:
            page += 1
            x_mm, y_mm, row_mm = _EDGE_MM, page * PAGE_MM[1] + _EDGE_MM, 0.0
        margin_mm = 1e3 * size_m * _MARGIN
        places.append((x_mm + margin_mm, y_mm + margin_mm))
        x_mm += whole_mm + 2.0
        row_mm = max(row_mm, whole_mm + _LABEL_MM + 2.0)
    return places, (page + 1) * PAGE_MM[1]


def _marker(
    name: str, marker: ObjectMarker, x_mm: float, y_mm: float, is_white: Bool[np.ndarray, "n n"]
) -> Iterator[str]:
    side_mm = 1e3 * marker.size_m
    cell_mm, margin_mm = side_mm / len(is_white), side_mm * _MARGIN
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
