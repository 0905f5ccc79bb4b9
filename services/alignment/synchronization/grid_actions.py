"""Hand trajectories, 67-D actions and figures of motion at the steps of the model's grid."""

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from dextouch.episodes import JOINTS, columns_of
from dextouch.hands.actions import AnchorPoses, HandTrajectory, actions_from_poses
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import Domain, Matrix
from dextouch.tactile.layout import FINGERS, SIDES, Side
from services.alignment.retargeting import HandRetargeter, RetargetResult, RetargetStatus
from services.alignment.retargeting.hand_retargeter import calibrated_profile
from services.alignment.retargeting.wrist import NUM_PADS, hand_axes_check, transfer_by_touch
from services.alignment.settings import WristChoice
from services.alignment.synchronization.recorded_streams import LoadedStream
from services.alignment.synchronization.resampling import (
    GridPlacement,
    place_on_grid,
    poses_on_grid,
    stream_gap_ns,
    vectors_on_grid,
)

NS_PER_S = 1e9
# Samples of a recording from which a hand's axes, side and unit are checked.
MAX_CHECKED = 2000
POSE_STREAMS = ("wrist_left", "wrist_right", "head")
TOUCH_STREAMS = ("tactile_left", "tactile_right")
# The influence of touch on wrists and fingertips lasts as long.
TOUCH_GAP_NS = 300_000_000
# What an action is made of; a take has at least one of a hand.
ACTION_STREAMS: Mapping[Domain, tuple[str, ...]] = {
    "human": (*POSE_STREAMS, "keypoints_left", "keypoints_right"),
    "robot": (*POSE_STREAMS, "joints_measured"),
}
# Slower than this is at rest: tracking noise of a wrist, and the slightest motion of a finger.
REST_M_S = 0.02
REST_RAD_S = 0.1


@dataclass(frozen=True)
class GriddedStreams:
    """Streams of which actions are made, and where steps of the grid are `at`.

    `TOUCH_STREAMS` are forces (N) of pads, which are placed each for itself (`pad_forces_n`),
    across gaps up to `max_gap_ns`, or `TOUCH_GAP_NS` if that is longer.
    """

    grid_ns: Int64[np.ndarray, " n"]
    streams: Mapping[str, LoadedStream]
    at: Mapping[str, GridPlacement]
    max_gap_ns: int = 0

    @property
    def valid(self) -> Bool[np.ndarray, " n"]:
        """Steps at which every stream can be read without reaching across a gap."""
        return np.logical_and.reduce([at.valid for at in self.at.values()])

    def poses(self, name: str) -> Float64[np.ndarray, "n 4 4"]:
        """Transforms of a pose stream at the steps; the identity if there is none."""
        if name not in self.streams:
            return np.broadcast_to(np.eye(4), (len(self.grid_ns), 4, 4))
        return poses_on_grid(self.streams[name].values, self.at[name])

    def vectors(self, name: str) -> Float64[np.ndarray, "n ..."]:
        """Values of a stream, such as joint angles (rad), at the steps."""
        return vectors_on_grid(self.streams[name].values, self.at[name])

    def pad_forces_n(self, side: Side) -> Float64[np.ndarray, "n 6"]:
        """Forces of a hand's pads at the steps; 0 where none is known, such as in long gaps."""
        forces_n = np.zeros((len(self.grid_ns), NUM_PADS))
        if (stream := self.streams.get(f"tactile_{side}")) is None:
            return forces_n
        period_ns = stream.descriptor.period_ns()
        gap_ns = max(stream_gap_ns(self.max_gap_ns, period_ns), TOUCH_GAP_NS)
        for pad, pad_n in enumerate(stream.values.T):
            known = np.isfinite(pad_n)
            t_ns = stream.t_ns[known]
            at = place_on_grid(t_ns, self.grid_ns, period_ns=period_ns, max_gap_ns=gap_ns)
            if at.valid.any():
                # At the edges forces are extrapolated.
                felt_n = np.maximum(vectors_on_grid(pad_n[known], at), 0.0)
                forces_n[:, pad] = np.where(at.valid, felt_n, 0.0)
        return forces_n


@dataclass(frozen=True)
class GridActions:
    """Actions on the grid; `commanded` is None where nothing was commanded.

    `absent` parts have no step, `unseen_fingers` are steps at which a finger was in a gap.
    """

    anchor: AnchorPoses
    measured: Float64[np.ndarray, "n 67"]
    commanded: Float64[np.ndarray, "n 67"] | None
    quality: dict[str, float]
    absent: tuple[str, ...] = ()
    unseen_fingers: Mapping[Side, Bool[np.ndarray, "n 5"]] = field(default_factory=dict)


@dataclass(frozen=True)
class RetargetedHand:
    """Joint angles of a hand at the steps, and where a finger was in a gap of its own."""

    joints_rad: Float64[np.ndarray, "n 20"]
    unseen: Bool[np.ndarray, "n 5"]
    quality: dict[str, float]


def commanded_streams(names: Collection[str]) -> tuple[str, ...]:
    """Streams of commanded actions: joints, and wrists tracked or commanded; () if none are."""
    wrists = [f"wrist_{side}" for side in SIDES]
    wrists = [f"{one}_commanded" for one in wrists if {one, f"{one}_commanded"} & set(names)]
    needed = ("joints_commanded", *wrists)
    return needed if wrists and set(needed) <= set(names) else ()


def place_streams(
    streams: Mapping[str, LoadedStream], grid_ns: np.ndarray, *, max_gap_ns: int
) -> GriddedStreams:
    """Find the neighbouring samples of every step in every stream, which may be slow."""
    at = {}
    for name, stream in streams.items():
        if name not in TOUCH_STREAMS:
            period_ns = stream.descriptor.period_ns()
            gap_ns = stream_gap_ns(max_gap_ns, period_ns)
            at[name] = place_on_grid(stream.t_ns, grid_ns, period_ns=period_ns, max_gap_ns=gap_ns)
    return GriddedStreams(grid_ns, streams, at, max_gap_ns)


def make_actions(
    gridded: GriddedStreams,
    domain: Domain,
    calibration: Mapping[str, Matrix],
    *,
    wrist: WristChoice = "tracked",
    max_gap_ns: int = 0,
) -> GridActions:
    """Measured and, where recorded, commanded actions, all relative to the measured first step.

    Human hands are retargeted. Parts that were not recorded have the identity as their pose, and
    joints at rest. `wrist` says where the robot's wrists are that stand for human ones; a finger
    may be missing for `max_gap_ns` (of slow streams longer).
    """
    left, right, head = (gridded.poses(name) for name in POSE_STREAMS)
    absent = [name for name in ACTION_STREAMS[domain] if name not in gridded.streams]
    hands: dict[Side, RetargetedHand] = {}
    joints_rad, quality = np.zeros((len(gridded.grid_ns), 40)), dict[str, float]()
    if domain == "human":
        hands = retarget_hands(gridded, calibration, max_gap_ns=max_gap_ns)
        for side, hand in hands.items():
            joints_rad[:, slice(0, 20) if side == "left" else slice(20, 40)] = hand.joints_rad
            quality |= hand.quality
            never = np.flatnonzero(hand.unseen.all(axis=0)).tolist()
            absent += [f"{FINGERS[finger]}_{side}" for finger in never]
            for finger in never:
                joints_rad[:, columns_of((f"{FINGERS[finger]}_{side}",))[JOINTS]] = 0.0
    elif "joints_measured" in gridded.streams:
        joints_rad = gridded.vectors("joints_measured")
    by_side = np.split(joints_rad, 2, axis=1)
    trajectory = HandTrajectory(left, right, by_side[0], by_side[1], head)
    if domain == "human" and wrist == "touch":
        trajectory, offsets = _moved_by_touch(gridded, trajectory)
        quality |= offsets
    if len(gridded.grid_ns) > 1:
        rate_hz = NS_PER_S / float(np.diff(gridded.grid_ns).mean())
        tracked = [side for side in SIDES if f"wrist_{side}" in gridded.streams]
        quality = {**quality, **motion_figures(trajectory, rate_hz=rate_hz, sides=tracked)}
    anchor = trajectory.anchor(0)
    commanded = None
    if commanded_streams(gridded.streams):
        left, right = (gridded.poses(f"wrist_{side}_commanded") for side in SIDES)
        by_side = np.split(gridded.vectors("joints_commanded"), 2, axis=1)
        # Nobody commands the head: where it was is where it should have been.
        requested = HandTrajectory(left, right, by_side[0], by_side[1], head)
        commanded = actions_from_poses(requested, anchor)
        wrists = [f"wrist_{side}_commanded" for side in SIDES]
        absent += [name for name in wrists if name not in gridded.streams]
    return GridActions(
        anchor,
        actions_from_poses(trajectory, anchor),
        commanded,
        quality,
        tuple(absent),
        {side: hand.unseen for side, hand in hands.items()},
    )


def _moved_by_touch(
    gridded: GriddedStreams, tracked: HandTrajectory
) -> tuple[HandTrajectory, dict[str, float]]:
    """The trajectory with wrists and touching fingertips moved, and each wrist's mean offset."""
    t_s = (gridded.grid_ns - gridded.grid_ns[0]).astype(np.float64) / NS_PER_S
    moved: dict[str, np.ndarray] = {}
    figures: dict[str, float] = {}
    for side in SIDES:
        if not {f"wrist_{side}", f"keypoints_{side}"} <= set(gridded.streams):
            continue
        Ts_world_wrist, joints_rad, offset_m = transfer_by_touch(
            RobotHand(side),
            getattr(tracked, f"Ts_world_wrist_{side}"),
            getattr(tracked, f"joints_{side}_rad"),
            keypoints_m=gridded.vectors(f"keypoints_{side}"),
            pad_forces_n=gridded.pad_forces_n(side),
            t_s=t_s,
        )
        moved |= {f"Ts_world_wrist_{side}": Ts_world_wrist, f"joints_{side}_rad": joints_rad}
        offset_mm = np.linalg.norm(offset_m, axis=1).mean() * 1e3
        figures[f"retargeting_{side}_wrist_offset_mm"] = float(offset_mm)
    return replace(tracked, **moved), figures


def retarget_hands(
    gridded: GriddedStreams, calibration: Mapping[str, Matrix], *, max_gap_ns: int = 0
) -> dict[Side, RetargetedHand]:
    """Joint angles of the recorded hands on the grid, each from a thread of its own.

    Samples are retargeted at the tracker's rate, steps interpolated. The person's hand is
    `hand_profile_SIDE` of the calibration, else measured from the recording. Raises
    InvalidInputError: no such hand, or other axes (`hand_axes_check`, `HandRetargeter.retarget`).
    """
    recorded: list[Side] = [side for side in SIDES if f"keypoints_{side}" in gridded.streams]
    hands = {side: HandRetargeter(side, calibrated_profile(calibration, side)) for side in recorded}

    def retarget(side: Side) -> RetargetedHand:
        return _retarget(hands[side], gridded, max_gap_ns)

    with ThreadPoolExecutor(len(SIDES), thread_name_prefix="retarget") as threads:
        return dict(zip(recorded, threads.map(retarget, recorded), strict=True))


def _retarget(
    retargeter: HandRetargeter, gridded: GriddedStreams, max_gap_ns: int
) -> RetargetedHand:
    side = retargeter.hand.side
    stream, at = gridded.streams[f"keypoints_{side}"], gridded.at[f"keypoints_{side}"]
    first, stop = int(at.left.min()), int(at.left.max()) + 2
    keypoints_m = stream.values[first:stop]
    # What the calibration turns was turned when the stream was read: the rest is refused.
    hand_axes_check(keypoints_m[:: 1 + len(keypoints_m) // MAX_CHECKED], side, {})
    t_ns = stream.t_ns[first:stop]
    # int64 first, so that seconds stay exact to the nanosecond.
    t_s = (t_ns - t_ns[0]).astype(np.float64) / NS_PER_S
    result = retargeter.retarget(keypoints_m, t_s=t_s)
    near = GridPlacement(at.left - first, at.weight, at.valid)
    # Extrapolation beyond the first or last sample could exceed the limits.
    hand = retargeter.hand
    joints_rad = np.clip(vectors_on_grid(result.joints_rad, near), hand.lower_rad, hand.upper_rad)
    period_ns = stream.descriptor.period_ns()
    gap_ns = stream_gap_ns(max_gap_ns, period_ns)
    seen = [
        place_on_grid(t_ns[solved], gridded.grid_ns, period_ns=period_ns, max_gap_ns=gap_ns).valid
        for solved in result.solved.T
    ]
    return RetargetedHand(joints_rad, ~np.stack(seen, axis=1), _quality(side, result, near))


def _quality(side: Side, result: RetargetResult, at: GridPlacement) -> dict[str, float]:
    status = status_on_grid(result.status, at)
    again = result.finger_status == RetargetStatus.REACQUIRED
    figures = {
        "num_steps_not_solved": float((status != RetargetStatus.SOLVED).sum()),
        "num_fingers_reacquired": float(again.sum()),
    }
    errors_mm = result.tip_error_m[result.solved] * 1e3
    if errors_mm.size:
        figures["tip_error_mm"] = float(errors_mm.mean())
        figures["tip_error_p95_mm"] = float(np.percentile(errors_mm, 95))
    for kind in RetargetStatus:
        figures[f"share_{kind.name.lower()}"] = float((status == kind).mean())
    return {f"retargeting_{side}_{name}": value for name, value in figures.items()}


def status_on_grid(status: np.ndarray, at: GridPlacement) -> UInt8[np.ndarray, " n"]:
    """Status of each step: the worse of its two samples."""
    left = np.where(at.weight == 1, at.left + 1, at.left)
    right = np.where(at.weight == 0, at.left, at.left + 1)
    return np.maximum(status[left], status[right]).astype(np.uint8)


def motion_figures(
    trajectory: HandTrajectory, *, rate_hz: float, sides: Sequence[Side] = SIDES
) -> Mapping[str, float]:
    """Peak speed and jerk (95th percentile) of each wrist, and the share of steps at rest."""
    figures: dict[str, float] = {}
    moves = np.zeros(max(len(trajectory.joints_left_rad) - 1, 0), dtype=bool)
    for side in sides:
        points_m = getattr(trajectory, f"Ts_world_wrist_{side}")[:, :3, 3]
        joints_rad = getattr(trajectory, f"joints_{side}_rad")
        speeds_m_s = np.linalg.norm(np.diff(points_m, axis=0), axis=1) * rate_hz
        turns_rad_s = np.abs(np.diff(joints_rad, axis=0)).max(axis=1, initial=0.0) * rate_hz
        moves |= (speeds_m_s >= REST_M_S) | (turns_rad_s >= REST_RAD_S)
        if len(points_m) > 1:
            figures[f"wrist_{side}_peak_speed_m_s"] = float(speeds_m_s.max())
        if len(points_m) > 3:
            jerks_m_s3 = np.linalg.norm(np.diff(points_m, n=3, axis=0), axis=1) * rate_hz**3
            figures[f"wrist_{side}_jerk_p95_m_s3"] = float(np.percentile(jerks_m_s3, 95))
    if moves.size and sides:
        figures["static_share"] = float(1 - moves.mean())
    return figures
