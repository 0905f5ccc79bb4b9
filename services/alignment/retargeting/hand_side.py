"""Check that tracked keypoints belong to the left or right hand that they claim to be.

A mirror image keeps all distances; the direction in which fingers curl distinguishes left from
right.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.hands import (
    FINGER_CHAINS,
    KNUCKLE_NODES,
    NODE_INDEX,
    WRIST_NODE,
    chain_indices,
    mean_hand_m,
)
from dextouch.tactile.layout import Side
from services.alignment.retargeting.hand_checks import seen_samples

# Mean signed sine between bones of a finger. Stretched fingers may bend back by several degrees, so
# less than this shows no side.
MIN_CURL: Final = 0.15
MIN_THUMB_HEIGHT: Final = 0.003
_MEAN_PALM_M: Final = float(np.linalg.norm(mean_hand_m("right")[KNUCKLE_NODES[1]]))


@dataclass(frozen=True)
class SideEvidence:
    """Evidence for the left or the right hand.

    Attributes:
        side: None where neither fingers nor thumb show it.
        curl: mean sine by which finger bones bend; above zero as a right hand's do.
        thumb_height: of the thumb's base over the palm in parts of the mean hand's palm length;
            above zero as on a right hand.
    """

    side: Side | None
    curl: float
    thumb_height: float


def find_side(samples: np.ndarray) -> SideEvidence:
    """Classify keypoints [T, 25, 3] as left or right, in any axes and unit; NaN if not seen.

    Fingers bend to the palm only, so bones turn about an axis that points to the thumb on a right
    hand and away from it on a left one. If they hardly bend, the base of the thumb is used, which
    is on the palm's side of the metacarpals.
    """
    across = samples[:, KNUCKLE_NODES[0]] - samples[:, KNUCKLE_NODES[-1]]
    votes = []
    for chain in FINGER_CHAINS:
        bones = np.diff(samples[:, chain_indices(chain)[1:]], axis=1)
        turns = np.cross(bones[:, :-1], bones[:, 1:])
        size = np.linalg.norm(bones[:, :-1], axis=-1) * np.linalg.norm(bones[:, 1:], axis=-1)
        size = size * np.linalg.norm(across, axis=-1)[:, None]
        triple = np.einsum("tjx,tx->tj", turns, across)
        votes.append(np.divide(triple, size, out=np.full_like(size, np.nan), where=size > 0))
    curl = _mean(np.concatenate(votes, axis=1))
    height = _thumb_height(samples, across)
    side: Side | None = None
    if abs(curl) >= MIN_CURL:
        side = "right" if curl > 0 else "left"
    elif abs(height) * _MEAN_PALM_M >= MIN_THUMB_HEIGHT:
        side = "right" if height > 0 else "left"
    return SideEvidence(side, curl, height)


def _thumb_height(samples: np.ndarray, across: np.ndarray) -> float:
    """Height of the thumb's base over wrist and knuckles, along a right hand's palm normal."""
    knuckles = samples[:, KNUCKLE_NODES].mean(axis=1)
    palm = knuckles - samples[:, WRIST_NODE]
    normal = np.cross(across, palm)
    up = np.einsum("tx,tx->t", samples[:, NODE_INDEX["thumb", "metacarpal"]] - knuckles, normal)
    size = np.linalg.norm(normal, axis=-1) * np.linalg.norm(palm, axis=-1)
    return _mean(np.divide(up, size, out=np.full_like(size, np.nan), where=size > 0))


def _mean(values: np.ndarray) -> float:
    """Mean of the finite values; zero if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else 0.0


def check_handedness(
    keypoints_m: np.ndarray, side: Side, *, where: str = "keypoints"
) -> SideEvidence:
    """Refuse keypoints of the other hand, which is the mirror image of this one.

    Args:
        keypoints_m: [T ≥ 1, 25, 3], any axes; NaN where a node is not seen.
        side: which hand they should be of.
        where: stream and recording, for the message.

    Returns:
        The evidence for it; its `side` is None where the hand shows neither.

    Raises:
        InvalidInputError: they are of the other hand.
        ShapeError: not [T ≥ 1, 25, 3].
    """
    evidence = find_side(seen_samples(keypoints_m, where=where))
    if evidence.side not in (None, side):
        raise InvalidInputError(
            f"{where}: got a {evidence.side} hand, expected a {side} one (bones curl by "
            f"{evidence.curl:+.2f}, a right hand's above zero); are the gloves or their streams "
            "swapped, or are the tracker's axes left-handed, which mirrors the hand?",
            fault="side",
            found=evidence.side,
        )
    return evidence
