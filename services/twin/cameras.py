"""Deterministic cameras by ray casting, and printed markers in their images, without GPU."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from dextouch.geometry import (
    invert,
    pinhole_matrix,
    pose_from_transform,
    project,
    transform,
    transform_from_pose,
)
from dextouch.schemas import MarkerDictionary, ObjectMarker, SceneObject, SceneObjects
from services.twin.names import CAMERAS
from services.twin.scene import Scene
from services.twin.simulation import Simulation

FOVY_RAD: Final = {
    "camera_head": math.radians(46.0),
    "camera_wrist_left": math.radians(80.0),
    "camera_wrist_right": math.radians(80.0),
}
_CHECKER_M: Final = 0.08  # chosen: motion of the camera shows on the table's fields
_FAR_M: Final = 4.0  # chosen: farther than anything on the table
# Rays that descend less than this from a camera 4 mm above a plane do not meet it within _FAR_M.
_LEVEL: Final = 1e-3
# Corners of boxes nearer to the plane of the camera have no useful projection.
_NEAR_M: Final = 1e-3
# Geoms of group 4 (the sensing skin) are invisible.
_VISIBLE_GROUPS: Final = np.array([1, 1, 1, 1, 0, 0], dtype=np.uint8)
TO_LIGHT: Final = np.array([0.30, -0.40, 0.85])
AMBIENT: Final = 0.35
BACKGROUND: Final = np.array([0.16, 0.17, 0.20])
CHECKER_DEPTH: Final = 0.14
# Two of three takes keep the colours of the task about; in the others, objects have any colour.
_ANY_COLOUR: Final = 0.33
# Printed markers, as a lab would glue them on objects: one on each side of a bounding box. They
# touch nothing: hands pass through them.
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


def look_at(eye_m: np.ndarray, target_m: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """T_world_camera of an optical frame at `eye_m` looking at `target_m`, world z upwards."""
    forward = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return transform(np.stack([right, np.cross(forward, right), forward], axis=1), eye_m)


HEAD_HOME: Final = look_at(np.array([0.0, -0.52, 0.55]), np.array([0.0, 0.03, 0.05]))


def _wrist_mount(palm_sign: float) -> Float64[np.ndarray, "4 4"]:
    """T_wrist_camera: behind the wrist on the palm side, looking along the fingers."""
    tilt = 0.20
    down = np.array([0.0, palm_sign * math.cos(tilt), math.sin(tilt)])
    forward = np.array([0.0, palm_sign * math.sin(tilt), -math.cos(tilt)])
    R = np.stack([np.cross(down, forward), down, forward], axis=1)
    return transform(R, np.array([0.0, palm_sign * 0.045, 0.075]))


@dataclass(frozen=True)
class Appearance:
    """What a scene looks like besides its geometry.

    `colours` are RGB 0 … 1 of every geom, `ambient` the share of light from everywhere,
    `checker_depth` how much darker every second field of the table is.
    """

    colours: Float64[np.ndarray, "geoms 3"]
    to_light: Float64[np.ndarray, "3"]
    background: Float64[np.ndarray, "3"]
    ambient: float = AMBIENT
    checker_depth: float = CHECKER_DEPTH

    @classmethod
    def of(cls, colours: Float64[np.ndarray, "geoms 3"]) -> "Appearance":
        """The fixed appearance of geoms with their own colours."""
        return cls(colours, TO_LIGHT / np.linalg.norm(TO_LIGHT), BACKGROUND)

    def varied(
        self, generator: np.random.Generator, geom_object: np.ndarray, table: int
    ) -> "Appearance":
        """Other colours of objects (`geom_object`: one a geom, −1 for none), table, light."""
        colours = self.colours.copy()
        for index in range(int(geom_object.max()) + 1):
            own = geom_object == index
            tint = generator.normal(scale=0.10, size=3)
            if generator.random() < _ANY_COLOUR:
                tint = generator.uniform(0.1, 0.95, size=3) - colours[own].mean(axis=0)
            colours[own] += tint
        hands = geom_object < 0
        hands[table] = False
        colours[hands] *= generator.uniform(0.8, 1.2)
        colours[table] += generator.normal(scale=0.08) + generator.normal(scale=0.04, size=3)
        light = TO_LIGHT + generator.normal(scale=[0.25, 0.25, 0.1])
        return Appearance(
            colours.clip(0.02, 1.0),
            light / np.linalg.norm(light),
            (BACKGROUND + generator.normal(scale=0.05)).clip(0, 1),
            ambient=float(generator.uniform(0.25, 0.5)),
            checker_depth=float(generator.uniform(0.0, 0.25)),
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
    """Markers of a task's objects to draw into images; `is_white` has the cells of each by id."""

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
        """Draw the markers that the camera (K in pixels) sees and nothing hides, into `image`.

        `range_m` is the distance to what each pixel shows, infinite for nothing.
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
    is_visible = (np.abs(x) <= half_m) & (np.abs(y) <= half_m) & (distance_m < nearest_m)
    share, brightness = _averaged(is_visible, _brightness(one, x, y))
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
    is_visible: Bool[np.ndarray, "fine_h fine_w"], brightness: np.ndarray
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Share of each pixel that the marker covers, and its brightness times this share."""
    height, width = is_visible.shape[0] // _FINE, is_visible.shape[1] // _FINE
    blocks = (height, _FINE, width, _FINE)
    share = is_visible.reshape(blocks).mean(axis=(1, 3))
    return share, (is_visible * brightness).reshape(blocks).mean(axis=(1, 3))


class CameraRig:
    """The three cameras of a scene; rays are computed once and rotated with the camera."""

    def __init__(self, scene: Scene, *, height_px: int, width_px: int) -> None:
        self._model = scene.model
        self.shape_px = (height_px, width_px)
        own_colours = np.array(scene.model.geom_rgba[:, :3], dtype=np.float64)
        self.own_appearance = self.appearance = Appearance.of(own_colours)
        self._table = scene.model.geom("table").id
        self._bodies = _visible_besides(scene.model, self._table)
        self._corners_m = _corners_m(scene.model, self._bodies)
        self.markers: Markers | None = None
        self.mounts = [_wrist_mount(hand.palm_sign) for hand in scene.hands]
        self.K = {
            name: pinhole_matrix(width_px=width_px, height_px=height_px, fovy_rad=FOVY_RAD[name])
            for name in CAMERAS
        }
        # Unit rays of each camera's pixel centres, row by row, in its optical frame.
        self.rays = {name: self._ray_table(self.K[name]) for name in CAMERAS}

    def _ray_table(self, K: np.ndarray) -> Float64[np.ndarray, "rays 3"]:
        height, width = self.shape_px
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(height * width)], axis=1)
        rays = pixels @ np.linalg.inv(K).T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def pose(self, simulation: Simulation, camera: str) -> Float64[np.ndarray, "4 4"]:
        """T_world_camera (optical frame) of one camera now."""
        if camera == "camera_head":
            return transform_from_pose(simulation.head_pose())
        side_index = CAMERAS.index(camera) - 1
        return transform_from_pose(simulation.wrist_poses()[side_index]) @ self.mounts[side_index]

    def image(self, simulation: Simulation, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """Render one camera; derived quantities of the simulation must be current."""
        view = self._cast(simulation, camera)
        image = self._shaded(view).reshape(*self.shape_px, 3)
        if self.markers is not None:
            Ts_camera_object = invert(self.pose(simulation, camera)) @ transform_from_pose(
                simulation.object_poses()
            )
            self.markers.draw(
                image, view.distances_m.reshape(self.shape_px), self.K[camera], Ts_camera_object
            )
        return image

    def cast(
        self, simulation: Simulation, camera: str
    ) -> tuple[Int64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Geom that each pixel shows, -1 for none, and its depth along the optical axis (m)."""
        view = self._cast(simulation, camera)
        depth_m = view.distances_m * self.rays[camera][:, 2]
        return view.geoms.reshape(self.shape_px), depth_m.reshape(self.shape_px)

    def _cast(self, simulation: Simulation, camera: str) -> "_View":
        """What each ray of a camera meets; MuJoCo casts those near other geoms than the table."""
        T_world_camera = self.pose(simulation, camera)
        rays = np.ascontiguousarray(self.rays[camera] @ T_world_camera[:3, :3].T)
        eye_m = np.ascontiguousarray(T_world_camera[:3, 3])
        is_near = np.zeros(self.shape_px, dtype=bool)
        for box in self._boxes_px(simulation, camera, T_world_camera):
            is_near[box] = True
        distances_m, may_meet_side = self._table_top(simulation, eye_m, rays)
        cast = np.flatnonzero(is_near.ravel() | may_meet_side)
        geoms = np.where(distances_m < np.inf, self._table, -1)
        view = _View(eye_m, rays, geoms, distances_m, cast, np.empty((len(cast), 3)))
        if len(cast):
            self._cast_some(simulation, view)
        return view

    def _table_top(
        self, simulation: Simulation, eye_m: np.ndarray, rays: np.ndarray
    ) -> tuple[Float64[np.ndarray, " rays"], Bool[np.ndarray, " rays"]]:
        """Distance (m) to the top of the table, infinite for none; and rays that may meet a side.

        A ray from above meets the top where it crosses its plane within the table. It can meet a
        side only if the eye and this crossing are both beyond that side.
        """
        eye_m = eye_m - simulation.data.geom_xpos[self._table]
        half_m = self._model.geom_size[self._table]
        if eye_m[2] - half_m[2] <= _LEVEL * _FAR_M:
            return np.full(len(rays), np.inf), np.ones(len(rays), dtype=bool)
        down = np.minimum(rays[:, 2], -_LEVEL)
        distances_m = (half_m[2] - eye_m[2]) / down
        is_on_top, may_meet_side = distances_m <= _FAR_M, np.zeros(len(rays), dtype=bool)
        for axis in (0, 1):
            crossing_m = distances_m * rays[:, axis] + eye_m[axis]
            is_on_top &= np.abs(crossing_m) <= half_m[axis]
            if abs(eye_m[axis]) > half_m[axis]:
                may_meet_side |= crossing_m * np.sign(eye_m[axis]) > half_m[axis]
        distances_m[~is_on_top] = np.inf
        return distances_m, may_meet_side

    def _boxes_px(
        self, simulation: Simulation, camera: str, T_world_camera: np.ndarray
    ) -> list[tuple[slice, slice]]:
        """Rows and columns of the image that contain each geom's bounding box."""
        data, corners_m = simulation.data, self._corners_m
        Rs = data.geom_xmat[self._bodies].reshape(-1, 3, 3)
        corners_m = corners_m @ Rs.transpose(0, 2, 1) + data.geom_xpos[self._bodies, None]
        corners_m = (corners_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        depths_m = corners_m[..., 2]
        is_before = depths_m > _NEAR_M
        pixels = corners_m @ self.K[camera].T / np.where(is_before, depths_m, 1.0)[..., None]
        first = np.floor(pixels[..., 1::-1].min(axis=1)).clip(0, self.shape_px)
        last = np.ceil(pixels[..., 1::-1].max(axis=1)).clip(0, self.shape_px)
        # A box that reaches behind the camera may be anywhere.
        first[~is_before.all(axis=1)] = 0
        last[~is_before.all(axis=1)] = self.shape_px
        last[~is_before.any(axis=1)] = 0
        bounds = np.stack([first, last], axis=2).astype(int)
        return [(slice(*rows), slice(*columns)) for rows, columns in bounds]

    def _cast_some(self, simulation: Simulation, view: "_View") -> None:
        """Cast the rays `view.cast` through the whole scene, and note what they meet."""
        geoms = np.empty(len(view.cast), dtype=np.int32)
        distances_m, normals = np.empty(len(view.cast)), np.empty(3 * len(view.cast))
        mujoco.mj_multiRay(
            self._model,
            simulation.data,
            view.eye_m,
            view.rays[view.cast].ravel(),
            _VISIBLE_GROUPS,
            1,
            -1,
            geoms,
            distances_m,
            normals,
            len(geoms),
            _FAR_M,
        )
        view.geoms[view.cast] = geoms
        view.distances_m[view.cast] = np.where(geoms >= 0, distances_m, np.inf)
        view.normals[:] = normals.reshape(-1, 3)

    def _shaded(self, view: "_View") -> UInt8[np.ndarray, "rays 3"]:
        """Colours of all rays: few for the table and the background, one by one for the rest."""
        look = self.appearance
        light = look.ambient + (1 - look.ambient) * np.clip(look.to_light[2], 0.0, 1.0)
        table = look.colours[self._table]
        dark = table * (light * (1 - look.checker_depth))
        palette = _bytes(np.stack([table * light, dark, look.background]))
        index = np.full(len(view.geoms), 2)
        on_table = np.flatnonzero(view.geoms == self._table)
        index[on_table] = self._is_dark(view, on_table)
        image = palette[index]
        hit = view.geoms[view.cast] >= 0
        near = view.cast[hit]
        towards = np.clip(view.normals[hit] @ look.to_light, 0.0, 1.0)
        brightness = look.ambient + (1 - look.ambient) * towards
        brightness[index[near] == 1] *= 1 - look.checker_depth
        image[near] = _bytes(look.colours[view.geoms[near]] * brightness[:, None])
        return image

    def _is_dark(self, view: "_View", rays: np.ndarray) -> Bool[np.ndarray, " rays"]:
        num_fields = np.zeros(len(rays), dtype=np.int64)
        for axis in (0, 1):
            met_m = view.eye_m[axis] + view.rays[rays, axis] * view.distances_m[rays]
            num_fields += np.floor(met_m / _CHECKER_M).astype(np.int64)
        return num_fields % 2 == 1


@dataclass(frozen=True)
class _View:
    """What the rays of a camera meet: geom (−1 for none) and distance (m, infinite for none).

    `rays` are unit vectors in the world, `cast` those that MuJoCo cast, with `normals` where they
    meet something. All others meet the top of the table or nothing.
    """

    eye_m: Float64[np.ndarray, "3"]
    rays: Float64[np.ndarray, "rays 3"]
    geoms: Int64[np.ndarray, " rays"]
    distances_m: Float64[np.ndarray, " rays"]
    cast: Int64[np.ndarray, " cast"]
    normals: Float64[np.ndarray, "cast 3"]


def _visible_besides(model: mujoco.MjModel, table: int) -> Int64[np.ndarray, " geoms"]:
    is_visible = _VISIBLE_GROUPS[model.geom_group] == 1
    is_visible[table] = False
    return np.flatnonzero(is_visible)


def _corners_m(model: mujoco.MjModel, geoms: np.ndarray) -> Float64[np.ndarray, "geoms 8 3"]:
    """Corners of the bounding boxes of geoms, in their own frames."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    centres_m, halves_m = model.geom_aabb[geoms, None, :3], model.geom_aabb[geoms, None, 3:]
    corners: np.ndarray = centres_m + signs * halves_m
    return corners


def _bytes(rgb: np.ndarray) -> UInt8[np.ndarray, "colours 3"]:
    return (np.clip(rgb, 0.0, 1.0) * 255).round().astype(np.uint8)
