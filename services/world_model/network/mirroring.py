"""Per-hand features of 67-D actions, with the left hand mirrored into the right-hand frame.

In the wrist frame fingers point along -z, the thumb along +x; the right palm faces +y, the left
-y. So the mirror image of a left hand is y → -y; in the head camera's optical frame it is x → -x.
"""

from functools import cache

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import unpack_action
from dextouch.hands.robot_hand import RobotHand

HAND_DIM = 29
CAMERA_DIM = 9
MIRROR_WRIST = np.array([1.0, -1.0, 1.0])
MIRROR_CAMERA = np.array([-1.0, 1.0, 1.0])


@cache
def left_joint_signs() -> Float64[np.ndarray, "20"]:
    """Signs that map left joint angles to those of the mirrored right joints.

    A mirror maps an axis a to -S a; the sign says whether that is the right hand's axis.
    """
    left, right = RobotHand("left"), RobotHand("right")
    signs = [
        np.sign(np.dot(-MIRROR_WRIST * np.array(row_left.axis), np.array(row_right.axis)))
        for finger_left, finger_right in zip(left.fingers, right.fingers, strict=True)
        for row_left, row_right in zip(finger_left.joints, finger_right.joints, strict=True)
    ]
    return np.array(signs, dtype=np.float64)


def mirror_pose_9d(
    pose: np.ndarray, *, mirror_to: np.ndarray, mirror_from: np.ndarray
) -> Float64[np.ndarray, "*batch 9"]:
    """S_to T S_from of 9-D poses: translation and two rotation columns keep their places."""
    signs = np.concatenate(
        [mirror_to, mirror_to * mirror_from[0], mirror_to * mirror_from[1]], dtype=np.float64
    )
    return np.asarray(pose, dtype=np.float64) * signs


def hand_features(actions: np.ndarray) -> Float64[np.ndarray, "*batch 2 29"]:
    """Left (mirrored) and right hand of actions [..., 67]: 9-D wrist pose and 20 angles (rad)."""
    parts = unpack_action(actions)
    wrist_left = mirror_pose_9d(parts.wrist_left, mirror_to=MIRROR_WRIST, mirror_from=MIRROR_WRIST)
    left = np.concatenate([wrist_left, parts.joints_left_rad * left_joint_signs()], axis=-1)
    right = np.concatenate([parts.wrist_right, parts.joints_right_rad], axis=-1)
    return np.stack([left, right], axis=-2).astype(np.float64)


def camera_features(actions: np.ndarray) -> Float64[np.ndarray, "*batch 2 9"]:
    """Head camera pose of actions [..., 67] as each hand sees it: mirrored for the left."""
    camera = np.asarray(unpack_action(actions).camera_head, dtype=np.float64)
    mirrored = mirror_pose_9d(camera, mirror_to=MIRROR_CAMERA, mirror_from=MIRROR_CAMERA)
    return np.stack([mirrored, camera], axis=-2)
