"""Methods that transfer a human take to robot commands, by wrist, fingers and force."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from benchmarks.closure.touch_commands import HandCommands, HandServos, commands_from_touch
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import HandTrajectory
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile import pad_forces_n
from dextouch.tactile.layout import SIDES, Side
from services.alignment.retargeting import HandRetargeter
from services.alignment.retargeting.wrist_transfer import (
    MatchedPoints,
    anchored_joints,
    constant_offset_m,
    matched_points,
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
