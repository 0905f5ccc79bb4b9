"""Commands that make a position-controlled hand press as hard as the human did.

What a person does is recorded as it was reached: joint angles and wrists stop at the object,
however hard they press. A servo that is commanded to go exactly there presses with nothing and
drops it. It presses with stiffness × (commanded - reached); so the command must lead what was
reached by the force that the glove felt, over the stiffness:

    q_commanded = q + Jᵀ f / k,   wrist_commanded = wrist + (F / k_F, M / k_M)

f is the force with which each place (fingertips, palm) presses; F and M are their sum and moment.
Taxels measure how hard, not in which direction: pads are round. What a hand holds is pressed from
several sides that balance each other, but for weight. So forces along the pads' normals are
changed as little as balance asks. If little is left of them then, nothing in the hand balances
them (a palm against the other hand, a finger on a button) and they stay along the normals.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from benchmarks.closure.touch_anchor import fingertip_jacobians
from benchmarks.closure.wrist_transfer import NUM_PADS, robot_places_m
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand

# Turning is weighed against pushing with a lever of about half a grasp.
_LEVER_M: Final = 0.05
# Forces that are out of balance by less are left so.
_SLACK_N: Final = 1e-3
# A hand holds something if balance leaves at least this share of what was felt.
_HOLDING_SHARE: Final = 0.4
_PALM_SIGN: Final = {"left": -1.0, "right": 1.0}


@dataclass(frozen=True)
class HandServos:
    """How stiff a position-controlled hand and its arm are, measured or from the maker.

    Args:
        finger_nm_rad: of every finger joint.
        wrist_n_m: of the wrist against being pushed; a stiffer arm leads less.
        wrist_nm_rad: of the wrist against being turned.
    """

    finger_nm_rad: float
    wrist_n_m: float
    wrist_nm_rad: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InvalidInputError(f"hand servos: got {name} {value}, expected > 0")


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
    """Commands of one hand; where nothing touches, exactly what is to be reached.

    Args:
        hand: kinematics.
        Ts_world_wrist: [T, 4, 4] poses that the robot's wrist is to reach.
        joints_rad: [T, 20] angles that it is to reach, inside the limits.
        pad_forces_n: [T, 6] N, how hard thumb … little fingertip and palm are to press.
        servos: stiffness of the hand that will be commanded.

    Raises:
        ShapeError: lengths that differ.
        NonFiniteError: NaN or infinity.
        InvalidInputError: a negative force.
    """
    Ts = np.asarray(Ts_world_wrist, dtype=np.float64)
    joints = np.asarray(joints_rad, dtype=np.float64)
    if Ts.shape != (len(joints), 4, 4):
        raise ShapeError(
            f"touch commands: got poses {Ts.shape} and joints {joints.shape}, expected [T, 4, 4] "
            f"and [T, {NUM_JOINTS}]"
        )
    forces_n = pressing_forces_n(hand, joints, pad_forces_n)
    _, jacobian = fingertip_jacobians(hand, joints)
    torques_nm = (np.swapaxes(jacobian, -1, -2) @ forces_n[:, :NUM_FINGERS, :, None])[..., 0]
    led = joints + torques_nm.reshape(-1, NUM_JOINTS) / servos.finger_nm_rad
    turn_nm = np.cross(robot_places_m(joints, hand), forces_n).sum(axis=1)
    lead = transform(
        rotation_from_vector(turn_nm / servos.wrist_nm_rad),
        forces_n.sum(axis=1) / servos.wrist_n_m,
    )
    return HandCommands(Ts @ lead, np.clip(led, hand.lower_rad, hand.upper_rad))


def pressing_forces_n(
    hand: RobotHand, joints_rad: np.ndarray, pad_forces_n: np.ndarray
) -> Float64[np.ndarray, "time 6 3"]:
    """The force (N, wrist axes) with which fingertips and palm press, and never more than felt.

    Minimises Σ |f_i - F_i n_i|² / F_i, F_i felt along the normal n_i of place i, plus the square of
    what is out of balance (forces, and torques about the middle of touch) over a slack.

    Raises:
        ShapeError: lengths that differ.
        NonFiniteError: NaN or infinity.
        InvalidInputError: a negative force.
    """
    felt_n = np.asarray(pad_forces_n, dtype=np.float64)
    if felt_n.shape != (len(joints_rad), NUM_PADS):
        raise ShapeError(
            f"touch commands: got forces {felt_n.shape}, expected [{len(joints_rad)}, {NUM_PADS}]"
        )
    if not np.isfinite(felt_n).all():
        raise NonFiniteError("touch commands: forces hold NaN or infinity; mask those samples")
    if (felt_n < 0).any():
        raise InvalidInputError(
            f"touch commands: got {felt_n.min()} N, expected 0 or more; tare the glove"
        )
    forces = np.zeros((*felt_n.shape, 3))
    touched = np.flatnonzero(felt_n.any(axis=1))
    if touched.size:
        joints, felt = np.asarray(joints_rad, dtype=np.float64)[touched], felt_n[touched]
        along = _normals(hand, joints) * felt[..., None]
        balanced = _balanced(robot_places_m(joints, hand), along, felt)
        left = (balanced * along).sum(axis=(1, 2)) / (along**2).sum(axis=(1, 2))
        holds = np.clip(left / _HOLDING_SHARE, 0.0, 1.0)[:, None, None]
        forces[touched] = holds * balanced + (1 - holds) * along
    return forces


def _normals(hand: RobotHand, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 6 3"]:
    """Where each place presses: off the last phalanx on its palm side, and off the palm."""
    tips = hand.joint_frames(joints_rad)[:, :, -1, :3, 1]
    palm = np.broadcast_to(np.array([0.0, 1.0, 0.0]), (len(tips), 1, 3))
    return np.concatenate([tips, palm], axis=1) * _PALM_SIGN[hand.side]


def _balanced(
    places_m: np.ndarray, along_n: np.ndarray, felt_n: np.ndarray
) -> Float64[np.ndarray, "time 6 3"]:
    """Closed form of the balance: f - W Aᵀ (A W Aᵀ + slack)⁻¹ A f, W the felt forces."""
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
