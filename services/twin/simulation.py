"""Running simulation of a scene: commands on the model grid, physics, contacts and poses.

Touch: the depths of MuJoCo's tactile sensor are the *pattern*, the forces of the contact solver
on each pad the *magnitude* of the pressures of an elastic layer. If no taxel of a pressed pad has
a depth, the force goes to the taxel nearest to each contact.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.geometry import interpolate_poses, pose_from_transform, transform_from_pose
from dextouch.tactile.layout import DEXTOUCH_V1, FINGERS, NUM_TAXELS, SIDES
from services.twin.scene import PHYSICS_RATE_HZ, Scene

MODEL_RATE_HZ = 15  # as in the paper
STEPS_PER_GRID = PHYSICS_RATE_HZ // MODEL_RATE_HZ
STEPS_PER_TACTILE = PHYSICS_RATE_HZ // 60
# Commands are interpolated between grid steps and held for this many physics steps.
STEPS_PER_COMMAND = 5
STATE_KIND = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
# A contact farther than this from every taxel is on the back of the hand and not sensed.
FELT_WITHIN_M = 0.008
# Elastic layer, fitted to an analytic one of 20 kPa/mm (tests/accuracy/test_twin_tactile.py).
SKIN_STIFFNESS_PA_M = 1.4e7
# Sensor depths include the skin's offset and the compliance of the contact. At most this much is
# subtracted: a flat face needs some depth to cover the sensor's errors at its edges.
MAX_RELIEF_M = 0.002
_MIN_FORCE_N = 1e-6
_MIN_DEPTH_M = 1e-9
_PASCAL_PER_KPA = 1000.0


@dataclass(frozen=True)
class Command:
    """Commanded poses of left wrist, right wrist and head camera, and joint angles."""

    Ts_world_x: Float64[np.ndarray, "3 4 4"]
    joints_rad: Float64[np.ndarray, "2 20"]


class Simulation:
    """Simulation of a scene. `step_index` counts physics steps since the start of the take."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.data = mujoco.MjData(scene.model)
        self.step_index = 0
        self.tactile_kpa: Float32[np.ndarray, "2 320"] = np.zeros((2, 320), dtype=np.float32)
        self.pad_forces_n: Float64[np.ndarray, "2 6"] = np.zeros((2, 6))
        self._skin = TactileReader(scene)
        self._bodies = scene.bodies
        scene.model.opt.disableflags |= _NO_SENSORS

    def place(
        self, command: Command, object_poses: Float64[np.ndarray, "objects 7"], *, settle_s: float
    ) -> None:
        """Set hands, exactly at the command, and objects, let these settle, restart at step 0."""
        mujoco.mj_resetData(self.scene.model, self.data)
        self._apply(pose_from_transform(command.Ts_world_x), command.joints_rad)
        self._bodies.place(self.data, object_poses)
        self._place_hands(command)
        for _ in range(round(settle_s * PHYSICS_RATE_HZ)):
            mujoco.mj_step(self.scene.model, self.data)
        self._place_hands(command)
        self.step_index = 0
        self._sense()

    def pose(self, command: Command, object_poses: Float64[np.ndarray, "objects 7"]) -> None:
        """Set hands, head camera and objects to given poses, without physics, for rendering."""
        self._apply(pose_from_transform(command.Ts_world_x), command.joints_rad)
        self._place_hands(command)
        self._bodies.restore(self.data, object_poses)
        mujoco.mj_kinematics(self.scene.model, self.data)

    def _place_hands(self, command: Command) -> None:
        self.data.qpos[self.scene.wrist_qpos] = pose_from_transform(command.Ts_world_x[:2])
        self.data.qpos[self.scene.joint_qpos] = command.joints_rad

    def _apply(
        self, poses: Float64[np.ndarray, "3 7"], joints_rad: Float64[np.ndarray, "2 20"]
    ) -> None:
        self.data.mocap_pos[self.scene.mocap_rows] = poses[:, :3]
        self.data.mocap_quat[self.scene.mocap_rows] = poses[:, 3:]
        self.data.ctrl[self.scene.joint_ctrl] = joints_rad

    def advance(self, target: Command) -> Iterator[int]:
        """Simulate one grid interval, moving the command linearly to `target`.

        Yields the index of every physics step; only poses are current at each, all else at steps
        divisible by STEPS_PER_TACTILE. Raises InvalidInputError if the physics diverged.
        """
        poses, joints_rad = self._interpolated(target)
        for pose, joints in zip(poses, joints_rad, strict=True):
            self._apply(pose, joints)
            for _ in range(STEPS_PER_COMMAND):
                mujoco.mj_step(self.scene.model, self.data)
                self.step_index += 1
                if self.step_index % STEPS_PER_TACTILE == 0:
                    self._sense()
                yield self.step_index
        if not np.isfinite(self.data.qpos).all():
            raise InvalidInputError(
                f"twin: physics diverged before step {self.step_index}; expected finite poses; "
                "send commands closer to each other"
            )

    def _interpolated(
        self, target: Command
    ) -> tuple[Float64[np.ndarray, "parts 3 7"], Float64[np.ndarray, "parts 2 20"]]:
        parts = STEPS_PER_GRID // STEPS_PER_COMMAND
        weight = np.arange(1, parts + 1) / parts
        before = transform_from_pose(self.commanded_poses())
        # All three bodies in one call: start and end poses concatenated.
        ends = np.stack([before, target.Ts_world_x], axis=1).reshape(-1, 4, 4)
        left = np.repeat(np.arange(0, len(ends), 2), parts)
        Ts = interpolate_poses(ends, left, np.tile(weight, len(before)))
        joints_before = self.commanded_joints_rad()
        joints = joints_before + weight[:, None, None] * (target.joints_rad - joints_before)
        return pose_from_transform(Ts.reshape(-1, parts, 4, 4).swapaxes(0, 1)), joints

    def _sense(self) -> None:
        option = self.scene.model.opt
        option.disableflags &= ~_NO_SENSORS
        mujoco.mj_forward(self.scene.model, self.data)
        option.disableflags |= _NO_SENSORS
        self.tactile_kpa, self.pad_forces_n = self._skin.read(self.data)

    def wrist_poses(self) -> Float64[np.ndarray, "2 7"]:
        """Measured T_world_wrist of both hands: x y z (m), qw qx qy qz."""
        return np.array(self.data.qpos[self.scene.wrist_qpos])

    def joints_rad(self) -> Float64[np.ndarray, "2 20"]:
        """Measured joint angles of both hands."""
        return np.array(self.data.qpos[self.scene.joint_qpos])

    def head_pose(self) -> Float64[np.ndarray, "7"]:
        """T_world_camera_head (optical frame): x y z (m), qw qx qy qz."""
        return np.array(self.commanded_poses()[2])

    def commanded_poses(self) -> Float64[np.ndarray, "3 7"]:
        """Commanded poses of left wrist, right wrist and head camera."""
        rows = self.scene.mocap_rows
        return np.concatenate([self.data.mocap_pos[rows], self.data.mocap_quat[rows]], axis=1)

    def commanded_joints_rad(self) -> Float64[np.ndarray, "2 20"]:
        """Commanded joint angles of both hands."""
        return np.array(self.data.ctrl[self.scene.joint_ctrl])

    def object_poses(self) -> Float64[np.ndarray, "objects 7"]:
        """T_world_object of the task's objects: x y z (m), qw qx qy qz."""
        return self._bodies.poses(self.data)

    def object_speeds(self) -> Float64[np.ndarray, " objects"]:
        """Largest linear (m/s) or angular (rad/s) speed component of each object or its joint."""
        return self._bodies.speeds(self.data)

    def hand_contacts(self) -> Bool[np.ndarray, "2 objects"]:
        """Whether each hand (left, right) touches each of the task's objects."""
        scene = self.scene
        geoms = self.data.contact.geom[: self.data.ncon]
        touching = np.zeros((2, len(scene.object_names)), dtype=bool)
        for one, other in (geoms.T, geoms.T[::-1]):
            hand, thing = scene.geom_hand[one], scene.geom_object[other]
            met = (hand >= 0) & (thing >= 0)
            touching[hand[met], thing[met]] = True
        return touching

    def hand_contacts_m(self, object_index: int) -> Float64[np.ndarray, "contacts 3"]:
        """World positions of the contacts between the hands and one of the task's objects."""
        geoms = self.data.contact.geom[: self.data.ncon]
        with_hand = (self.scene.geom_hand[geoms] >= 0).any(axis=1)
        with_object = (self.scene.geom_object[geoms] == object_index).any(axis=1)
        return np.array(self.data.contact.pos[: self.data.ncon][with_hand & with_object])

    def hand_touches(self, objects: int | slice = slice(None)) -> bool:
        """Whether any part of a hand is in contact with one object, or with any."""
        return bool(self.hand_contacts()[:, objects].any())

    def touches_table(self, object_index: int) -> bool:
        """Whether an object is in contact with the table top (fixed things never are)."""
        geoms = self.data.contact.geom[: self.data.ncon]
        on_table = (geoms == self.scene.table_geom).any(axis=1)
        return bool((on_table & (self.scene.geom_object[geoms] == object_index).any(axis=1)).any())

    def objects_touch(self, first_index: int, second_index: int) -> bool:
        """Whether two of the task's objects are in contact with each other."""
        pairs = np.sort(self.scene.geom_object[self.data.contact.geom[: self.data.ncon]], axis=1)
        return bool((pairs == sorted((first_index, second_index))).all(axis=1).any())

    @property
    def state_size(self) -> int:
        """Length of a state vector."""
        return mujoco.mj_stateSize(self.scene.model, STATE_KIND)

    def state(self) -> Float64[np.ndarray, " numbers"]:
        """Full state for continuing the simulation, including commands."""
        state = np.empty(self.state_size)
        mujoco.mj_getState(self.scene.model, self.data, state, STATE_KIND)
        return state

    def set_state(self, state: np.ndarray, *, step_index: int) -> None:
        """Restore a state of `state`, `step_index` physics steps after the start."""
        if state.shape != (self.state_size,):
            raise InvalidInputError(
                f"twin state: got shape {state.shape}, expected ({self.state_size},)"
            )
        mujoco.mj_setState(self.scene.model, self.data, state, STATE_KIND)
        self.step_index = step_index


@dataclass(frozen=True)
class _Pad:
    side_index: int
    pad_index: int
    taxels: slice
    depths: slice
    skin_geom: int
    vertices_m: np.ndarray


class TactileReader:
    """Tactile sensors of both hands of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._model = scene.model
        self._areas_m2 = DEXTOUCH_V1.areas_m2
        self._pads: list[_Pad] = []
        self._pad_of_geom = np.full(scene.model.ngeom, -1, dtype=np.int64)
        for side_index, side in enumerate(SIDES):
            first_taxel = 0
            for pad_index, pad in enumerate((*FINGERS, "palm")):
                added = self._add_pad(f"{side}_{pad}", (side_index, pad_index), first_taxel)
                felt = f"{side}_palm" if pad == "palm" else f"{side}_{pad}_link3"
                self._pad_of_geom[scene.model.geom(felt).id] = len(self._pads) - 1
                first_taxel = added.taxels.stop

    def _add_pad(self, name: str, index: tuple[int, int], first_taxel: int) -> _Pad:
        model = self._model
        skin = model.geom(f"{name}_skin").id
        mesh = int(model.geom_dataid[skin])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        address = int(model.sensor_adr[model.sensor(name).id])
        pad = _Pad(
            *index,
            slice(first_taxel, first_taxel + count),
            slice(address, address + count),
            int(skin),
            np.array(model.mesh_vert[first : first + count], dtype=np.float64),
        )
        self._pads.append(pad)
        return pad

    @staticmethod
    def _skin_world_m(data: mujoco.MjData, pad: _Pad) -> Float64[np.ndarray, "taxels 3"]:
        R_world_skin = data.geom_xmat[pad.skin_geom].reshape(3, 3)
        return pad.vertices_m @ R_world_skin.T + data.geom_xpos[pad.skin_geom]

    def read(
        self, data: mujoco.MjData
    ) -> tuple[Float32[np.ndarray, "2 320"], Float64[np.ndarray, "2 6"]]:
        """Pressures (kPa) and pad forces (N: tips, palm), left, right, after `mj_forward`."""
        forces_n = np.zeros((len(SIDES), NUM_TAXELS))
        pad_forces_n = np.zeros((len(SIDES), len(FINGERS) + 1))
        pressed = self._pad_of_geom[data.contact.geom[: data.ncon]].max(axis=1)
        for index in np.unique(pressed[pressed >= 0]):
            pad = self._pads[index]
            spread = self._spread(data, pad, np.flatnonzero(pressed == index))
            forces_n[pad.side_index, pad.taxels] = spread
            pad_forces_n[pad.side_index, pad.pad_index] = spread.sum()
        pressures = forces_n / self._areas_m2 / _PASCAL_PER_KPA
        return pressures.astype(np.float32), pad_forces_n

    def _spread(
        self, data: mujoco.MjData, pad: _Pad, contacts: Int64[np.ndarray, " contacts"]
    ) -> Float64[np.ndarray, " taxels"]:
        offsets = self._skin_world_m(data, pad)[None] - data.contact.pos[contacts][:, None]
        distances = np.linalg.norm(offsets, axis=2)
        nearest = distances.argmin(axis=1)
        wrench = np.zeros(6)
        on_nearest_n = np.zeros(len(pad.vertices_m))
        for contact_index, taxel, row in zip(contacts.tolist(), nearest, distances, strict=True):
            if row[taxel] <= FELT_WITHIN_M:
                mujoco.mj_contactForce(self._model, data, contact_index, wrench)
                on_nearest_n[taxel] += wrench[0]
        force_n = float(on_nearest_n.sum())
        if force_n < _MIN_FORCE_N:
            return np.zeros_like(on_nearest_n)
        depths = np.maximum(data.sensordata[pad.depths], 0.0)
        if depths.max() < _MIN_DEPTH_M:
            return on_nearest_n
        return elastic_layer(
            depths, force_n, SKIN_STIFFNESS_PA_M * self._areas_m2[pad.taxels.start]
        )


def elastic_layer(
    depths_m: Float64[np.ndarray, " taxels"], force_n: float, stiffness_n_m: float
) -> Float64[np.ndarray, " taxels"]:
    """Forces, of sum F, of an elastic layer at depths that are known up to a common offset c.

    Solves Σ k max(0, depth - c) = F over the touched taxels, c at most MAX_RELIEF_M; depths are 0
    or more, one of them positive, k is the stiffness of one taxel.
    """
    touched = depths_m > 0.0
    deepest_first = np.sort(depths_m[touched])[::-1]
    num_pressed = np.arange(1, deepest_first.size + 1)
    reliefs_m = (np.cumsum(deepest_first) - force_n / stiffness_n_m) / num_pressed
    relief_m = min(reliefs_m[np.flatnonzero(reliefs_m < deepest_first)[-1]], MAX_RELIEF_M)
    springs = np.where(touched, np.maximum(depths_m - relief_m, 0.0), 0.0)
    return springs * (force_n / springs.sum())
