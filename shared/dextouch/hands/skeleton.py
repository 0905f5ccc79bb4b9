"""Human hand skeleton of 25 tracked keypoints, identified by chain and joint, and its mean shape.

Bone lengths of the mean hand, the reference for the orientation of tracked hands, are adult means
(Buryanov and Kotiuk 2010). Position and spread of the metacarpals are our estimate from common
anatomy; they define our wrist axes of a human hand: -z along the third metacarpal, x across the
palm to the thumb's side, y through the palm.
"""

from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import UnknownNameError

WRIST: Final = "wrist"
CHAINS: Final = ("thumb", "index", "middle", "ring", "little")
THUMB_JOINTS: Final = ("metacarpal", "proximal", "distal", "tip")
FINGER_JOINTS: Final = ("metacarpal", "proximal", "intermediate", "distal", "tip")


# (chain, joint) of each keypoint. A node sits at the *base* of its bone: "proximal" is the
# anatomical MCP joint, "intermediate" the PIP, "distal" the DIP (of the thumb: the IP).
NODES: Final = (
    (WRIST, WRIST),
    *(("thumb", joint) for joint in THUMB_JOINTS),
    *((chain, joint) for chain in CHAINS[1:] for joint in FINGER_JOINTS),
)
NUM_KEYPOINTS: Final = len(NODES)
NODE_INDEX: Final = {node: index for index, node in enumerate(NODES)}
FINGER_CHAINS: Final = CHAINS[1:]
WRIST_NODE: Final = NODE_INDEX[WRIST, WRIST]
METACARPAL_NODES: Final = tuple(NODE_INDEX[chain, FINGER_JOINTS[0]] for chain in FINGER_CHAINS)
KNUCKLE_NODES: Final = tuple(NODE_INDEX[chain, FINGER_JOINTS[1]] for chain in FINGER_CHAINS)
# Keypoints that do not move with the fingers.
PALM_NODES: Final = (WRIST_NODE, *METACARPAL_NODES, *KNUCKLE_NODES)

# Right hand, metres: base of the metacarpal, its lean to the thumb's side (rad), bones from there.
_FINGERS: Final = {
    "index": ((0.013, -0.002, -0.027), 0.14, (0.06812, 0.03978, 0.02238, 0.01966)),
    "middle": ((0.003, -0.004, -0.029), 0.00, (0.06460, 0.04463, 0.02633, 0.02135)),
    "ring": ((-0.007, -0.003, -0.027), -0.13, (0.05800, 0.04137, 0.02565, 0.02125)),
    "little": ((-0.015, 0.000, -0.024), -0.26, (0.05369, 0.03274, 0.01811, 0.01969)),
}
_THUMB_BASE_M: Final = (0.018, 0.007, -0.020)
_THUMB_DIRECTION: Final = (0.78, 0.10, -0.62)
_THUMB_BONES_M: Final = (0.04622, 0.03157, 0.02734)


def chain_indices(chain: str) -> list[int]:
    """Keypoint indices of one chain from metacarpal to tip (4 for the thumb, 5 for a finger)."""
    return [index for index, (name, _) in enumerate(NODES) if name == chain]


def solver_indices(chain: str) -> list[int]:
    """The four keypoints of a chain that a 4-joint finger can follow: MCP, PIP, DIP, tip.

    For the thumb: metacarpal (CMC), proximal (MCP), distal (IP), tip.
    """
    return chain_indices(chain)[-4:]


@lru_cache(maxsize=2)
def mean_hand_m(side: str) -> Float64[np.ndarray, "25 3"]:
    """The 25 keypoints of the mean hand, flat, in wrist axes, metres; read-only.

    Raises:
        UnknownNameError: a side other than "left" and "right".
    """
    if side not in ("left", "right"):
        raise UnknownNameError("side", side, ["left", "right"])
    points = np.zeros((NUM_KEYPOINTS, 3))
    for chain, (base_m, lean_rad, bones_m) in _FINGERS.items():
        # Fingers spread half as much as their metacarpals.
        leans = np.array([lean_rad, *[lean_rad / 2] * 3])
        points[chain_indices(chain)] = _chain(base_m, leans, np.array(bones_m))
    direction = np.array(_THUMB_DIRECTION) / np.linalg.norm(_THUMB_DIRECTION)
    steps = np.concatenate([[0.0], np.cumsum(_THUMB_BONES_M)])
    points[chain_indices("thumb")] = np.array(_THUMB_BASE_M) + steps[:, None] * direction
    if side == "left":
        points[:, 1] *= -1
    points.flags.writeable = False
    return points


def _chain(
    base_m: tuple[float, float, float], leans_rad: np.ndarray, bones_m: np.ndarray
) -> Float64[np.ndarray, "5 3"]:
    directions = np.stack([np.sin(leans_rad), np.zeros(4), -np.cos(leans_rad)], axis=-1)
    steps = np.cumsum(directions * bones_m[:, None], axis=0)
    return np.array(base_m) + np.concatenate([np.zeros((1, 3)), steps])
