"""Nodes of any tracker in any order come in; where each belongs among our 25 keypoints goes out.

Node ids are opaque and orders differ, between a maker's own systems too: a node is known by its
chain and joint, or by its chain and how far it is from the wrist. Words for joints differ as well,
and some are one joint off; a chain's words only mean something together.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
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

# What trackers without the four bones of the palm lack (MediaPipe: 21 nodes).
FINGER_METACARPALS: Final = tuple((chain, "metacarpal") for chain in CHAINS[1:])
NO_KEYPOINT: Final = -1
_PALM: Final = "palm"
# The root of MANUS's tree is of the chain "Hand" and of the joint type "Invalid".
_WRIST_WORDS: Final = ((WRIST, WRIST), ("hand", "hand"), ("hand", "invalid"), ("hand", WRIST))
_CHAIN_WORDS: Final = {"pinky": "little"}
# Medicine names joints, we name the bones that begin there. MANUS's ROS 2 node names the
# metacarpal bone's base "MCP" and so on, one joint off; the five names together give it away, as a
# "PIP" gives away its thumb.
_FINGER_WORDS: Final = (
    ("mcp", "pip", "dip", "tip"),
    ("cmc", "mcp", "pip", "dip", "tip"),
    ("mcp", "pip", "ip", "dip", "tip"),
)
_THUMB_WORDS: Final = (("cmc", "mcp", "ip", "tip"), ("mcp", "pip", "dip", "tip"))


@dataclass(frozen=True)
class NodeOrder:
    """Where a tracker's nodes belong.

    Attributes:
        places: our keypoint index of each of the tracker's nodes, in its order; −1 for a palm.
        absent: our nodes that it does not have.
    """

    places: tuple[int, ...]
    absent: tuple[Node, ...]

    def keypoints(self, points: np.ndarray) -> Float64[np.ndarray, "*batch 25 3"]:
        """Our keypoints of the tracker's points [..., n, 3], same unit and axes; NaN where absent.

        Raises:
            ShapeError: not one point a node.
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


@dataclass(frozen=True)
class TreeNode:
    """A node by its parent: ids are opaque, the root's parent is None or itself.

    `chain` is needed at one node of each chain at least; chains alone cannot be told apart.
    """

    id: int
    parent: int | None
    chain: str | None = None


def node_order(nodes: Sequence[Node], *, may_lack: Collection[Node] = ()) -> NodeOrder:
    """Where nodes belong that are described by chain and joint.

    Args:
        nodes: (chain, joint) in the tracker's order. Chains by our names ("pinky" is "little", the
            chain "hand" the wrist), joints of a chain all by our names, or all by medicine's (CMC
            MCP PIP DIP TIP), or as MANUS's ROS 2 node misnames them; upper or lower case. A palm
            is no keypoint and left out.
        may_lack: our nodes that need not be there, such as `FINGER_METACARPALS`.

    Raises:
        InvalidInputError: a node unknown to us, missing, or named twice; the message says which.
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
    """The same nodes by our names; None for a palm. What we have no name for stays as it is."""
    lowered = [(chain.lower(), joint.lower()) for chain, joint in nodes]
    named = [(_CHAIN_WORDS.get(chain, chain), joint) for chain, joint in lowered]
    words = {
        chain: _joint_words(chain, [joint for other, joint in named if other == chain])
        for chain in CHAINS
    }
    translated: list[Node | None] = []
    for chain, joint in named:
        if _PALM in (chain, joint):
            translated.append(None)
        elif (chain, joint) in _WRIST_WORDS:
            translated.append((WRIST, WRIST))
        else:
            translated.append((chain, words.get(chain, {}).get(joint, joint)))
    return translated


def _joint_words(chain: str, joints: Sequence[str]) -> Mapping[str, str]:
    """Our name of each of a chain's words, if they are all words of one of the other languages."""
    is_thumb = chain == "thumb"
    ours = THUMB_JOINTS if is_thumb else FINGER_JOINTS
    for words in _THUMB_WORDS if is_thumb else _FINGER_WORDS:
        if set(words) == set(joints):
            return dict(zip(words, ours[-len(words) :], strict=True))
    return {}


def nodes_of_tree(tree: Sequence[TreeNode]) -> list[Node]:
    """Chain and joint of nodes that are described by their parents, in the order given.

    The root is the wrist, each of its children begins a chain. The thumb has four nodes; another
    chain has five, or four if it begins at its knuckle.

    Raises:
        InvalidInputError: ids that repeat, no root or several, a loop, a chain that forks, has
            another number of nodes, no name or two names. Whether all chains are there,
            `node_order` says.
    """
    by_id = {node.id: node for node in tree}
    roots = [node.id for node in tree if node.parent in (None, node.id)]
    if len(by_id) < len(tree) or len(roots) != 1:
        raise InvalidInputError(
            f"hand tree: got {len(tree)} nodes with {len(by_id)} different ids and roots {roots}, "
            "expected all ids different and one node, the wrist, without another node as parent"
        )
    children: dict[int | None, list[int]] = {}
    for node in tree:
        if node.id != roots[0]:
            children.setdefault(node.parent, []).append(node.id)
    found: dict[int, Node] = {roots[0]: (WRIST, WRIST)}
    for first in children.get(roots[0], []):
        ids = _path(first, children)
        found |= _named(ids, [by_id[node_id].chain for node_id in ids])
    lost = [node.id for node in tree if node.id not in found]
    if lost:
        raise InvalidInputError(
            f"hand tree: nodes {lost} do not lead back to the wrist {roots[0]}; their parents are "
            f"{[by_id[node_id].parent for node_id in lost]}"
        )
    return [found[node.id] for node in tree]


def _path(first: int, children: Mapping[int | None, Sequence[int]]) -> list[int]:
    """Ids from the first node of a chain to its tip."""
    ids = [first]
    while following := children.get(ids[-1], ()):
        if len(following) > 1:
            raise InvalidInputError(
                f"hand tree: node {ids[-1]} has the children {list(following)}; only the wrist "
                "has several, each the first node of a chain"
            )
        ids.append(following[0])
    return ids


def _named(ids: Sequence[int], labels: Sequence[str | None]) -> dict[int, Node]:
    """Chain and joint of the nodes of one chain, by their number from the tip."""
    chains = {label.lower() for label in labels if label is not None}
    chains = {_CHAIN_WORDS.get(chain, chain) for chain in chains}
    if len(chains) != 1:
        raise InvalidInputError(
            f"hand tree: the chain of nodes {list(ids)} is called {sorted(chains) or 'nothing'}, "
            f"expected one of {list(CHAINS)} at one of its nodes at least"
        )
    (chain,) = chains
    if chain == _PALM:
        return dict.fromkeys(ids, (_PALM, _PALM))
    joints = THUMB_JOINTS if chain == "thumb" else FINGER_JOINTS
    allowed = (len(joints),) if chain == "thumb" else (len(joints), len(joints) - 1)
    if chain not in CHAINS or len(ids) not in allowed:
        raise InvalidInputError(
            f"hand tree: {chain!r} has {len(ids)} nodes {list(ids)}, expected one of "
            f"{list(CHAINS)}: the thumb with 4 nodes, another finger with 5, or 4 from its knuckle"
        )
    return {
        node_id: (chain, joint) for node_id, joint in zip(ids, joints[-len(ids) :], strict=True)
    }
