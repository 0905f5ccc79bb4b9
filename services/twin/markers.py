"""Printed markers on the objects of a scene, as a lab would glue them on, and their look in images.

Every object has one on each side of its bounding box. They touch nothing: hands pass through them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.geometry import invert, pose_from_transform, project, transform, transform_from_pose
from dextouch.schemas import MarkerDictionary, ObjectMarker, SceneObject, SceneObjects

DICTIONARY: Final[MarkerDictionary] = "DICT_4X4_50"
# Sides of the black square, as far as the object's side has room.
_SIZES_M: Final = (0.030, 0.055)
# The white margin around it, as a share of its side on either side.
_MARGIN: Final = 0.15
_ABOVE_M: Final = 0.002
# Sub-pixels along each axis of a pixel.
_FINE: Final = 3
_WHITE, _BLACK = 0.95, 0.05
# Columns: x, y and z of a marker on each side of a box, in the frame of the object.
_FACES: Final = (
    np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
    np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
    np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
)


def marked_objects(
    task: str,
    names: Sequence[str],
    boxes_m: Float64[np.ndarray, "objects 6"],
    fixed: Bool[np.ndarray, " objects"],
) -> SceneObjects:
    """The objects of a task with markers on all sides of their boxes, as alignment reads them."""
    objects = []
    for index, (name, box) in enumerate(zip(names, boxes_m, strict=True)):
        markers = [
            _marker(index * len(_FACES) + number, box, face) for number, face in enumerate(_FACES)
        ]
        x, y, z, half_x, half_y, half_z = box.tolist()
        objects.append(
            SceneObject(
                name=name,
                box_m=(x, y, z, half_x, half_y, half_z),
                markers=tuple(markers),
                fixed=bool(fixed[index]),
            )
        )
    return SceneObjects(dictionary=DICTIONARY, tasks={task: tuple(objects)})


def _marker(number: int, box: np.ndarray, face: np.ndarray) -> ObjectMarker:
    right, up, out = face.T.astype(np.float64)
    half = box[3:]
    room_m = 2 * min(np.abs(right) @ half, np.abs(up) @ half)
    size_m = float(np.clip(room_m / (1 + 2 * _MARGIN), *_SIZES_M))
    centre_m = box[:3] + out * (half + _ABOVE_M)
    x, y, z, *q = pose_from_transform(transform(face.astype(np.float64), centre_m)).tolist()
    return ObjectMarker(id=number, size_m=round(size_m, 4), pose=(x, y, z, *q))


@dataclass(frozen=True)
class _Print:
    """One marker: its object, pose and side, and the brightness of its cells."""

    object_index: int
    T_object_marker: Float64[np.ndarray, "4 4"]
    size_m: float
    cells: Float64[np.ndarray, "n n"]


class Markers:
    """The markers of a task's objects, drawn into images that show the scene without them.

    `is_white` has the cells of every marker by its id, row by row from its upper left.
    """

    def __init__(
        self, objects: SceneObjects, is_white: Mapping[int, Bool[np.ndarray, "n n"]]
    ) -> None:
        (listed,) = objects.tasks.values()
        self._prints = [
            _Print(
                index,
                transform_from_pose(np.array(marker.pose)),
                marker.size_m,
                np.where(is_white[marker.id], _WHITE, _BLACK),
            )
            for index, one in enumerate(listed)
            for marker in one.markers
        ]

    def draw(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        range_m: Float64[np.ndarray, "h w"],
        K: Float64[np.ndarray, "3 3"],
        Ts_camera_object: Float64[np.ndarray, "objects 4 4"],
    ) -> None:
        """Draw the markers that the camera sees and nothing hides.

        Args:
            image: changed.
            range_m: distance from the camera to what each pixel shows, infinite for nothing.
            K: of the camera, in pixels.
            Ts_camera_object: poses of all objects.
        """
        for one in self._prints:
            T = Ts_camera_object[one.object_index] @ one.T_object_marker
            if T[:3, 2] @ T[:3, 3] < 0:
                _draw(one, image, range_m, K, T)


def _draw(
    one: _Print, image: np.ndarray, range_m: np.ndarray, K: np.ndarray, T_camera_marker: np.ndarray
) -> None:
    half_m = (0.5 + _MARGIN) * one.size_m
    corners = np.array([[x, y, 0.0] for x in (-half_m, half_m) for y in (-half_m, half_m)])
    pixels, in_front = project(K, corners @ T_camera_marker[:3, :3].T + T_camera_marker[:3, 3])
    size_px = np.array(image.shape[1::-1])
    low = np.floor(pixels.min(axis=0)).clip(0, size_px).astype(int)
    high = np.ceil(pixels.max(axis=0)).clip(0, size_px).astype(int)
    if not in_front.all() or (high <= low).any():
        return
    columns, rows = (np.arange(low[k] * _FINE, high[k] * _FINE) for k in (0, 1))
    u, v = np.meshgrid((columns + 0.5) / _FINE, (rows + 0.5) / _FINE)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    normal, centre_m = T_camera_marker[:3, 2], T_camera_marker[:3, 3]
    distance_m = (normal @ centre_m) / np.minimum(rays @ normal, -1e-9)
    x, y, _ = np.moveaxis(
        (rays * distance_m[..., None]) @ invert(T_camera_marker)[:3, :3].T
        + invert(T_camera_marker)[:3, 3],
        -1,
        0,
    )
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    nearest_m = range_m[window].repeat(_FINE, axis=0).repeat(_FINE, axis=1)
    shown = (np.abs(x) <= half_m) & (np.abs(y) <= half_m) & (distance_m < nearest_m)
    share, brightness = _averaged(shown, _brightness(one, x, y))
    part = image[window].astype(np.float64)
    mixed = part * (1 - share[..., None]) + 255.0 * brightness[..., None]
    image[window] = np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def _brightness(one: _Print, x: np.ndarray, y: np.ndarray) -> Float64[np.ndarray, "h w"]:
    num_cells = len(one.cells)
    column = np.floor((x / one.size_m + 0.5) * num_cells).astype(int)
    row = np.floor((0.5 - y / one.size_m) * num_cells).astype(int)
    inside = (column >= 0) & (column < num_cells) & (row >= 0) & (row < num_cells)
    last = num_cells - 1
    return np.where(inside, one.cells[row.clip(0, last), column.clip(0, last)], _WHITE)


def _averaged(
    shown: Bool[np.ndarray, "fine_h fine_w"], brightness: np.ndarray
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Share of each pixel that the marker covers, and its brightness times this share."""
    height, width = shown.shape[0] // _FINE, shown.shape[1] // _FINE
    blocks = (height, _FINE, width, _FINE)
    share = shown.reshape(blocks).mean(axis=(1, 3))
    return share, (shown * brightness).reshape(blocks).mean(axis=(1, 3))
