"""Commands with which a position-controlled hand reproduces the forces of a human take.

A human recording contains reached poses: joint angles and wrists stop at the object, however hard
they press. A servo that is commanded to a reached pose exerts no force and drops the object. It
exerts stiffness × (commanded - reached), so the command must lead the reached pose by the force
that the glove measured, divided by the stiffness:

    q_commanded = q + Jᵀ f / k,   wrist_commanded = wrist + (F / k_F, M / k_M)

f is the force of each pad (fingertips, palm); F and M are their sum and moment. Taxels measure the
magnitude of a force, not its direction. The forces on a held object balance, except for its weight,
so the balanced forces nearest to the pads' normals are used. If these are nearly zero, nothing in
the hand opposes them (a palm against the other hand, a finger on a button), and the forces along
the normals are used.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from services.alignment.retargeting.wrist_transfer import fingertip_jacobians, robot_places_m

# Lever that converts moments to forces, about half the size of a grasp.
_LEVER_M: Final = 0.05
# Imbalances below this are tolerated.
_SLACK_N: Final = 1e-3
# A hand holds an object if the balanced forces are at least this share of the measured ones.
_HOLDING_SHARE: Final = 0.4
_PALM_SIGN: Final = {"left": -1.0, "right": 1.0}


@dataclass(frozen=True)
class HandServos:
    """Stiffness of every finger joint of a position-controlled hand, and of its wrist."""

    finger_nm_rad: float
    wrist_n_m: float
    wrist_nm_rad: float


@dataclass(frozen=True)
class HandCommands:
    """Commands for one hand: wrist poses, and joint angles inside their limits."""

    Ts_world_wrist: Float64[np.ndarray, "time 4 4"]
    joints_rad: Float64[np.ndarray, "time 20"]


def commands_from_touch(
    hand: RobotHand,
    Ts_world_wrist: np.ndarray,
    joints_rad: np.ndarray,
    pad_forces_n: np.ndarray,
    servos: HandServos,
) -> HandCommands:
    """Commands of one hand; without contact, exactly the poses to be reached.

    Poses are those of the robot's wrist [T, 4, 4], joint angles [T, 20] inside the limits, forces
    [T, 6] those of thumb … little fingertip and palm; the servos are those of the commanded hand.
    """
    forces_n = pressing_forces_n(hand, joints_rad, pad_forces_n)
    _, jacobian = fingertip_jacobians(hand, joints_rad)
    torques_nm = (np.swapaxes(jacobian, -1, -2) @ forces_n[:, :NUM_FINGERS, :, None])[..., 0]
    led = joints_rad + torques_nm.reshape(-1, NUM_JOINTS) / servos.finger_nm_rad
    turn_nm = np.cross(robot_places_m(joints_rad, hand), forces_n).sum(axis=1)
    lead = transform(
        rotation_from_vector(turn_nm / servos.wrist_nm_rad),
        forces_n.sum(axis=1) / servos.wrist_n_m,
    )
    return HandCommands(Ts_world_wrist @ lead, np.clip(led, hand.lower_rad, hand.upper_rad))


def pressing_forces_n(
    hand: RobotHand, joints_rad: np.ndarray, pad_forces_n: np.ndarray
) -> Float64[np.ndarray, "time 6 3"]:
    """Force (N, wrist axes) of each fingertip and the palm, never larger than measured.

    Minimises Σ |f_i - F_i n_i|² / F_i, with the measured F_i along the normal n_i of pad i, plus
    the squared imbalance (of forces, and of moments about the centre of contact) over a slack.
    """
    forces = np.zeros((*pad_forces_n.shape, 3))
    touched = np.flatnonzero(pad_forces_n.any(axis=1))
    if touched.size:
        joints, felt = joints_rad[touched], pad_forces_n[touched]
        along = _normals(hand, joints) * felt[..., None]
        balanced = _balanced(robot_places_m(joints, hand), along, felt)
        left = (balanced * along).sum(axis=(1, 2)) / (along**2).sum(axis=(1, 2))
        holds = np.clip(left / _HOLDING_SHARE, 0.0, 1.0)[:, None, None]
        forces[touched] = holds * balanced + (1 - holds) * along
    return forces


def _normals(hand: RobotHand, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 6 3"]:
    """Normal of each pad: on the palmar side of the last phalanx, and of the palm."""
    tips = hand.joint_frames(joints_rad)[:, :, -1, :3, 1]
    palm = np.broadcast_to(np.array([0.0, 1.0, 0.0]), (len(tips), 1, 3))
    return np.concatenate([tips, palm], axis=1) * _PALM_SIGN[hand.side]


def _balanced(
    places_m: np.ndarray, along_n: np.ndarray, felt_n: np.ndarray
) -> Float64[np.ndarray, "time 6 3"]:
    """Closed form of the balance: f - W Aᵀ (A W Aᵀ + slack)⁻¹ A f, with W the measured forces."""
    share = (felt_n / felt_n.sum(axis=1, keepdims=True))[..., None]
    arms = places_m - (share * places_m).sum(axis=1, keepdims=True)
    A = np.zeros((*felt_n.shape, 6, 3))
    A[..., :3, :] = np.eye(3)
    A[..., 3:, :] = np.cross(np.eye(3), arms[..., None, :], axis=-1) / _LEVER_M
    weighted = felt_n[..., None, None] * A
    square = np.einsum("tiab,tidb->tad", weighted, A) + _SLACK_N * np.eye(6)
    unbalanced = np.einsum("tiab,tib->ta", A, along_n)
    multiplier = np.linalg.solve(square, unbalanced[..., None])[..., 0]
    return np.asarray(along_n - np.einsum("tiab,ta->tib", weighted, multiplier))
