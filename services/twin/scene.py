"""Compiled MuJoCo model of a scene, and the addresses of hands and objects in its arrays."""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import structlog
from jaxtyping import Int64

from dextouch.tactile.layout import SIDES
from services.twin.hands import TwinHand, twin_hand
from services.twin.mjcf import scene_xml
from services.twin.names import Domain
from services.twin.object_bodies import ObjectBodies

logger = structlog.get_logger(__name__)


def _log_warning(text: str) -> None:
    logger.warning("physics_warning", text=text)


# Without a handler MuJoCo appends its warnings to MUJOCO_LOG.TXT in the current folder.
mujoco.set_mju_user_warning(_log_warning)


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

    @cached_property
    def wrist_qpos(self) -> Int64[np.ndarray, "2 7"]:
        """Indices of each wrist's pose (x y z, qw qx qy qz) in qpos."""
        joints = self._ids(mujoco.mjtObj.mjOBJ_JOINT, [f"{side}_free" for side in SIDES])
        return np.array([self.model.jnt_qposadr[j] + np.arange(7) for j in joints], dtype=np.int64)

    @cached_property
    def joint_qpos(self) -> Int64[np.ndarray, "2 20"]:
        """Indices of each hand's joint angles in qpos."""
        return np.array(
            [
                self.model.jnt_qposadr[
                    self._ids(mujoco.mjtObj.mjOBJ_JOINT, list(hand.kinematics.joint_names))
                ]
                for hand in self.hands
            ],
            dtype=np.int64,
        )

    @cached_property
    def joint_ctrl(self) -> Int64[np.ndarray, "2 20"]:
        """Indices of each hand's commanded joint angles in ctrl."""
        return np.array(
            [
                self._ids(mujoco.mjtObj.mjOBJ_ACTUATOR, list(hand.kinematics.joint_names))
                for hand in self.hands
            ],
            dtype=np.int64,
        )

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
