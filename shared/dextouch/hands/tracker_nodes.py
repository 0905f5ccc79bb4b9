"""Mapping of a hand tracker's nodes, in any order and naming, to our 25 keypoints.

Node ids are opaque and orders differ even between products of one manufacturer, so nodes are
identified by chain and joint, or by chain and distance from the wrist. Joint names differ as well,
and some are shifted by one joint; the names of a chain are interpreted together.
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


@dataclass(frozen=True)
class TreeNode:
    """A node by its parent: ids are opaque, the root's parent is None or itself.

    At least one node of each chain needs `chain`, since the tree alone does not identify it.
    """

    id: int
    parent: int | None
    chain: str | None = None


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


def nodes_of_tree(tree: Sequence[TreeNode]) -> list[Node]:
    """Chain and joint of nodes given by their parents, in the same order.

    The root is the wrist, each of its children starts a chain. The thumb has four nodes; another
    chain has five, or four if it begins at its knuckle.

    Raises:
        InvalidInputError: duplicate ids, no root or several, a cycle, or a chain that branches, has
            another number of nodes, no name or two names. `node_order` checks that all chains are
            present.
    """
    num_ids = len({node.id for node in tree})
    roots = [node.id for node in tree if node.parent in (None, node.id)]
    if num_ids < len(tree) or len(roots) != 1:
        raise InvalidInputError(
            f"hand tree: got {len(tree)} nodes with {num_ids} different ids and roots {roots}, "
            "expected all ids different and one node, the wrist, without another node as parent"
        )
    children: dict[int | None, list[TreeNode]] = {}
    for node in tree:
        if node.id != roots[0]:
            children.setdefault(node.parent, []).append(node)
    found: dict[int, Node] = {roots[0]: (WRIST, WRIST)}
    for first in children.get(roots[0], []):
        path = [first]
        while following := children.get(path[-1].id):
            if len(following) > 1:
                raise InvalidInputError(
                    f"hand tree: node {path[-1].id} has the children "
                    f"{[node.id for node in following]}; only the wrist has several, each the "
                    "first node of a chain"
                )
            path += following
        found |= zip((node.id for node in path), _names(path), strict=True)
    lost = [node for node in tree if node.id not in found]
    if lost:
        raise InvalidInputError(
            f"hand tree: nodes {[node.id for node in lost]} do not lead back to the wrist "
            f"{roots[0]}; their parents are {[node.parent for node in lost]}"
        )
    return [found[node.id] for node in tree]


def _names(path: Sequence[TreeNode]) -> list[Node]:
    """Chain and joint of the nodes of one chain, counted from the tip."""
    ids = [node.id for node in path]
    labels = {node.chain.lower() for node in path if node.chain is not None}
    chains = {_CHAIN_WORDS.get(label, label) for label in labels}
    if len(chains) != 1:
        raise InvalidInputError(
            f"hand tree: the chain of nodes {ids} is called {sorted(chains) or 'nothing'}, "
            f"expected one of {list(CHAINS)} at one of its nodes at least"
        )
    (chain,) = chains
    if chain == _PALM:
        return [(_PALM, _PALM)] * len(path)
    joints = THUMB_JOINTS if chain == "thumb" else FINGER_JOINTS
    allowed = {len(joints)} if chain == "thumb" else {len(joints), len(joints) - 1}
    if chain not in CHAINS or len(path) not in allowed:
        raise InvalidInputError(
            f"hand tree: {chain!r} has {len(path)} nodes {ids}, expected one of "
            f"{list(CHAINS)}: the thumb with 4 nodes, another finger with 5, or 4 from its knuckle"
        )
    return [(chain, joint) for joint in joints[-len(path) :]]
