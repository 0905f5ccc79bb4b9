"""Checks that tracked keypoints are the expected human hand in metres, in our order of nodes."""

from functools import lru_cache
from itertools import combinations, permutations, product
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import (
    CHAINS,
    FINGER_CHAINS,
    KNUCKLE_NODES,
    METACARPAL_NODES,
    NODE_INDEX,
    NUM_KEYPOINTS,
    PALM_NODES,
    WRIST_NODE,
    chain_indices,
    mean_hand_m,
)
from dextouch.tactile.layout import Side

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
MIN_THUMB_HEIGHT_M: Final = 0.003


def checked_keypoints(
    keypoints_m: np.ndarray, *, where: str = "keypoints"
) -> Float64[np.ndarray, "time 25 3"]:
    """The keypoints as contiguous float64; raises ShapeError: not [T ≥ 1, 25, 3]."""
    keypoints = np.ascontiguousarray(keypoints_m, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (NUM_KEYPOINTS, 3) or not len(keypoints):
        raise ShapeError(f"{where}: got shape {keypoints.shape}, expected [T ≥ 1, 25, 3]")
    return keypoints


def seen_nodes(keypoints_m: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
    """A copy of keypoints in which nodes with any invalid coordinate are NaN throughout."""
    nodes = np.array(keypoints_m, dtype=np.float64)
    # False for NaN, too.
    is_place = (np.abs(nodes) < NOWHERE).all(axis=-1)
    nodes[~is_place] = np.nan
    return nodes


def seen_samples(keypoints_m: np.ndarray, *, where: str) -> Float64[np.ndarray, "time 25 3"]:
    """Up to 300 samples, evenly spread over those that show the palm; NaN where a node is not seen.

    Raises ShapeError: not [T ≥ 1, 25, 3]; InvalidInputError: none shows four nodes of the palm.
    """
    looked_at = seen_nodes(thinned(checked_keypoints(keypoints_m, where=where), MAX_LOOKED_AT))
    num_seen = np.isfinite(looked_at[:, PALM_NODES, 0]).sum(axis=1)
    if not (num_seen >= MIN_PALM_NODES).any():
        raise InvalidInputError(
            f"{where}: got at most {num_seen.max()} of the {len(PALM_NODES)} nodes of wrist and "
            f"palm in each of {len(looked_at)} samples, expected {MIN_PALM_NODES}: too few to tell "
            "how the hand is turned; record the hand where it is seen",
            fault="unseen",
        )
    return thinned(looked_at[num_seen >= MIN_PALM_NODES], MAX_SAMPLES)


def thinned(samples: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the samples, evenly spread."""
    return samples[np.linspace(0, len(samples) - 1, min(most, len(samples))).round().astype(int)]


def check_hand_shape(keypoints_m: np.ndarray, *, where: str = "keypoints") -> float:
    """Size of a hand (1: the mean adult); refuses what is none in metres, in our order of nodes.

    Keypoints are in any axes, of either hand; a node that is not seen is NaN. Raises ShapeError:
    not [T ≥ 1, 25, 3]; InvalidInputError: another unit or order of nodes (if it is known, `details`
    holds `fault` and `found`), no hand, or too few nodes.
    """
    distances = _median_distances(seen_samples(keypoints_m, where=where))
    sizes, misfits = _compared(distances, _orders()[1])
    size, misfit = float(sizes[0]), float(misfits[0])
    if np.isnan(misfit):
        raise InvalidInputError(
            f"{where}: got too few nodes that are seen together, expected {MIN_PAIRS} bones or "
            "distances of the palm; record the hand where it is seen",
            fault="unseen",
        )
    best = int(np.nanargmin(misfits))
    if misfits[best] < min(BETTER_ORDER * misfit, MAX_MISFIT):
        name = _orders()[0][best]
        raise InvalidInputError(
            f"{where}: got nodes in another order: {name}; expected that of "
            "dextouch.hands.NODES (wrist, then thumb … little, each from the metacarpal to the "
            "tip); resolve nodes by chain and joint (dextouch.hands.node_order)",
            fault="node_order",
            found=name,
        )
    if misfit > MAX_MISFIT:
        raise InvalidInputError(
            f"{where}: got bones and distances that are off those of a hand by {misfit:.1f} "
            f"spreads between people, expected at most {MAX_MISFIT}; check unit and order of nodes",
            fault="no_hand",
        )
    low, high = SIZE_RANGE
    if not low <= size <= high:
        units = [name for name, factor in UNITS.items() if low <= size / factor <= high]
        hint = f"these look like {units[0]}" if units else "no unit that we know makes it a hand"
        raise InvalidInputError(
            f"{where}: got a hand {size:.3g} times as large as an adult's mean hand, expected "
            f"{low} … {high}: {hint}; send metres",
            fault="unit",
            found=units[0] if units else None,
        )
    return size


def check_handedness(
    keypoints_m: np.ndarray, side: Side, *, where: str = "keypoints"
) -> Side | None:
    """The side that a hand shows, None where it shows neither; refuses the mirror image.

    Bones turn about an axis that points to the thumb on a right hand; if they hardly bend, the base
    of the thumb decides, which is on the palm's side of the metacarpals. Raises InvalidInputError:
    they are of the other hand; ShapeError: not [T ≥ 1, 25, 3].
    """
    samples = seen_samples(keypoints_m, where=where)
    across = samples[:, KNUCKLE_NODES[0]] - samples[:, KNUCKLE_NODES[-1]]
    fingers = samples[:, [chain_indices(chain)[1:] for chain in FINGER_CHAINS]]
    bones = np.diff(fingers, axis=2)
    lengths = np.linalg.norm(bones, axis=-1)
    turns = np.cross(bones[:, :, :-1], bones[:, :, 1:])
    scale = lengths[..., :-1] * lengths[..., 1:] * np.linalg.norm(across, axis=-1)[:, None, None]
    curl = _mean_ratio(np.einsum("tfjx,tx->tfj", turns, across), scale)
    found: Side | None = None
    if abs(curl) >= MIN_CURL:
        found = "right" if curl > 0 else "left"
    elif abs(height := _thumb_height_m(samples, across)) >= MIN_THUMB_HEIGHT_M:
        found = "right" if height > 0 else "left"
    if found not in (None, side):
        raise InvalidInputError(
            f"{where}: got a {found} hand, expected a {side} one (bones curl by {curl:+.2f}, a "
            "right hand's above zero); are the gloves or their streams swapped, or are the "
            "tracker's axes left-handed, which mirrors the hand?",
            fault="side",
            found=found,
        )
    return found


def _thumb_height_m(samples: np.ndarray, across: np.ndarray) -> float:
    """Height of the thumb's base along a right hand's palm normal, at the size of the mean hand."""
    knuckles = samples[:, KNUCKLE_NODES].mean(axis=1)
    palm = knuckles - samples[:, WRIST_NODE]
    normal = np.cross(across, palm)
    up = np.einsum("tx,tx->t", samples[:, NODE_INDEX["thumb", "metacarpal"]] - knuckles, normal)
    scale = np.linalg.norm(normal, axis=-1) * np.linalg.norm(palm, axis=-1)
    return _mean_ratio(up, scale) * float(np.linalg.norm(_MEAN_HAND_M[KNUCKLE_NODES[1]]))


def _mean_ratio(values: np.ndarray, scale: np.ndarray) -> float:
    ratios = np.divide(values, scale, out=np.full_like(scale, np.nan), where=scale > 0)
    known = ratios[np.isfinite(ratios)]
    return float(known.mean()) if known.size else 0.0


def _rigid_pairs() -> Int64[np.ndarray, "pairs 2"]:
    """Pairs of nodes at a constant distance in every posture: bones, and within the palm."""
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


def _compared(
    distances: np.ndarray, places: np.ndarray
) -> tuple[Float64[np.ndarray, " orders"], Float64[np.ndarray, " orders"]]:
    """Size and misfit of the mean hand for each order of nodes; NaN where too little is seen."""
    at = places[:, _PAIRS]
    found = np.where((at >= 0).all(axis=2), distances[at[..., 0], at[..., 1]], np.nan)
    is_enough = np.isfinite(found).sum(axis=1) >= MIN_PAIRS
    sizes = np.full(len(places), np.nan)
    misfits = np.full(len(places), np.nan)
    sizes[is_enough] = np.nanmedian(found[is_enough] / _PAIR_LENGTHS_M, axis=1)
    # Nodes that lie upon each other have no size, and fit nothing.
    misfits[sizes == 0] = np.inf
    good = sizes > 0
    off = found[good] / sizes[good, None] - _PAIR_LENGTHS_M
    off = np.clip(off / (SPREAD_PART * _PAIR_LENGTHS_M + SPREAD_M), -MAX_PULL, MAX_PULL)
    misfits[good] = np.sqrt(np.nanmean(np.square(off), axis=1))
    return sizes, misfits


@lru_cache(maxsize=1)
def _orders() -> tuple[list[str], Int64[np.ndarray, "orders 25"]]:
    """Known orders of nodes, ours first: names, and where each of our nodes is; −1 if absent."""
    names, places = [], []
    for is_wrist_last, is_turned in product((False, True), repeat=2):
        for chains in permutations(CHAINS):
            parts = [("wrist", [WRIST_NODE])]
            fingers = [(c, chain_indices(c)[:: -1 if is_turned else 1]) for c in chains]
            parts = fingers + parts if is_wrist_last else parts + fingers
            turned = ", each from the tip to the metacarpal" if is_turned else ""
            names.append(", ".join(name for name, _ in parts) + turned)
            places.append(np.argsort([node for _, nodes in parts for node in nodes]))
    # The base of the metacarpal taken for the knuckle, and so on.
    shifted = np.full(NUM_KEYPOINTS, -1)
    shifted[WRIST_NODE] = WRIST_NODE
    for chain in CHAINS:
        nodes = chain_indices(chain)
        shifted[nodes[:-1]] = nodes[1:]
    return [*names, "every finger one joint off, without its tip"], np.array([*places, shifted])
