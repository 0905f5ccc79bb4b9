"""Camera rendering by ray casting, deterministic and without GPU or OpenGL.

Flat object colours with Lambert shading by one light, and a chequered table that makes motion
visible. Equal states give equal bytes.
"""

import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from dextouch.geometry import invert, pinhole_matrix, transform, transform_from_pose
from services.twin.markers import Markers
from services.twin.names import CAMERAS
from services.twin.scene import Scene
from services.twin.simulation import Simulation

FOVY_RAD: Final = {
    "camera_head": math.radians(46.0),
    "camera_wrist_left": math.radians(80.0),
    "camera_wrist_right": math.radians(80.0),
}
_CHECKER_M: Final = 0.08
_FAR_M: Final = 4.0
# Geoms of group 4 (the sensing skin) are invisible.
_VISIBLE_GROUPS: Final = np.array([1, 1, 1, 1, 0, 0], dtype=np.uint8)
TO_LIGHT: Final = np.array([0.30, -0.40, 0.85])
AMBIENT: Final = 0.35
BACKGROUND: Final = np.array([0.16, 0.17, 0.20])
CHECKER_DEPTH: Final = 0.14
# Two of three takes keep the colours of the task about; in the others, objects have any colour.
_ANY_COLOUR: Final = 0.33


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

    `colours` are RGB 0 … 1 of every geom, `to_light` the direction to the light, `ambient` the
    share of light from everywhere, `checker_depth` how much darker every second field of the table
    is.
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


class CameraRig:
    """The three cameras of a scene; rays are computed once and rotated with the camera.

    `appearance` is what the scene looks like, `markers` those that are glued to its objects.
    """

    def __init__(self, scene: Scene, *, height_px: int, width_px: int) -> None:
        self._model = scene.model
        self.shape_px = (height_px, width_px)
        own_colours = np.array(scene.model.geom_rgba[:, :3], dtype=np.float64)
        self.own_appearance = self.appearance = Appearance.of(own_colours)
        self._table = scene.model.geom("table").id
        self.markers: Markers | None = None
        self.mounts = [_wrist_mount(hand.palm_sign) for hand in scene.hands]
        self.K = {
            name: pinhole_matrix(width_px=width_px, height_px=height_px, fovy_rad=FOVY_RAD[name])
            for name in CAMERAS
        }
        self._rays = {name: self._ray_table(self.K[name]) for name in CAMERAS}
        num_rays = height_px * width_px
        self._geom_ids = np.empty(num_rays, dtype=np.int32)
        self._distances = np.empty(num_rays)
        self._normals = np.empty(3 * num_rays)

    def _ray_table(self, K: np.ndarray) -> Float64[np.ndarray, "rays 3"]:
        """Unit rays of all pixel centres, row by row, in the optical frame."""
        height, width = self.shape_px
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(height * width)], axis=1)
        rays = pixels @ np.linalg.inv(K).T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def rays(self, camera: str) -> Float64[np.ndarray, "rays 3"]:
        """Unit rays of a camera's pixel centres, row by row, in its optical frame."""
        return self._rays[camera]

    def pose(self, simulation: Simulation, camera: str) -> Float64[np.ndarray, "4 4"]:
        """T_world_camera (optical frame) of one camera now."""
        if camera == "camera_head":
            return transform_from_pose(simulation.head_pose())
        side_index = CAMERAS.index(camera) - 1
        return transform_from_pose(simulation.wrist_poses()[side_index]) @ self.mounts[side_index]

    def image(self, simulation: Simulation, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """Render one camera; derived quantities of the simulation must be current."""
        eye_m, rays_world = self._cast(simulation, camera)
        image = self._shaded(eye_m, rays_world).reshape(*self.shape_px, 3)
        if self.markers is not None:
            range_m = np.where(self._geom_ids >= 0, self._distances, np.inf)
            Ts_camera_object = invert(self.pose(simulation, camera)) @ transform_from_pose(
                simulation.object_poses()
            )
            self.markers.draw(
                image, range_m.reshape(self.shape_px), self.K[camera], Ts_camera_object
            )
        return image

    def cast(
        self, simulation: Simulation, camera: str
    ) -> tuple[Int64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Geom that each pixel shows, -1 for none, and its depth along the optical axis (m)."""
        self._cast(simulation, camera)
        hit = self._geom_ids >= 0
        depth_m = np.where(hit, self._distances * self._rays[camera][:, 2], np.inf)
        shape = self.shape_px
        return self._geom_ids.astype(np.int64).reshape(shape), depth_m.reshape(shape)

    def _cast(
        self, simulation: Simulation, camera: str
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "rays 3"]]:
        """Cast the rays of a camera; returns its position and the rays in the world."""
        T_world_camera = self.pose(simulation, camera)
        rays_world = np.ascontiguousarray(self._rays[camera] @ T_world_camera[:3, :3].T)
        eye_m = np.ascontiguousarray(T_world_camera[:3, 3])
        mujoco.mj_multiRay(
            self._model,
            simulation.data,
            eye_m,
            rays_world.ravel(),
            _VISIBLE_GROUPS,
            1,
            -1,
            self._geom_ids,
            self._distances,
            self._normals,
            len(rays_world),
            _FAR_M,
        )
        return eye_m, rays_world

    def _shaded(self, eye_m: np.ndarray, rays_world: np.ndarray) -> UInt8[np.ndarray, "rays 3"]:
        hit = self._geom_ids >= 0
        look = self.appearance
        light = self._normals.reshape(-1, 3) @ look.to_light
        brightness = look.ambient + (1 - look.ambient) * np.clip(light, 0.0, 1.0)
        on_table = self._geom_ids == self._table
        points = eye_m[:2] + rays_world[on_table, :2] * self._distances[on_table, None]
        cells = np.floor(points / _CHECKER_M).sum(axis=1) % 2
        brightness[on_table] *= 1 - look.checker_depth * cells
        rgb = np.where(
            hit[:, None], look.colours[self._geom_ids] * brightness[:, None], look.background
        )
        return (np.clip(rgb, 0.0, 1.0) * 255).round().astype(np.uint8)
