"""Self-collision check of a hand: which fingers touch each other or the palm.

Fingers are capsules, the palm is a box, as in the twin. About half of all random postures are in
collision, and thus infeasible for a robot.
"""

from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.hands.robot_hand import NUM_FINGERS
from services.twin.hands import PALM_THICKNESS_M, TwinHand

# Half of the palm's box across and along the hand, metres; smaller than the twin's, whose box also
# covers the knuckles that the first phalanges turn in.
PALM_HALF_M: Final = (0.034, 0.036)
_NUM_LINKS: Final = 3
_PALM_SAMPLES: Final = np.linspace(0.0, 1.0, 6)


def touching(hand: TwinHand, joints_rad: np.ndarray) -> Bool[np.ndarray, "time 5"]:
    """Fingers, thumb … little, that touch another finger or the palm, for joint angles [T, 20].

    The first link of a finger rotates inside the palm and is not checked against it.
    """
    starts, ends, radii = _capsules(hand, joints_rad)
    found = np.zeros((len(starts), NUM_FINGERS), dtype=bool)
    for a, b in combinations(range(NUM_FINGERS), 2):
        p, q = np.divmod(np.arange(_NUM_LINKS**2), _NUM_LINKS)
        gap_m = segment_distance_m(starts[:, a, p], ends[:, a, p], starts[:, b, q], ends[:, b, q])
        meets = (gap_m < radii[a, p] + radii[b, q]).any(axis=1)
        found[:, a] |= meets
        found[:, b] |= meets
    return found | _in_palm(hand, starts, ends, radii)


def _capsules(hand: TwinHand, joints_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both ends [T, 5, 3, 3] of the links' axes, wrist coordinates, and radii [5, 3]; metres."""
    points = hand.kinematics.chain_points_m(joints_rad)
    starts, ends, radii = points[:, :, :-1], points[:, :, 1:].copy(), np.array(hand.shape.radii_m)
    # The tip is on the surface: the axis of the last capsule ends one radius before it.
    last = ends[:, :, 2] - starts[:, :, 2]
    length = np.linalg.norm(last, axis=-1, keepdims=True)
    ends[:, :, 2] -= last / length * radii[:, 2, None]
    return starts, ends, radii


def _in_palm(
    hand: TwinHand, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> Bool[np.ndarray, "time 5"]:
    depth_m = np.array([0.0, hand.palm_sign * 0.5 * PALM_THICKNESS_M, 0.0])
    half_m = np.array([PALM_HALF_M[0], 0.5 * PALM_THICKNESS_M, PALM_HALF_M[1]])
    along = (ends - starts)[:, :, 1:, None] * _PALM_SAMPLES[:, None]
    points = starts[:, :, 1:, None] + along - (hand.palm_centre_m - depth_m)
    outside = np.maximum(np.abs(points) - half_m, 0.0)
    reach = np.linalg.norm(outside, axis=-1).min(axis=-1)
    return np.asarray((reach < radii[:, 1:]).any(axis=-1))


def segment_distance_m(
    p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray
) -> Float64[np.ndarray, "*batch"]:
    """Distance of the segments p0–p1 and q0–q1, [..., 3] each; none may be a point.

    Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    along_p, along_q, between = p1 - p0, q1 - q0, p0 - q0
    pp, qq = _dot(along_p, along_p), _dot(along_q, along_q)
    pq, pb, qb = _dot(along_p, along_q), _dot(along_p, between), _dot(along_q, between)
    determinant = pp * qq - pq**2
    # For parallel segments any point of the first is valid.
    parallel = determinant < 1e-12 * pp * qq
    s = np.where(parallel, 0.0, (pq * qb - pb * qq) / np.where(parallel, 1.0, determinant))
    t = (pq * s.clip(0.0, 1.0) + qb) / qq
    t = t.clip(0.0, 1.0)
    s = ((pq * t - pb) / pp).clip(0.0, 1.0)
    gap = between + s[..., None] * along_p - t[..., None] * along_q
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("...k,...k->...", a, b))
