"""Keypoints of a tracked hand in, where the robot's joints and fingertips should be out.

A human hand has other proportions than the robot's, so positions cannot be copied; directions
can. The unit vectors of the human bones are chained again with the robot's bone lengths, starting
at the robot's own knuckle ("bone-direction re-chaining").
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.robot_hand import NUM_JOINTS, RobotHand
from dextouch.hands.skeleton import CHAINS, NUM_KEYPOINTS, solver_indices

# Proximal phalanx of an index finger, children to large adults: outside, the unit is wrong.
INDEX_PROXIMAL_RANGE_M = (0.025, 0.060)
BONE_RANGE_M = (0.003, 0.150)
_SOLVER_NODES = [solver_indices(chain) for chain in CHAINS]
_INDEX_FINGER = CHAINS.index("index")


@dataclass(frozen=True)
class FingerTargets:
    """What the solver aims at, for every step and finger (thumb … little).

    Attributes:
        from_knuckle_m: PIP, DIP and tip minus MCP, at the robot's bone lengths, wrist axes; zero
            where not usable.
        usable: whether all four keypoints of the finger were there and made sense.
    """

    from_knuckle_m: Float64[np.ndarray, "time 5 3 3"]
    usable: Bool[np.ndarray, "time 5"]


def bone_lengths_m(hand: RobotHand) -> Float64[np.ndarray, "5 3"]:
    """MCP–PIP, PIP–DIP and DIP–tip of a robot hand (of its thumb: CMC–MCP, MCP–IP, IP–tip)."""
    points = hand.chain_points_m(np.zeros((1, NUM_JOINTS)))[0]
    return np.asarray(np.linalg.norm(np.diff(points, axis=1), axis=-1))


def normalize_hand(
    keypoints_m: np.ndarray, hand: RobotHand, valid: np.ndarray | None = None
) -> FingerTargets:
    """Targets for the robot's fingers from tracked keypoints.

    Args:
        keypoints_m: [T, 25, 3] in the robot's wrist axes (fingers along -z, thumb side +x),
            metres, order of `dextouch.hands.skeleton`. NaN or infinity marks a missing node.
        hand: the robot hand of the same side.
        valid: bool [T, 25], what the tracker itself trusts; None trusts every finite node.

    Raises:
        ShapeError: not [T ≥ 1, 25, 3], or `valid` not [T, 25].
        InvalidInputError: the index finger's proximal bone is not 25–60 mm long: most likely
            the numbers are millimetres or the nodes are in another order.
    """
    keypoints = np.asarray(keypoints_m, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (NUM_KEYPOINTS, 3) or not len(keypoints):
        raise ShapeError(f"keypoints: got shape {keypoints.shape}, expected [T ≥ 1, 25, 3]")
    seen = np.asarray(np.isfinite(keypoints).all(axis=-1))
    if valid is not None:
        if np.shape(valid) != seen.shape:
            raise ShapeError(f"keypoints: got valid {np.shape(valid)}, expected {seen.shape}")
        seen &= np.asarray(valid, dtype=bool)
    points = np.where(seen[..., None], keypoints, 0.0)[:, _SOLVER_NODES]
    complete = np.asarray(seen[:, _SOLVER_NODES].all(axis=-1))
    bones = np.diff(points, axis=2)
    lengths = np.linalg.norm(bones, axis=-1)
    _check_unit(lengths[:, _INDEX_FINGER, 0][complete[:, _INDEX_FINGER]])
    shortest, longest = BONE_RANGE_M
    usable = complete & ((lengths >= shortest) & (lengths <= longest)).all(axis=-1)
    directions = bones / np.where(lengths > 0, lengths, 1.0)[..., None]
    chained = np.cumsum(directions * bone_lengths_m(hand)[..., None], axis=2)
    return FingerTargets(np.where(usable[..., None, None], chained, 0.0), usable)


def _check_unit(proximal_m: np.ndarray) -> None:
    if not proximal_m.size:
        return
    median = float(np.median(proximal_m))
    low, high = INDEX_PROXIMAL_RANGE_M
    if not low <= median <= high:
        hint = "these look like millimetres" if low * 1e3 <= median <= high * 1e3 else "check nodes"
        raise InvalidInputError(
            f"keypoints: the index finger's proximal bone measures {median:.4g}, expected "
            f"{low} … {high} m ({hint}); send metres in the order of dextouch.hands.skeleton",
            got=median,
        )
