"""MuJoCo model of a scene: its MJCF, addresses of hands and objects, sizes of objects.

An object is free, a child of the world with a free joint, or fixed: a mocap body (a stand, a
cabinet), or a part of one on hinges or slides (a door, a drawer). Mocap poses are part of the
physics state, and so of snapshots.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import mujoco
import numpy as np
import structlog
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.geometry import apply, invert, pose_from_transform, transform, transform_from_pose
from dextouch.geometry.rotations import vector_from_rotation
from dextouch.tactile.layout import FINGERS, SIDES
from services.twin.hands import PALM_THICKNESS_M, TwinHand, twin_hand
from services.twin.names import Domain

logger = structlog.get_logger(__name__)
_FREE: Final = int(mujoco.mjtJoint.mjJNT_FREE)
_SINGLE: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
# Tolerance for contradictions between poses of a fixed object's parts (m, and entries of R).
_SAME_PLACE: Final = 1e-6

# Half extent of a solid along each axis of another frame; the rows of `A` are the axes of that
# frame in the solid's own, `size` is MuJoCo's.
_REACH: Final[dict[int, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda A, size: np.full(3, size[0]),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda A, size: size[0] + size[1] * np.abs(A[:, 2]),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda A, size: np.linalg.norm(A * size, axis=1),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda A, size: np.abs(A) @ size,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda A, size: (
        size[0] * np.hypot(A[:, 0], A[:, 1]) + size[1] * np.abs(A[:, 2])
    ),
}
_MESH: Final = int(mujoco.mjtGeom.mjGEOM_MESH)
# Ranges of the factors: a hand still gets around the objects, and they do not tip by themselves.
_LEAST, _MOST = 0.5, 1.5
# Of objects of other sizes: those of a data set differ about this much from the usual ones.
_DRAWN: Final = {"width": (0.75, 1.30), "height": (0.90, 1.10)}
# Fields of a model that depend on the size of a geom.
_GEOMETRY: Final = ("geom_size", "geom_pos", "geom_rbound", "geom_aabb", "bvh_aabb")
_ROUND: Final = {int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
PHYSICS_RATE_HZ = 600  # a multiple of the rates of all devices
# Wrist impedance of the arm (or the operator's arm) towards the commanded pose.
WRIST_STIFFNESS_N_M, WRIST_DAMPING_N_S_M = 700.0, 40.0
WRIST_STIFFNESS_NM_RAD, WRIST_DAMPING_NM_S_RAD = 15.0, 0.4
FINGER_STIFFNESS_NM_RAD, FINGER_DAMPING_NM_S_RAD, FINGER_TORQUE_NM = 1.2, 0.03, 2.0
# Human skin and the robot's pads yield about 1 mm at 10 N.
_HAND_CONTACT = 'friction="1.2 0.01 0.0005" solref="0.02 1" solimp="0.4 0.8 0.004" priority="1"'
_OBJECT_CONTACT = 'friction="1 0.005 0.0001"'
_HAND_COLOURS = {"left": (0.45, 0.62, 0.88), "right": (0.90, 0.66, 0.50)}
_SKIN_GROUP = 4


def _log_warning(text: str) -> None:
    logger.warning("physics_warning", text=text)


# Without a handler MuJoCo appends its warnings to MUJOCO_LOG.TXT in the current folder.
mujoco.set_mju_user_warning(_log_warning)


class ObjectBodies:
    """Poses and speeds of objects; raises InvalidInputError for one neither free nor fixed."""

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
        """Set all poses, joints at rest; raises InvalidInputError for contradictory parts."""
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
        """Set all poses, joints as needed; raises InvalidInputError where that is not unique."""
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


@dataclass(frozen=True)
class Scene:
    """A model with its array addresses; always left before right."""

    model: mujoco.MjModel
    xml: str
    domain: Domain
    hands: tuple[TwinHand, TwinHand]
    object_names: tuple[str, ...]

    def _ids(self, kind: mujoco.mjtObj, names: list[str]) -> list[int]:
        return [mujoco.mj_name2id(self.model, kind, name) for name in names]

    def _of_fingers(self, kind: mujoco.mjtObj) -> Int64[np.ndarray, "2 20"]:
        names = [list(hand.kinematics.joint_names) for hand in self.hands]
        return np.array([self._ids(kind, of_hand) for of_hand in names], dtype=np.int64)

    @cached_property
    def wrist_qpos(self) -> Int64[np.ndarray, "2 7"]:
        """Indices of each wrist's pose (x y z, qw qx qy qz) in qpos."""
        joints = self._ids(mujoco.mjtObj.mjOBJ_JOINT, [f"{side}_free" for side in SIDES])
        return np.array([self.model.jnt_qposadr[j] + np.arange(7) for j in joints], dtype=np.int64)

    @cached_property
    def joint_qpos(self) -> Int64[np.ndarray, "2 20"]:
        """Indices of each hand's joint angles in qpos."""
        joints = self._of_fingers(mujoco.mjtObj.mjOBJ_JOINT)
        return self.model.jnt_qposadr[joints].astype(np.int64)

    @cached_property
    def joint_ctrl(self) -> Int64[np.ndarray, "2 20"]:
        """Indices of each hand's commanded joint angles in ctrl."""
        return self._of_fingers(mujoco.mjtObj.mjOBJ_ACTUATOR)

    @cached_property
    def mocap_rows(self) -> Int64[np.ndarray, "3"]:
        """Mocap rows of the left and right wrist target and of the head camera."""
        bodies = self._ids(mujoco.mjtObj.mjOBJ_BODY, ["left_target", "right_target", "head_target"])
        return np.array(self.model.body_mocapid[bodies], dtype=np.int64)

    @cached_property
    def bodies(self) -> ObjectBodies:
        """Access to the task's objects."""
        return ObjectBodies(self.model, self.object_names)

    @cached_property
    def geom_hand(self) -> Int64[np.ndarray, " geoms"]:
        """Hand of each geom: 0 left, 1 right, -1 none."""
        wrists = self._ids(mujoco.mjtObj.mjOBJ_BODY, [f"{side}_wrist" for side in SIDES])
        roots = self.model.body_rootid[self.model.geom_bodyid]
        is_of_hand = roots[:, None] == np.array(wrists)
        return np.where(is_of_hand.any(axis=1), is_of_hand.argmax(axis=1), -1)

    @cached_property
    def geom_object(self) -> Int64[np.ndarray, " geoms"]:
        """Object of each geom, -1 for none."""
        return self.bodies.of_body[self.model.geom_bodyid]

    @cached_property
    def table_geom(self) -> int:
        """Geom of the table top."""
        return int(self.model.geom("table").id)


def compile_scene(domain: Domain, *, objects: str, object_names: tuple[str, ...]) -> Scene:
    """Compile the scene of a domain's two hands and the given objects (MJCF bodies)."""
    hands = (twin_hand("left", domain), twin_hand("right", domain))
    xml = scene_xml(hands, objects)
    return Scene(mujoco.MjModel.from_xml_string(xml), xml, domain, hands, object_names)


def object_boxes_m(scene: Scene) -> Float64[np.ndarray, "objects 6"]:
    """Centre and half sizes x y z of each object's box in its frame (m), parts at rest included."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    boxes = np.zeros((len(scene.object_names), 6))
    for index, body in enumerate(scene.bodies.ids.tolist()):
        T_object_world = invert(_body_pose(data, body))
        spans = [
            _span(scene.model, data, geom, T_object_world)
            for geom in np.flatnonzero(scene.geom_object == index).tolist()
        ]
        low = np.min([span[0] for span in spans], axis=0)
        high = np.max([span[1] for span in spans], axis=0)
        boxes[index] = [*(0.5 * (low + high)), *(0.5 * (high - low))]
    return boxes


def _span(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geom: int,
    T_object_world: Float64[np.ndarray, "4 4"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    R_world_geom = data.geom_xmat[geom].reshape(3, 3)
    T = T_object_world @ transform(R_world_geom, data.geom_xpos[geom])
    kind = int(model.geom_type[geom])
    if kind == _MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = apply(T, model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float))
        return points.min(axis=0), points.max(axis=0)
    reach = _REACH[kind](T[:3, :3], model.geom_size[geom])
    return T[:3, 3] - reach, T[:3, 3] + reach


@dataclass(frozen=True)
class Sizes:
    """Factors of the usual size of all objects that hands can carry; masses stay.

    `width` is along x and y of the objects' frames and `height` along z, the axis of round objects.
    """

    width: float = 1.0
    height: float = 1.0

    def __post_init__(self) -> None:
        if not (_LEAST <= self.width <= _MOST and _LEAST <= self.height <= _MOST):
            raise InvalidInputError(
                f"twin: got objects of {self.width} times the usual width and {self.height} times "
                f"the usual height, expected {_LEAST} … {_MOST}"
            )

    @classmethod
    def drawn(cls, generator: np.random.Generator) -> "Sizes":
        """Other sizes for a take of a training set."""
        width, height = (round(float(generator.uniform(*_DRAWN[name])), 3) for name in _DRAWN)
        return cls(width, height)

    @property
    def factors(self) -> Float64[np.ndarray, "3"]:
        """Factors along x, y and z."""
        return np.array([self.width, self.width, self.height])

    @property
    def labels(self) -> list[str]:
        """Parts of an episode's id; none for the usual sizes."""
        if self == USUAL:
            return []
        return [f"w{round(1000 * self.width)}h{round(1000 * self.height)}"]


USUAL: Final = Sizes()


class Geometry:
    """The usual geometry of a scene's objects, and changes of it."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._usual = {name: np.array(getattr(scene.model, name)) for name in _GEOMETRY}
        free = np.flatnonzero(scene.bodies.is_free)
        self._geoms = np.flatnonzero(np.isin(scene.geom_object, free))
        self._bodies = np.flatnonzero(np.isin(scene.bodies.of_body, free))

    def resize(self, sizes: Sizes) -> None:
        """Give objects their sizes of a take; turned geoms grow along their own axes."""
        model = self._scene.model
        for name, values in self._usual.items():
            getattr(model, name)[:] = values
        if sizes == USUAL:
            return
        for geom in self._geoms.tolist():
            pose = np.concatenate([model.geom_pos[geom], model.geom_quat[geom]])
            R = transform_from_pose(pose)[:3, :3]
            along = np.linalg.norm(sizes.factors[:, None] * R, axis=0)
            size = along.copy()
            if int(model.geom_type[geom]) in _ROUND:
                size = np.array([along[:2].mean(), along[2], 1.0])
            model.geom_size[geom] *= size
            model.geom_pos[geom] *= sizes.factors
            model.geom_aabb[geom] *= np.tile(along, 2)
            model.geom_rbound[geom] *= along.max()
        for body in self._bodies.tolist():
            first = model.body_bvhadr[body]
            # Boxes that collisions are searched in: larger ones find the same contacts.
            model.bvh_aabb[first : first + model.body_bvhnum[body], 3:] *= 2 * _MOST

    def on_the_same_level(
        self, poses: Float64[np.ndarray, "objects 7"], sizes: Sizes, boxes_m: np.ndarray
    ) -> Float64[np.ndarray, "objects 7"]:
        """Poses that keep the lowest point of each resized object, usually `boxes_m`."""
        placed = np.array(poses)
        up = transform_from_pose(placed)[:, 2, :3]
        low_m = [
            (up * boxes_m[:, :3] * factors).sum(1) - (np.abs(up) * boxes_m[:, 3:] * factors).sum(1)
            for factors in (np.ones(3), sizes.factors)
        ]
        placed[:, 2] += np.where(self._scene.bodies.is_free, low_m[0] - low_m[1], 0.0)
        return placed


def numbers(values: Iterable[float]) -> str:
    """Format numbers as an MJCF attribute, without loss."""
    return " ".join(repr(float(value)) for value in values)


def _tint(side: str, finger_index: int) -> str:
    base = np.array(_HAND_COLOURS[side])
    return numbers([*(base * (0.80 + 0.06 * finger_index)).clip(0, 1), 1.0])


def _finger(hand: TwinHand, index: int) -> str:
    table = hand.kinematics.fingers[index]
    straight_m, _ = hand.distal_m(index)
    tip = np.array(table.tip_m)
    ends = [
        np.zeros(3),
        np.array(table.joints[2].position_m),
        np.array(table.joints[3].position_m),
        tip / np.linalg.norm(tip) * straight_m,
    ]
    prefix = f"{hand.side}_{FINGERS[index]}"
    rgba = _tint(hand.side, index)
    parts = []
    for link, row in enumerate(table.joints):
        parts.append(
            f'<body name="{prefix}_{link}" pos="{numbers(row.position_m)}" '
            f'quat="{numbers(row.q_wxyz)}" gravcomp="1"><joint name="{row.name}" class="finger" '
            f'axis="{numbers(row.axis)}" range="{numbers(row.limits_rad)}"/>'
        )
        if link == 0:
            parts.append('<inertial mass="0.01" pos="0 0 0" diaginertia="1e-6 1e-6 1e-6"/>')
        else:
            radius = hand.shape.radii_m[index][link - 1]
            parts.append(
                f'<geom name="{prefix}_link{link}" class="hand" type="capsule" '
                f'fromto="0 0 0 {numbers(ends[link])}" size="{radius!r}" rgba="{rgba}"/>'
            )
    parts.append(_skin(f"{prefix}_skin"))
    return "".join(parts) + "</body>" * len(table.joints)


def _skin(name: str) -> str:
    return (
        f'<geom name="{name}" type="mesh" mesh="{name}" contype="0" conaffinity="0" mass="0" '
        f'group="{_SKIN_GROUP}" rgba="0 0 0 0"/>'
    )


def _hand(hand: TwinHand) -> str:
    side, shape = hand.side, hand.shape
    half = (0.040, 0.5 * PALM_THICKNESS_M, 0.045)
    centre = hand.palm_centre_m - np.array([0.0, hand.palm_sign * half[1], 0.0])
    fingers = "".join(_finger(hand, index) for index in range(len(FINGERS)))
    forearm_z = shape.palm_z_m + half[2]
    return (
        f'<body name="{side}_wrist" gravcomp="1"><freejoint name="{side}_free"/>'
        '<inertial mass="0.45" pos="0 0 -0.03" diaginertia="8e-4 1e-3 6e-4"/>'
        f'<geom name="{side}_palm" class="hand" type="box" pos="{numbers(centre)}" '
        f'size="{numbers(half)}" rgba="{_tint(side, 1)}"/>'
        f'<geom name="{side}_forearm" class="hand" type="capsule" size="0.026" '
        f'fromto="0 0 {forearm_z + 0.02!r} 0 0 {forearm_z + 0.06!r}" '
        f'contype="0" conaffinity="0" mass="0" rgba="{_tint(side, 0)}"/>'
        f'<site name="{side}_wrist_site"/>{_skin(f"{side}_palm_skin")}{fingers}</body>'
        f'<body name="{side}_target" mocap="true"><site name="{side}_target_site"/></body>'
    )


def _grid_mesh(name: str, grid_m: np.ndarray, *, flip: bool) -> str:
    """Mesh of an open surface through a grid of points [rows, columns, 3]."""
    rows, columns, _ = grid_m.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    if flip:
        triangles = triangles[:, ::-1]
    faces = " ".join(str(int(corner)) for corner in triangles.ravel())
    return (
        f'<mesh name="{name}" inertia="shell" vertex="{numbers(grid_m.ravel())}" face="{faces}"/>'
    )


def _meshes(hand: TwinHand) -> str:
    flip = hand.side == "left"
    tips = [
        _grid_mesh(f"{hand.side}_{finger}_skin", hand.tip_skin_m(index), flip=flip)
        for index, finger in enumerate(FINGERS)
    ]
    return "".join(tips) + _grid_mesh(f"{hand.side}_palm_skin", hand.palm_skin_m(), flip=flip)


def _actuators(hand: TwinHand) -> str:
    parts = [
        f'<position name="{name}" joint="{name}" kp="{FINGER_STIFFNESS_NM_RAD}" '
        f'kv="{FINGER_DAMPING_NM_S_RAD}" forcerange="-{FINGER_TORQUE_NM} {FINGER_TORQUE_NM}"/>'
        for name in hand.kinematics.joint_names
    ]
    for axis in range(6):
        gear = " ".join("1" if axis == position else "0" for position in range(6))
        stiffness = WRIST_STIFFNESS_N_M if axis < 3 else WRIST_STIFFNESS_NM_RAD
        damping = WRIST_DAMPING_N_S_M if axis < 3 else WRIST_DAMPING_NM_S_RAD
        parts.append(
            f'<position name="{hand.side}_wrist_{axis}" site="{hand.side}_wrist_site" '
            f'refsite="{hand.side}_target_site" gear="{gear}" kp="{stiffness}" kv="{damping}"/>'
        )
    return "".join(parts)


def _sensors(hand: TwinHand) -> str:
    return "".join(
        f'<tactile name="{hand.side}_{pad}" geom="{hand.side}_{pad}_skin" '
        f'mesh="{hand.side}_{pad}_skin"/>'
        for pad in (*FINGERS, "palm")
    )


def scene_xml(hands: tuple[TwinHand, ...], objects: str) -> str:
    """MJCF of table, shelf behind the viewer, hands (left first) and bodies of class "object"."""
    bodies = "".join(_hand(hand) for hand in hands)
    return (
        '<mujoco model="dextouch_twin"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{1 / PHYSICS_RATE_HZ!r}" cone="elliptic" impratio="10" '
        'integrator="implicitfast" solver="Newton"><flag autoreset="disable"/></option>'
        '<size memory="64M"/>'
        '<default><default class="hand"><geom contype="1" conaffinity="2" density="1100" '
        f'condim="4" {_HAND_CONTACT}/></default>'
        f'<default class="object"><geom contype="2" conaffinity="3" condim="4" {_OBJECT_CONTACT}/>'
        '</default><default class="finger"><joint type="hinge" armature="0.0005" damping="0.01"/>'
        f"</default></default><asset>{''.join(_meshes(hand) for hand in hands)}</asset><worldbody>"
        '<geom name="table" class="object" type="box" pos="0 0 -0.02" size="0.7 0.5 0.02" '
        'rgba="0.72 0.66 0.58 1"/>'
        '<geom name="shelf" class="object" type="box" pos="0 -3 -0.02" size="0.7 0.5 0.02"/>'
        f'<body name="head_target" mocap="true"/>{bodies}{objects}</worldbody>'
        f"<actuator>{''.join(_actuators(hand) for hand in hands)}</actuator>"
        f"<sensor>{''.join(_sensors(hand) for hand in hands)}</sensor></mujoco>"
    )
