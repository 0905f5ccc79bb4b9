"""Addresses of object poses in MuJoCo's arrays: free, fixed, and jointed objects.

A free object is a child of the world with a free joint. Any other is attached to a mocap body, a
static child of the world: it is that body itself (a stand, a cabinet), or a descendant with hinge
or slide joints in between (a door, a drawer). Mocap poses are part of the physics state, so states
and snapshots contain the poses of fixed objects.
"""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert, pose_from_transform, transform_from_pose
from dextouch.geometry.rotations import vector_from_rotation

_FREE: Final = int(mujoco.mjtJoint.mjJNT_FREE)
_SINGLE: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
# Tolerance for contradictions between poses of a fixed object's parts (m, and entries of R).
_SAME_PLACE: Final = 1e-6


class ObjectBodies:
    """Access to poses and speeds of a task's objects in MuJoCo's arrays.

    Args:
        model: the compiled scene.
        names: body names of the objects, in the order of poses.

    Raises:
        InvalidInputError: a name without a body, or a body that is neither free nor attached to a
            mocap body by hinges and slides.
    """

    def __init__(self, model: mujoco.MjModel, names: tuple[str, ...]) -> None:
        self._model = model
        self._names = names
        self.ids: Int64[np.ndarray, " objects"] = np.array(
            [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in names],
            dtype=np.int64,
        )
        self._chains = chains = [self._chain(int(body)) for body in self.ids]
        self.is_free: Bool[np.ndarray, " objects"] = np.array(
            [self._is_free(*pair) for pair in zip(names, chains, strict=True)], dtype=bool
        )
        self.are_fixed: Bool[np.ndarray, " objects"] = np.array(
            [len(chain) == 1 and not free for chain, free in zip(chains, self.is_free, strict=True)]
        )
        free_joints = model.body_jntadr[self.ids[self.is_free]]
        self._free_qpos = model.jnt_qposadr[free_joints][:, None] + np.arange(7)
        self._speed_dofs = [self._dofs(chain) for chain in chains]
        self._mocap_rows = [int(model.body_mocapid[chain[-1]]) for chain in chains]
        self._Ts_root_object = self._rest_poses([chain[-1] for chain in chains])
        self.of_body = self._nearest_object()

    def _chain(self, body: int) -> list[int]:
        """A body and its ancestors up to the child of the world."""
        if body < 0:
            raise InvalidInputError(
                f"twin scene: got objects {self._names}, expected names of bodies"
            )
        chain = [body]
        while self._model.body_parentid[chain[-1]] != 0:
            chain.append(int(self._model.body_parentid[chain[-1]]))
        return chain

    def _joint_types(self, body: int) -> list[int]:
        first = self._model.body_jntadr[body]
        return [int(kind) for kind in self._model.jnt_type[first:][: self._model.body_jntnum[body]]]

    def _is_free(self, name: str, chain: list[int]) -> bool:
        if len(chain) == 1 and self._joint_types(chain[0]) == [_FREE]:
            return True
        kinds = [kind for body in chain for kind in self._joint_types(body)]
        if self._model.body_mocapid[chain[-1]] < 0 or not set(kinds) <= set(_SINGLE):
            raise InvalidInputError(
                f"twin scene: object {name!r} has joints of types {kinds} up to the world, "
                "expected a free joint below the world, or hinges and slides below a body of "
                'mocap="true"'
            )
        return False

    def _dofs(self, chain: list[int]) -> Int64[np.ndarray, " dofs"]:
        first = self._model.body_dofadr[chain]
        number = self._model.body_dofnum[chain]
        spans = [np.arange(a, a + n) for a, n in zip(first, number, strict=True)]
        return np.concatenate(spans).astype(np.int64)

    def _rest_poses(self, roots: list[int]) -> Float64[np.ndarray, "objects 4 4"]:
        """T_root_object with all joints at rest."""
        data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, data)
        pairs = zip(roots, self.ids.tolist(), strict=True)
        Ts = [invert(_body_pose(data, root)) @ _body_pose(data, body) for root, body in pairs]
        return np.array(Ts).reshape(-1, 4, 4)

    def _nearest_object(self) -> Int64[np.ndarray, " bodies"]:
        """Object index of each body: itself or its nearest named ancestor; -1 if none."""
        owner = np.full(self._model.nbody, -1, dtype=np.int64)
        owner[self.ids] = np.arange(len(self.ids))
        for body in range(1, self._model.nbody):  # parents come before their children
            if owner[body] < 0:
                owner[body] = owner[self._model.body_parentid[body]]
        return owner

    def place(self, data: mujoco.MjData, poses: Float64[np.ndarray, "objects 7"]) -> None:
        """Set the pose of every object; joints of fixed objects keep their rest position.

        Raises:
            InvalidInputError: contradictory poses of the parts of a fixed object.
        """
        data.qpos[self._free_qpos] = poses[self.is_free]
        placed: dict[int, np.ndarray] = {}
        for index in np.flatnonzero(~self.is_free):
            row = self._mocap_rows[index]
            T_root = transform_from_pose(poses[index]) @ invert(self._Ts_root_object[index])
            if row not in placed:
                placed[row] = T_root
                pose = pose_from_transform(T_root)
                data.mocap_pos[row], data.mocap_quat[row] = pose[:3], pose[3:]
            elif not np.allclose(T_root, placed[row], rtol=0.0, atol=_SAME_PLACE):
                raise InvalidInputError(
                    f"twin: got pose {poses[index].tolist()} for {self._names[index]!r}, expected "
                    "its pose on the object it is attached to, with joints at rest"
                )

    def poses(self, data: mujoco.MjData) -> Float64[np.ndarray, "objects 7"]:
        """T_world_object: x y z (m), qw qx qy qz; current also between MuJoCo's own updates."""
        poses = np.empty((len(self.ids), 7))
        poses[self.is_free] = data.qpos[self._free_qpos]
        if not self.is_free.all():
            mujoco.mj_kinematics(self._model, data)
            fixed = self.ids[~self.is_free]
            poses[~self.is_free, :3] = data.xpos[fixed]
            poses[~self.is_free, 3:] = data.xquat[fixed]
        return poses

    def restore(self, data: mujoco.MjData, poses: Float64[np.ndarray, "objects 7"]) -> None:
        """Set the pose of every object, with joints where they must be for it.

        Raises:
            InvalidInputError: an object on several joints, or on a body that is no object itself.
        """
        data.qpos[self._free_qpos] = poses[self.is_free]
        Ts = transform_from_pose(poses)
        roots: dict[int, np.ndarray] = {}
        for index in np.flatnonzero(~self.is_free):
            if len(self._chains[index]) == 1:
                row = self._mocap_rows[index]
                roots[row] = Ts[index]
                data.mocap_pos[row], data.mocap_quat[row] = poses[index, :3], poses[index, 3:]
        for index in np.flatnonzero(~self.is_free):
            chain, row = self._chains[index], self._mocap_rows[index]
            joints = [int(self._model.body_jntadr[b]) for b in chain if self._model.body_jntnum[b]]
            if len(chain) == 1 or (not joints and row in roots):
                continue
            if len(joints) != 1 or row not in roots:
                raise InvalidInputError(
                    f"twin: cannot restore object {self._names[index]!r} from its pose, expected "
                    "one joint to a body that is an object, too"
                )
            T_rest_now = invert(roots[row] @ self._Ts_root_object[index]) @ Ts[index]
            moved = vector_from_rotation(T_rest_now[:3, :3])
            if self._model.jnt_type[joints[0]] == int(mujoco.mjtJoint.mjJNT_SLIDE):
                moved = T_rest_now[:3, 3]
            data.qpos[self._model.jnt_qposadr[joints[0]]] = moved @ self._model.jnt_axis[joints[0]]

    def speeds(self, data: mujoco.MjData) -> Float64[np.ndarray, " objects"]:
        """Maximum speed component (m/s or rad/s) of a free body, or of the joints below it."""
        return np.array([np.abs(data.qvel[dofs]).max(initial=0.0) for dofs in self._speed_dofs])


def _body_pose(data: mujoco.MjData, body: int) -> Float64[np.ndarray, "4 4"]:
    return transform_from_pose(np.concatenate([data.xpos[body], data.xquat[body]]))


# Appearance of a scene: colours of geoms, light and table, fixed or varied from take to take.

TO_LIGHT: Final = np.array([0.30, -0.40, 0.85])
AMBIENT: Final = 0.35
BACKGROUND: Final = np.array([0.16, 0.17, 0.20])
CHECKER_DEPTH: Final = 0.14
# Two of three takes keep the colours of the task about; in the others, objects have any colour.
_ANY_COLOUR: Final = 0.33


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
        """Other colours of objects and table, another light.

        Args:
            generator: source of the variation.
            geom_object: object of each geom, −1 for none.
            table: geom of the table.
        """
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
