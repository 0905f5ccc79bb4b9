"""Human hand skeleton of 25 tracked keypoints, identified by chain and joint."""

from typing import Final

WRIST: Final = "wrist"
CHAINS: Final = ("thumb", "index", "middle", "ring", "little")
THUMB_JOINTS: Final = ("metacarpal", "proximal", "distal", "tip")
FINGER_JOINTS: Final = ("metacarpal", "proximal", "intermediate", "distal", "tip")


def _nodes() -> tuple[tuple[str, str], ...]:
    nodes = [(WRIST, WRIST)]
    for chain in CHAINS:
        joints = THUMB_JOINTS if chain == "thumb" else FINGER_JOINTS
        nodes.extend((chain, joint) for joint in joints)
    return tuple(nodes)


# (chain, joint) of each keypoint. A node sits at the *base* of its bone: "proximal" is the
# anatomical MCP joint, "intermediate" the PIP, "distal" the DIP (of the thumb: the IP).
NODES: Final = _nodes()
NUM_KEYPOINTS: Final = len(NODES)
NODE_INDEX: Final = {node: index for index, node in enumerate(NODES)}


def chain_indices(chain: str) -> list[int]:
    """Keypoint indices of one chain from metacarpal to tip (4 for the thumb, 5 for a finger)."""
    return [index for index, (name, _) in enumerate(NODES) if name == chain]


def solver_indices(chain: str) -> list[int]:
    """The four keypoints of a chain that a 4-joint finger can follow: MCP, PIP, DIP, tip.

    For the thumb: metacarpal (CMC), proximal (MCP), distal (IP), tip.
    """
    return chain_indices(chain)[-4:]
