"""Deterministic search for hand postures that hold a cylinder, cached per process and hand."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import apply, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.twin.hands import TwinHand, twin_hand
from services.twin.names import Domain
from services.twin.scene import FINGER_STIFFNESS_NM_RAD

# Draws of the first round and of each next one, and rounds (chosen).
_NUM_FIRST, _NUM_NEXT, _NUM_ROUNDS = 6000, 300, 45
_SHRINK: Final = 0.90  # chosen: _NUM_ROUNDS narrow the search to 1 %
# Cost weights relative to the distance between fingertip and cylinder.
_FACING_M_PER_RAD: Final = 0.004
_PLACE_M_PER_RAD: Final = 0.02
_ALONG: Final = 0.3
_BEND_M_PER_RAD2: Final = 0.0006
_INSIDE: Final = 3.0
_SMALL_RAD: Final = 1e-5
_NUM_OPENING_STEPS: Final = 10
_DAMPING_M2: Final = 1e-4
# Force shares of thumb … little finger in a squeeze: the thumb opposes all others.
_SHARES: Final = (1.0, 0.45, 0.30, 0.20, 0.05)


@dataclass(frozen=True)
class CylinderGrasp:
    """A cylinder in front of the palm and parallel to it, to be held by all five fingertips.

    Its axis runs across the hand at `distance_m` from the wrist origin, `z_m` along the fingers,
    rotated by `skew_rad` towards the fingertips on the thumb's side. Fingertips touch `below_rad`
    beyond the middle, seen from the palm; the thumb's at `thumb_m` along the axis. The table is
    `table_m` beyond the axis.
    """

    radius_m: float
    distance_m: float
    z_m: float
    skew_rad: float
    below_rad: float
    thumb_m: float
    table_m: float

    def axis_rotation(self) -> Float64[np.ndarray, "3 3"]:
        """R_wrist_axis from a frame whose x axis is the cylinder's axis."""
        return rotation_from_vector(np.array([0.0, self.skew_rad, 0.0]))

    def axis_point_m(self, hand: TwinHand) -> Float64[np.ndarray, "3"]:
        """The axis' point at x = 0 in the wrist frame of one hand."""
        return np.array([0.0, hand.palm_sign * self.distance_m, self.z_m])


def _costs(
    hand: TwinHand, grasp: CylinderGrasp, joints_rad: Float64[np.ndarray, "samples 20"]
) -> Float64[np.ndarray, "samples 5"]:
    """Cost of each finger of each sample, in metres."""
    T_axis_wrist = transform(grasp.axis_rotation().T, np.zeros(3))
    frames = T_axis_wrist @ hand.kinematics.joint_frames(joints_rad)
    chain_m = apply(T_axis_wrist, hand.kinematics.chain_points_m(joints_rad))
    shapes = [hand.distal_m(index) for index in range(5)]
    straight = np.array([length for length, _ in shapes])
    radii = np.array([radius for _, radius in shapes])
    local = np.zeros((5, 2, 3))
    local[:, 0, 2] = -straight
    local[:, 1, 2] = -0.5 * straight
    distal = apply(frames[:, :, 3], np.broadcast_to(local, (len(frames), 5, 2, 3)))
    # In the cylinder's cross section: u towards the fingers' side, v away from the palm.
    side = np.array([-1.0, 1.0, 1.0, 1.0, 1.0])
    axis = grasp.axis_rotation().T @ grasp.axis_point_m(hand)
    u = -(distal[..., 2] - axis[2]) * side[:, None]
    v = (distal[..., 1] - axis[1]) * hand.palm_sign
    reach = np.hypot(u, v) - (grasp.radius_m + radii[:, None])
    inwards = -np.stack([np.zeros_like(u), v * hand.palm_sign, -u * side[:, None]], axis=-1)
    inwards /= np.linalg.norm(inwards, axis=-1, keepdims=True) + 1e-12
    palmar = frames[:, :, 3, :3, 1] * hand.palm_sign
    facing = np.arccos(np.clip((palmar * inwards[:, :, 0]).sum(axis=-1), -1.0, 1.0))
    target_rad = np.arctan2(v[..., 0], u[..., 0]) - grasp.below_rad
    cost = np.abs(reach).mean(axis=-1)
    cost += _FACING_M_PER_RAD * facing + _PLACE_M_PER_RAD * np.abs(target_rad)
    cost += _ALONG * np.abs(distal[:, :, 0, 0] - axis[0] - grasp.thumb_m) * (side < 0)
    cost += _BEND_M_PER_RAD2 * (joints_rad.reshape(-1, 5, 4) ** 2 @ np.array([0.2, 4.0, 0.2, 0.5]))
    return cost + _INSIDE * _penetration(hand, grasp, axis, chain_m)


def _penetration(
    hand: TwinHand,
    grasp: CylinderGrasp,
    axis: Float64[np.ndarray, "3"],
    chain_m: Float64[np.ndarray, "samples 5 4 3"],
) -> Float64[np.ndarray, "samples 5"]:
    """Penetration of knuckles and phalanges into the cylinder or the table, in metres."""
    points = np.concatenate([chain_m[:, :, 1:3], 0.5 * (chain_m[:, :, :2] + chain_m[:, :, 1:3])], 2)
    distance = np.hypot(points[..., 1] - axis[1], points[..., 2] - axis[2])
    clearance = grasp.radius_m + np.array([row[1] for row in hand.shape.radii_m])[:, None] + 0.001
    inside = np.maximum(clearance - distance, 0.0).sum(axis=-1)
    height = grasp.distance_m + grasp.table_m - chain_m[:, :, 2:, 1] * hand.palm_sign
    tip_radius = np.array([row[2] for row in hand.shape.radii_m])[:, None]
    needed = 0.003 + tip_radius * np.array([1.0, 0.1])
    return inside + np.maximum(needed - height, 0.0).sum(axis=-1)


def _refine(
    hand: TwinHand,
    grasp: CylinderGrasp,
    start_rad: Float64[np.ndarray, "samples 20"],
    spread_rad: float,
) -> Float64[np.ndarray, "20"]:
    """Local search around the best start sample of each finger, independently per finger."""
    generator = np.random.default_rng(20)
    lower, upper = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    samples, best_cost, best = start_rad, np.full(5, np.inf), np.zeros((5, 4))
    for _ in range(_NUM_ROUNDS):
        costs = _costs(hand, grasp, samples)
        winner = costs.argmin(axis=0)
        for finger in np.flatnonzero(costs[winner, np.arange(5)] < best_cost):
            best_cost[finger] = costs[winner[finger], finger]
            best[finger] = samples[winner[finger], 4 * finger : 4 * finger + 4]
        steps = generator.normal(scale=spread_rad, size=(_NUM_NEXT, 20))
        samples = np.clip(best.ravel() + steps, lower, upper)
        spread_rad *= _SHRINK
    return best.ravel()


@lru_cache(maxsize=8)
def _searched(grasp: CylinderGrasp, domain: Domain) -> Float64[np.ndarray, "20"]:
    hand = twin_hand("right", domain)
    lower, upper = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    start = np.random.default_rng(10).uniform(lower, upper, size=(_NUM_FIRST, 20))
    return _refine(hand, grasp, start, spread_rad=0.3)


def holding(grasp: CylinderGrasp, domain: Domain) -> Float64[np.ndarray, "20"]:
    """Joint angles at which all fingertips just touch the cylinder."""
    return _searched(grasp, domain).copy()


def _fingertip_jacobian(
    hand: TwinHand, joints_rad: np.ndarray
) -> tuple[Float64[np.ndarray, "5 3"], Float64[np.ndarray, "5 3 4"]]:
    """Fingertips (m) and how each moves with its own finger's joints (m/rad)."""
    steps = np.concatenate([joints_rad[None], joints_rad + _SMALL_RAD * np.eye(20)])
    tips = hand.kinematics.fingertips_m(steps)
    moved = ((tips[1:] - tips[0]) / _SMALL_RAD).reshape(5, 4, 5, 3)
    return tips[0], np.stack([moved[finger, :, finger].T for finger in range(5)])


def opened(grasp: CylinderGrasp, domain: Domain, *, gap_m: float) -> Float64[np.ndarray, "20"]:
    """Joint angles with all fingertips retracted from the held cylinder by `gap_m`."""
    hand = twin_hand("right", domain)
    joints = holding(grasp, domain)
    tips, _ = _fingertip_jacobian(hand, joints)
    outwards = -_towards_axis(hand, grasp, tips)
    for _ in range(_NUM_OPENING_STEPS):
        _, jacobian = _fingertip_jacobian(hand, joints)
        square = jacobian @ np.swapaxes(jacobian, 1, 2) + _DAMPING_M2 * np.eye(3)
        step = (outwards * (gap_m / _NUM_OPENING_STEPS))[..., None]
        turn = np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(square, step)
        joints = np.clip(
            joints + turn.ravel(), hand.kinematics.lower_rad, hand.kinematics.upper_rad
        )
    return joints


def pressing(grasp: CylinderGrasp, domain: Domain, *, force_n: float) -> Float64[np.ndarray, "20"]:
    """Servo targets, perhaps beyond limits, that squeeze the cylinder with about `force_n`.

    They are offset by Jᵀ f / stiffness: the thumb has the full force, the fingers share it.
    """
    hand = twin_hand("right", domain)
    joints = holding(grasp, domain)
    tips, jacobian = _fingertip_jacobian(hand, joints)
    forces = force_n * np.array(_SHARES)[:, None] * _towards_axis(hand, grasp, tips)
    torques_nm = np.einsum("fxj,fx->fj", jacobian, forces)
    return joints + torques_nm.ravel() / FINGER_STIFFNESS_NM_RAD


def _towards_axis(
    hand: TwinHand, grasp: CylinderGrasp, tips_m: Float64[np.ndarray, "5 3"]
) -> Float64[np.ndarray, "5 3"]:
    """Unit vectors from fingertips to the axis, parallel to the palm to keep the cylinder in."""
    across = grasp.axis_rotation()[:, 2]
    side = np.sign((grasp.axis_point_m(hand) - tips_m) @ across)
    return side[:, None] * across
