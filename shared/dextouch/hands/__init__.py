"""Hand models: tracked human skeleton, robot hand kinematics, and the 67-D action space."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.hands import actions as actions
    from dextouch.hands import hand_files as hand_files
    from dextouch.hands import robot_hand as robot_hand
    from dextouch.hands.robot_hand import FingerTable as FingerTable
    from dextouch.hands.robot_hand import JointRow as JointRow
    from dextouch.hands.robot_hand import Quaternion as Quaternion
    from dextouch.hands.robot_hand import Vector3 as Vector3
    from dextouch.hands.skeleton import CHAINS as CHAINS
    from dextouch.hands.skeleton import FINGER_CHAINS as FINGER_CHAINS
    from dextouch.hands.skeleton import FINGER_JOINTS as FINGER_JOINTS
    from dextouch.hands.skeleton import KNUCKLE_NODES as KNUCKLE_NODES
    from dextouch.hands.skeleton import METACARPAL_NODES as METACARPAL_NODES
    from dextouch.hands.skeleton import NODE_INDEX as NODE_INDEX
    from dextouch.hands.skeleton import NODES as NODES
    from dextouch.hands.skeleton import NUM_KEYPOINTS as NUM_KEYPOINTS
    from dextouch.hands.skeleton import PALM_NODES as PALM_NODES
    from dextouch.hands.skeleton import WRIST as WRIST
    from dextouch.hands.skeleton import WRIST_NODE as WRIST_NODE
    from dextouch.hands.skeleton import chain_indices as chain_indices
    from dextouch.hands.skeleton import mean_hand_m as mean_hand_m
    from dextouch.hands.skeleton import solver_indices as solver_indices
    from dextouch.hands.tracker_nodes import FINGER_METACARPALS as FINGER_METACARPALS
    from dextouch.hands.tracker_nodes import NO_KEYPOINT as NO_KEYPOINT
    from dextouch.hands.tracker_nodes import node_order as node_order
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
