"""Human hand skeleton of 25 tracked keypoints, identified by chain and joint, and its mean shape.

Bone lengths are adult means (Buryanov and Kotiuk 2010); position and spread of the metacarpals are
our estimate. They define our wrist axes of a human hand: -z along the third metacarpal, x across
the palm to the thumb's side, y through the palm.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError

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

# The mean right hand in metres: bones of adults (Buryanov and Kotiuk 2010), the last one with the
# pulp; places in the wrist are our estimates from common anatomy. Of a finger: base of the
# metacarpal, its lean to the thumb's side (rad), bones from there.
MEAN_FINGERS: Final = {
    "index": ((0.013, -0.002, -0.027), 0.14, (0.06812, 0.03978, 0.02238, 0.01966)),
    "middle": ((0.003, -0.004, -0.029), 0.00, (0.06460, 0.04463, 0.02633, 0.02135)),
    "ring": ((-0.007, -0.003, -0.027), -0.13, (0.05800, 0.04137, 0.02565, 0.02125)),
    "little": ((-0.015, 0.000, -0.024), -0.26, (0.05369, 0.03274, 0.01811, 0.01969)),
}
MEAN_THUMB_BASE_M: Final = (0.018, 0.007, -0.020)
_THUMB_DIRECTION: Final = (0.78, 0.10, -0.62)
MEAN_THUMB_BONES_M: Final = (0.04622, 0.03157, 0.02734)


def chain_indices(chain: str) -> list[int]:
    """Keypoint indices of one chain from metacarpal to tip (4 for the thumb, 5 for a finger)."""
    return [index for index, (name, _) in enumerate(NODES) if name == chain]


def solver_indices(chain: str) -> list[int]:
    """Keypoints that a 4-joint finger follows: MCP, PIP, DIP, tip (thumb: CMC, MCP, IP, tip)."""
    return chain_indices(chain)[-4:]


@lru_cache(maxsize=2)
def mean_hand_m(side: str) -> Float64[np.ndarray, "25 3"]:
    """Keypoints of the mean hand, flat, in wrist axes (m); raises UnknownNameError for a side."""
    if side not in ("left", "right"):
        raise UnknownNameError("side", side, ["left", "right"])
    points = np.zeros((NUM_KEYPOINTS, 3))
    for chain, (base_m, lean_rad, bones_m) in MEAN_FINGERS.items():
        # Fingers spread half as much as their metacarpals.
        leans = np.array([lean_rad, *[lean_rad / 2] * 3])
        points[chain_indices(chain)] = _chain(base_m, leans, np.array(bones_m))
    direction = np.array(_THUMB_DIRECTION) / np.linalg.norm(_THUMB_DIRECTION)
    steps = np.concatenate([[0.0], np.cumsum(MEAN_THUMB_BONES_M)])
    points[chain_indices("thumb")] = np.array(MEAN_THUMB_BASE_M) + steps[:, None] * direction
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


# Mapping of a hand tracker's nodes, in any order and naming, to our 25 keypoints.
#
# Node ids are opaque and orders differ even between products of one manufacturer, so nodes are
# identified by chain and joint. Joint names differ as well, and some are shifted by one joint; the
# names of a chain are interpreted together.

Node = tuple[str, str]

# Nodes that trackers without metacarpals lack (MediaPipe: 21 nodes).
FINGER_METACARPALS: Final = tuple((chain, "metacarpal") for chain in CHAINS[1:])
NO_KEYPOINT: Final = -1
_PALM: Final = "palm"
# The root of MANUS's tree is of the chain "Hand" and of the joint type "Invalid".
_WRIST_WORDS: Final = ((WRIST, WRIST), ("hand", "hand"), ("hand", "invalid"), ("hand", WRIST))
_CHAIN_WORDS: Final = {"pinky": "little"}
# Anatomy names joints, we name the bones that start there. MANUS's ROS 2 node names the metacarpal
# bone's base "MCP" and so on, shifted by one joint; the set of five names identifies the scheme, as
# a "PIP" does for its thumb.
_FINGER_WORDS: Final = (
    ("mcp", "pip", "dip", "tip"),
    ("cmc", "mcp", "pip", "dip", "tip"),
    ("mcp", "pip", "ip", "dip", "tip"),
)
_THUMB_WORDS: Final = (("cmc", "mcp", "ip", "tip"), ("mcp", "pip", "dip", "tip"))


@dataclass(frozen=True)
class NodeOrder:
    """Our keypoint index of each node of a tracker, −1 for a palm, and the nodes that it lacks."""

    places: tuple[int, ...]
    absent: tuple[Node, ...]

    def keypoints(self, points: np.ndarray) -> Float64[np.ndarray, "*batch 25 3"]:
        """Our keypoints of a tracker's points [..., n, 3], NaN where absent; raises ShapeError."""
        array = np.asarray(points, dtype=np.float64)
        if array.shape[-2:] != (len(self.places), 3):
            raise ShapeError(
                f"points of a tracked hand: got shape {array.shape}, expected "
                f"[..., {len(self.places)}, 3]"
            )
        keypoints = np.full((*array.shape[:-2], NUM_KEYPOINTS, 3), np.nan)
        kept = [theirs for theirs, ours in enumerate(self.places) if ours != NO_KEYPOINT]
        keypoints[..., [self.places[theirs] for theirs in kept], :] = array[..., kept, :]
        return keypoints


def node_order(nodes: Sequence[Node], *, may_lack: Collection[Node] = ()) -> NodeOrder:
    """Assign a tracker's nodes, given in its order by chain and joint; case-insensitive.

    Chains are by our names ("pinky" is "little", the chain "hand" the wrist), joints of a chain all
    by our names, by medicine's (CMC MCP PIP DIP TIP), or as MANUS's ROS 2 node misnames them. A
    palm is ignored. Raises InvalidInputError for unknown, duplicate or missing nodes that it does
    not `may_lack`.
    """
    translated = _in_our_words(nodes)
    counts = Counter(node for node in translated if node is not None)
    originals = dict(zip(translated, nodes, strict=True))
    unknown = [originals[node] for node in counts if node not in NODE_INDEX]
    absent = tuple(node for node in NODE_INDEX if node not in counts)
    missing = [node for node in absent if node not in may_lack]
    twice = [node for node, count in counts.items() if count > 1]
    if unknown or missing or twice:
        raise InvalidInputError(
            f"expected each of the {NUM_KEYPOINTS} nodes once; unknown {unknown}, "
            f"missing {missing}, named twice {twice}",
            unknown=unknown,
            missing=missing,
            twice=twice,
        )
    places = tuple(NO_KEYPOINT if node is None else NODE_INDEX[node] for node in translated)
    return NodeOrder(places, absent)


def _in_our_words(nodes: Sequence[Node]) -> list[Node | None]:
    """Translate nodes to our names; None for a palm. Unknown names are unchanged."""
    lowered = [(chain.lower(), joint.lower()) for chain, joint in nodes]
    named = [(_CHAIN_WORDS.get(chain, chain), joint) for chain, joint in lowered]
    words: dict[Node, Node] = dict.fromkeys(_WRIST_WORDS, (WRIST, WRIST))
    for chain in CHAINS:
        is_thumb = chain == "thumb"
        ours = THUMB_JOINTS if is_thumb else FINGER_JOINTS
        given = {joint for other, joint in named if other == chain}
        for scheme in _THUMB_WORDS if is_thumb else _FINGER_WORDS:
            if set(scheme) == given:
                joints = zip(scheme, ours[-len(scheme) :], strict=True)
                words |= {(chain, theirs): (chain, joint) for theirs, joint in joints}
    return [None if _PALM in node else words.get(node, node) for node in named]
