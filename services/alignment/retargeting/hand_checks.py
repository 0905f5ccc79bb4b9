"""Keypoints of a tracked hand in; whether unit, order of nodes and side are right, or a refusal.

Nothing here depends on the axes of the keypoints: lengths and distances tell unit and order, the
sense in which fingers curl tells left from right.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.skeleton import CHAINS, NODE_INDEX, NUM_KEYPOINTS, chain_indices
from dextouch.tactile.layout import Side
from services.alignment.retargeting.mean_hand import (
    FINGER_CHAINS,
    KNUCKLE_NODES,
    METACARPAL_NODES,
    PALM_NODES,
    WRIST_NODE,
    mean_hand_m,
)

# Many samples say no more about a shape than some hundred do.
MAX_SAMPLES: Final = 300
MAX_LOOKED_AT: Final = 6000
# A coordinate that is none in any unit; its square would be infinite before long.
NOWHERE: Final = 1e6
MIN_PALM_NODES: Final = 4
MIN_PAIRS: Final = 10
# A hand's size against the mean adult's: a child of six has 0.65, the largest adults 1.25.
SIZE_RANGE: Final = (0.55, 1.5)
UNITS: Final = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1 / 0.0254}
# How far distances of nodes differ between people: so much of the distance, and so much besides.
SPREAD_PART: Final = 0.12
SPREAD_M: Final = 0.004
MAX_PULL: Final = 5.0
# Measured: right orders of hands with bones varied by 8 % fit to at most 0.6 spreads, wrong ones to
# at least 0.7, and among all orders the right one was always best.
MAX_MISFIT: Final = 1.5
BETTER_ORDER: Final = 0.7
# Mean signed sine between bones of a finger. Stretched fingers may bend back by several degrees, so
# less than this shows no side.
MIN_CURL: Final = 0.15
MIN_THUMB_HEIGHT: Final = 0.003


class HandShape(NamedTuple):
    """How a tracked hand compares with the mean hand.

    `size` is its scale (1: the mean adult), `misfit` how far distances of its nodes are off, in
    spreads between people.
    """

    size: float
    misfit: float


@dataclass(frozen=True)
class SideEvidence:
    """Which hand the keypoints are of.

    Attributes:
        side: None where neither fingers nor thumb show it.
        curl: mean sine by which finger bones bend; above zero as a right hand's do.
        thumb_height: of the thumb's base over the palm in parts of the mean hand's palm length;
            above zero as on a right hand.
    """

    side: Side | None
    curl: float
    thumb_height: float


def seen_nodes(keypoints_m: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
    """A copy of keypoints in which all three numbers of what is no place are NaN."""
    nodes = np.array(keypoints_m, dtype=np.float64)
    # False for NaN, too.
    is_place = (np.abs(nodes) < NOWHERE).all(axis=-1)
    nodes[~is_place] = np.nan
    return nodes


def seen_samples(keypoints_m: np.ndarray, *, where: str) -> Float64[np.ndarray, "time 25 3"]:
    """Up to 300 samples, evenly spread over those that show the palm; NaN where a node is not seen.

    Raises:
        ShapeError: not [T ≥ 1, 25, 3].
        InvalidInputError: no sample shows four nodes of the palm.
    """
    keypoints = np.asarray(keypoints_m)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (NUM_KEYPOINTS, 3) or not len(keypoints):
        raise ShapeError(f"{where}: got shape {keypoints.shape}, expected [T ≥ 1, 25, 3]")
    looked_at = seen_nodes(_thinned(keypoints, MAX_LOOKED_AT))
    num_seen = np.isfinite(looked_at[:, PALM_NODES, 0]).sum(axis=1)
    if not (num_seen >= MIN_PALM_NODES).any():
        raise InvalidInputError(
            f"{where}: got at most {num_seen.max()} of the {len(PALM_NODES)} nodes of wrist and "
            f"palm in each of {len(looked_at)} samples, expected {MIN_PALM_NODES}: too few to tell "
            "how the hand is turned; record the hand where it is seen",
            fault="unseen",
        )
    return _thinned(looked_at[num_seen >= MIN_PALM_NODES], MAX_SAMPLES)


def _thinned(samples: np.ndarray, most: int) -> np.ndarray:
    return samples[np.linspace(0, len(samples) - 1, min(most, len(samples))).round().astype(int)]


def check_hand_shape(keypoints_m: np.ndarray, *, where: str = "keypoints") -> HandShape:
    """Refuse keypoints that are not metres of a human hand in our order of nodes.

    Args:
        keypoints_m: [T ≥ 1, 25, 3], any axes, of either hand; NaN where a node is not seen.
        where: stream and recording, for the message.

    Raises:
        InvalidInputError: another unit or order of nodes (named where it is known: `details`
            holds `fault` and `found`), or no hand, or too few nodes.
        ShapeError: not [T ≥ 1, 25, 3].
    """
    distances = _median_distances(seen_samples(keypoints_m, where=where))
    shape = _compared(distances, np.arange(NUM_KEYPOINTS))
    if shape is None:
        raise InvalidInputError(
            f"{where}: got too few nodes that are seen together, expected {MIN_PAIRS} bones or "
            "distances of the palm; record the hand where it is seen",
            fault="unseen",
        )
    others = [(found, name) for name, holds in _orders() if (found := _compared(distances, holds))]
    best, name = min(others, key=lambda pair: pair[0].misfit, default=(shape, ""))
    if best.misfit < BETTER_ORDER * shape.misfit and best.misfit < MAX_MISFIT:
        raise InvalidInputError(
            f"{where}: got nodes in another order: {name}; expected that of "
            "dextouch.hands.skeleton (wrist, then thumb … little, each from the metacarpal to the "
            "tip); resolve nodes by chain and joint (dextouch.hands.node_order)",
            fault="node_order",
            found=name,
        )
    if shape.misfit > MAX_MISFIT or shape.size <= 0:
        raise InvalidInputError(
            f"{where}: got bones and distances that are off those of a hand by {shape.misfit:.1f} "
            f"spreads between people, expected at most {MAX_MISFIT}; check unit and order of nodes",
            fault="no_hand",
        )
    _check_size(shape.size, where)
    return shape


def _check_size(size: float, where: str) -> None:
    low, high = SIZE_RANGE
    if low <= size <= high:
        return
    units = [name for name, factor in UNITS.items() if low <= size / factor <= high]
    told = f"these look like {units[0]}" if units else "no unit that we know makes it a hand"
    raise InvalidInputError(
        f"{where}: got a hand {size:.3g} times as large as an adult's mean hand, expected "
        f"{low} … {high}: {told}; send metres",
        fault="unit",
        found=units[0] if units else None,
    )


def _rigid_pairs() -> Int64[np.ndarray, "pairs 2"]:
    """Nodes whose distance is the same in every posture: bones, and those of the palm."""
    pairs = []
    for chain in CHAINS:
        nodes = chain_indices(chain)
        pairs += list(zip([WRIST_NODE, *nodes[:-1]], nodes, strict=True))
    pairs += [(WRIST_NODE, knuckle) for knuckle in KNUCKLE_NODES]
    pairs += [*combinations(METACARPAL_NODES, 2), *combinations(KNUCKLE_NODES, 2)]
    thumb = NODE_INDEX["thumb", "metacarpal"]
    pairs += [(thumb, node) for node in (*METACARPAL_NODES, *KNUCKLE_NODES)]
    return np.array(pairs, dtype=np.int64)


_PAIRS: Final = _rigid_pairs()
_MEAN_HAND_M: Final = mean_hand_m("right")
_PAIR_LENGTHS_M: Final = np.linalg.norm(
    _MEAN_HAND_M[_PAIRS[:, 0]] - _MEAN_HAND_M[_PAIRS[:, 1]], axis=-1
)


def _median_distances(samples: np.ndarray) -> Float64[np.ndarray, "25 25"]:
    """Median distance of every two nodes; NaN where they are never seen together."""
    first, second = np.triu_indices(NUM_KEYPOINTS, 1)
    lengths = np.linalg.norm(samples[:, first] - samples[:, second], axis=-1)
    together = np.isfinite(lengths).any(axis=0)
    distances = np.full((NUM_KEYPOINTS, NUM_KEYPOINTS), np.nan)
    distances[first[together], second[together]] = np.nanmedian(lengths[:, together], axis=0)
    return np.fmax(distances, distances.T)


def _compared(distances: np.ndarray, holds: np.ndarray) -> HandShape | None:
    """The mean hand against nodes in the order `holds` (−1: none of ours); None if too few."""
    places = np.full(NUM_KEYPOINTS, -1)
    places[holds[holds >= 0]] = np.flatnonzero(holds >= 0)
    at = places[_PAIRS]
    found = np.where((at >= 0).all(axis=1), distances[at[:, 0], at[:, 1]], np.nan)
    is_known = np.isfinite(found)
    if np.count_nonzero(is_known) < MIN_PAIRS:
        return None
    lengths, mean = found[is_known], _PAIR_LENGTHS_M[is_known]
    size = float(np.median(lengths / mean))
    if size <= 0:
        return HandShape(size, np.inf)
    off = (lengths / size - mean) / (SPREAD_PART * mean + SPREAD_M)
    return HandShape(size, float(np.sqrt(np.square(np.clip(off, -MAX_PULL, MAX_PULL)).mean())))


@lru_cache(maxsize=1)
def _orders() -> tuple[tuple[str, np.ndarray], ...]:
    """Other orders than ours that trackers and their users produce, with a name for each."""
    orders = []
    for chains in permutations(CHAINS):
        for is_turned, is_wrist_last in ((False, False), (True, False), (False, True)):
            fingers: list[int] = []
            for chain in chains:
                nodes = chain_indices(chain)
                fingers += reversed(nodes) if is_turned else nodes
            holds = [*fingers, WRIST_NODE] if is_wrist_last else [WRIST_NODE, *fingers]
            if holds == list(range(NUM_KEYPOINTS)):
                continue
            name = f"{'' if is_wrist_last else 'wrist, '}{', '.join(chains)}"
            name += ", wrist" if is_wrist_last else ""
            name += ", each from the tip to the metacarpal" if is_turned else ""
            orders.append((name, np.array(holds)))
    # The base of the metacarpal taken for the knuckle, and so on.
    shifted = np.full(NUM_KEYPOINTS, -1)
    shifted[WRIST_NODE] = WRIST_NODE
    for chain in CHAINS:
        nodes = chain_indices(chain)
        shifted[nodes[1:]] = nodes[:-1]
    orders.append(("every finger one joint off, without its tip", shifted))
    return tuple(orders)


def find_side(samples: np.ndarray) -> SideEvidence:
    """Which hand keypoints [T, 25, 3] are of, in any axes and unit; NaN where not seen.

    Fingers bend to the palm only, so bones turn about an axis that points to the thumb on a right
    hand and away from it on a left one. Where they hardly bend, the base of the thumb tells, which
    lies on the palm's side of the metacarpals.
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
    elif abs(height) * np.linalg.norm(_MEAN_HAND_M[KNUCKLE_NODES[1]]) >= MIN_THUMB_HEIGHT:
        side = "right" if height > 0 else "left"
    return SideEvidence(side, curl, height)


def _thumb_height(samples: np.ndarray, across: np.ndarray) -> float:
    """Of the thumb's base over wrist and knuckles, along a right hand's palm normal."""
    knuckles = samples[:, KNUCKLE_NODES].mean(axis=1)
    palm = knuckles - samples[:, WRIST_NODE]
    normal = np.cross(across, palm)
    up = np.einsum("tx,tx->t", samples[:, NODE_INDEX["thumb", "metacarpal"]] - knuckles, normal)
    size = np.linalg.norm(normal, axis=-1) * np.linalg.norm(palm, axis=-1)
    return _mean(np.divide(up, size, out=np.full_like(size, np.nan), where=size > 0))


def _mean(values: np.ndarray) -> float:
    """Mean of what is known; zero, which says nothing, where nothing is."""
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
        What speaks for it; its `side` is None where the hand shows neither.

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
