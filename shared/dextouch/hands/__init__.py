"""Hand models: tracked human skeleton, robot hand kinematics, and the 67-D action space."""

from dextouch.hands.finger_table import FingerTable, JointRow, Quaternion, Vector3
from dextouch.hands.mean_hand import (
    FINGER_CHAINS,
    KNUCKLE_NODES,
    METACARPAL_NODES,
    PALM_NODES,
    WRIST_NODE,
    mean_hand_m,
)
from dextouch.hands.skeleton import (
    CHAINS,
    FINGER_JOINTS,
    NODE_INDEX,
    NODES,
    NUM_KEYPOINTS,
    WRIST,
    chain_indices,
    solver_indices,
)
from dextouch.hands.tracker_nodes import (
    FINGER_METACARPALS,
    NO_KEYPOINT,
    TreeNode,
    node_order,
    nodes_of_tree,
)

__all__ = [
    "CHAINS",
    "FINGER_CHAINS",
    "FINGER_JOINTS",
    "FINGER_METACARPALS",
    "KNUCKLE_NODES",
    "METACARPAL_NODES",
    "NODES",
    "NODE_INDEX",
    "NO_KEYPOINT",
    "NUM_KEYPOINTS",
    "PALM_NODES",
    "WRIST",
    "WRIST_NODE",
    "FingerTable",
    "JointRow",
    "Quaternion",
    "TreeNode",
    "Vector3",
    "actions",
    "chain_indices",
    "hand_files",
    "mean_hand_m",
    "node_order",
    "nodes_of_tree",
    "robot_hand",
    "solver_indices",
]
