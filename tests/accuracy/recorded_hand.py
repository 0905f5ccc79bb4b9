"""A real tracked hand of `../shared/data`, in wrist axes."""

from pathlib import Path

import numpy as np
import pytest

from dextouch.hands import (
    CHAINS,
    FINGER_JOINTS,
    FINGER_METACARPALS,
    WRIST,
    node_order,
)
from dextouch.hands.skeleton import THUMB_JOINTS
from services.alignment.retargeting.wrist import to_wrist_axes, wrist_frame

RECORDING = Path(__file__).parents[3] / "shared/data/hands/right_hand_mediapipe_first_half.npy"
RATE_HZ = 30.0
needs_recording = pytest.mark.skipif(
    not RECORDING.is_file(), reason="no recordings in ../shared/data"
)


def recorded_keypoints_m():
    """[310, 25, 3] of one right hand, wrist axes; the palm's metacarpals are not tracked."""
    nodes = [(WRIST, WRIST)]
    for chain in CHAINS:
        joints = THUMB_JOINTS if chain == "thumb" else FINGER_JOINTS[1:]
        nodes.extend((chain, joint) for joint in joints)
    order = node_order(nodes, may_lack=FINGER_METACARPALS)
    keypoints = order.keypoints(np.load(RECORDING, allow_pickle=False))
    return to_wrist_axes(keypoints, wrist_frame(keypoints, "right").T_tracker_wrist)
