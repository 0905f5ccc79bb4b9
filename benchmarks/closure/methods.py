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
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from dextouch.tactile import pad_forces_n
from dextouch.tactile.layout import SIDES, Side
from services.alignment.retargeting import HandRetargeter
from services.alignment.retargeting.wrist_transfer import (
    MatchedPoints,
    anchored_joints,
    constant_offset_m,
    fingertip_jacobians,
    matched_points,
    robot_places_m,
    shifted_wrist,
    touch_offsets_m,
    touch_shares,
)
from services.alignment.synchronization.resampling import (
    GridPlacement,
    grid_times_ns,
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TruthEpisode, TruthStream
from services.twin.mjcf import FINGER_STIFFNESS_NM_RAD, WRIST_STIFFNESS_N_M, WRIST_STIFFNESS_NM_RAD
from services.twin.simulation import MODEL_RATE_HZ

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


Wrist = Literal["copied", "constant", "touch"]
TWIN_SERVOS: Final = HandServos(
    finger_nm_rad=FINGER_STIFFNESS_NM_RAD,
    wrist_n_m=WRIST_STIFFNESS_N_M,
    wrist_nm_rad=WRIST_STIFFNESS_NM_RAD,
)
_GRID_NS: Final = grid_times_ns(NUM_GRID_STEPS, float(MODEL_RATE_HZ))
_NS_PER_S: Final = 1e9
_GRID_S: Final = _GRID_NS / _NS_PER_S


@dataclass(frozen=True)
class Method:
    """A method to derive robot commands from a human take.

    `wrist`: the human's pose unchanged, with one offset for the take, or with a touch-dependent
    offset at every step. `anchors`: whether touching fingertips are moved to the human's positions.
    `presses`: whether commands are offset according to the measured touch.
    """

    wrist: Wrist
    anchors: bool
    presses: bool

    @property
    def name(self) -> str:
        """Label in tables."""
        fingers = ", fingertips anchored" if self.anchors else ""
        return f"{self.wrist} wrist{fingers}, {'pressing' if self.presses else 'as reached'}"


METHODS: Final = (
    Method("copied", anchors=False, presses=False),
    Method("constant", anchors=False, presses=False),
    Method("touch", anchors=True, presses=False),
    Method("copied", anchors=False, presses=True),
    Method("constant", anchors=False, presses=True),
    Method("touch", anchors=False, presses=True),
    Method("touch", anchors=True, presses=True),
)
OURS: Final = METHODS[-1]


@dataclass(frozen=True)
class RetargetedHand:
    """One hand of a take on the model grid."""

    hand: RobotHand
    Ts_world_human: Float64[np.ndarray, "steps 4 4"]
    joints_rad: Float64[np.ndarray, "steps 20"]
    points: MatchedPoints
    pad_forces_n: Float64[np.ndarray, "steps 6"]

    def offset_m(self, wrist: Wrist) -> Float64[np.ndarray, "steps 3"]:
        """Offset of the robot's wrist in the human wrist frame, at every step."""
        if wrist == "touch":
            return touch_offsets_m(self.points, self.pad_forces_n, _GRID_S)
        offset = np.zeros(3) if wrist == "copied" else constant_offset_m(self.points)
        return np.tile(offset, (len(self.joints_rad), 1))

    def commands(self, method: Method) -> HandCommands:
        """Commands of this hand at every step."""
        offset_m = self.offset_m(method.wrist)
        Ts_world_robot = shifted_wrist(self.Ts_world_human, offset_m)
        joints = self.joints_rad
        if method.anchors:
            shares = touch_shares(self.pad_forces_n, _GRID_S)
            joints = anchored_joints(self.hand, joints, self.points, offset_m, shares)
        if not method.presses:
            return HandCommands(Ts_world_robot, joints)
        return commands_from_touch(
            self.hand, Ts_world_robot, joints, self.pad_forces_n, TWIN_SERVOS
        )


@dataclass(frozen=True)
class RetargetedTake:
    """Both hands and the head of a human take, with the initial object poses."""

    left: RetargetedHand
    right: RetargetedHand
    Ts_world_camera_head: Float64[np.ndarray, "steps 4 4"]
    object_poses: Float64[np.ndarray, "objects 7"]


def retarget_take(episode: TruthEpisode) -> RetargetedTake:
    """Retarget both hands at their keypoint rate and resample everything to the model grid.

    Raises:
        InvalidInputError: an episode of robot hands, which has no keypoints.
    """
    if episode.attributes.domain != "human":
        raise InvalidInputError(
            f"closure: got episode {episode.attributes.episode_id} of the domain "
            f"{episode.attributes.domain}, expected human; there is nothing to retarget"
        )
    streams = episode.streams
    left, right = (_retargeted(streams, side) for side in SIDES)
    head = poses_on_grid(streams["head"].values, _placed(streams["head"]))
    return RetargetedTake(left, right, head, streams["object_poses"].values[0])


def _placed(stream: TruthStream) -> GridPlacement:
    period_ns = stream.descriptor.period_ns()
    at = place_on_grid(stream.t_ref_ns, _GRID_NS, period_ns=period_ns, max_gap_ns=3 * period_ns)
    if not at.valid.all():
        raise InvalidInputError(
            f"closure: stream {stream.descriptor.name} covers {int(at.valid.sum())} of "
            f"{len(_GRID_NS)} steps, expected all; record the whole take"
        )
    return at


def _retargeted(streams: dict[str, TruthStream], side: Side) -> RetargetedHand:
    keypoints, wrist, tactile = (
        streams[f"{name}_{side}"] for name in ("keypoints", "wrist", "tactile")
    )
    hand, at = RobotHand(side), _placed(keypoints)
    result = HandRetargeter(side).retarget(keypoints.values, t_s=keypoints.t_ref_ns / _NS_PER_S)
    joints_rad = vectors_on_grid(result.joints_rad, at)
    return RetargetedHand(
        hand,
        poses_on_grid(wrist.values, _placed(wrist)),
        joints_rad,
        matched_points(vectors_on_grid(keypoints.values, at), joints_rad, hand),
        vectors_on_grid(pad_forces_n(tactile.values), _placed(tactile)),
    )


def robot_trajectory(take: RetargetedTake, method: Method) -> HandTrajectory:
    """Robot commands at every step of the grid."""
    left, right = (hand.commands(method) for hand in (take.left, take.right))
    return HandTrajectory(
        left.Ts_world_wrist,
        right.Ts_world_wrist,
        left.joints_rad,
        right.joints_rad,
        take.Ts_world_camera_head,
    )
