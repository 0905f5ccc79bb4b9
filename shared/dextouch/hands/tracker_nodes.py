"""Mapping of a hand tracker's nodes, in any order and naming, to our 25 keypoints.

Node ids are opaque and orders differ even between products of one manufacturer, so nodes are
identified by chain and joint. Joint names differ as well, and some are shifted by one joint; the
names of a chain are interpreted together.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.skeleton import (
    CHAINS,
    FINGER_JOINTS,
    NODE_INDEX,
    NUM_KEYPOINTS,
    THUMB_JOINTS,
    WRIST,
)

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
    """Assignment of a tracker's nodes to keypoints.

    Attributes:
        places: our keypoint index of each of the tracker's nodes, in its order; −1 for a palm.
        absent: our nodes that the tracker lacks.
    """

    places: tuple[int, ...]
    absent: tuple[Node, ...]

    def keypoints(self, points: np.ndarray) -> Float64[np.ndarray, "*batch 25 3"]:
        """Reorder a tracker's points [..., n, 3] to our keypoints; NaN where absent.

        Raises:
            ShapeError: not one point per node.
        """
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
    """Assign nodes given by chain and joint.

    Args:
        nodes: (chain, joint) in the tracker's order. Chains by our names ("pinky" is "little", the
            chain "hand" the wrist), joints of a chain all by our names, or all by medicine's (CMC
            MCP PIP DIP TIP), or as MANUS's ROS 2 node misnames them; case-insensitive. A palm is
            ignored.
        may_lack: optional nodes, such as `FINGER_METACARPALS`.

    Raises:
        InvalidInputError: unknown, missing or duplicate nodes; the message lists them.
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
