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

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from statistics import mean
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from benchmarks.figures import at_least
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory, actions_from_poses, poses_from_actions
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from dextouch.tactile import DEXTOUCH_V1, PADS, in_contact
from dextouch.tactile.layout import SIDES, Side, split_pads
from services.alignment.retargeting import HandRetargeter
from services.alignment.retargeting.wrist import (
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
from services.twin.episodes import Recorder, TakeOptions, TruthEpisode, TruthStream, record
from services.twin.names import Domain
from services.twin.scene import FINGER_STIFFNESS_NM_RAD, WRIST_STIFFNESS_N_M, WRIST_STIFFNESS_NM_RAD
from services.twin.settings import TwinSettings
from services.twin.simulation import MODEL_RATE_HZ
from services.twin.stage import Plan, Stage, command_row

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

    Raises InvalidInputError for an episode of robot hands, which has no keypoints.
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
        vectors_on_grid(DEXTOUCH_V1.pad_forces_n(tactile.values), _placed(tactile)),
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


# The whole hand comes last: in contact if any of its pads is.
PLACES: Final = (*PADS, "hand")
_NS_PER_MS: Final = 1e6


@dataclass(frozen=True)
class ContactTimes:
    """First and last contact of each pad of the left and the right hand; NaN: never touched."""

    first_ms: Float64[np.ndarray, "2 7"]
    last_ms: Float64[np.ndarray, "2 7"]


@dataclass(frozen=True)
class TimingErrors:
    """Replay minus human in milliseconds, for pads with contact in both, over many takes."""

    hand_first_ms: tuple[float, ...]
    hand_last_ms: tuple[float, ...]
    pad_first_ms: tuple[float, ...]
    pad_last_ms: tuple[float, ...]
    num_missing: int
    num_extra: int


def contact_times(streams: Mapping[str, TruthStream]) -> ContactTimes:
    """Contact times of every pad in the streams `tactile_left` and `tactile_right`."""
    first, last = np.full((2, len(SIDES), len(PLACES)), np.nan)
    for row, side in enumerate(SIDES):
        stream = streams[f"tactile_{side}"]
        tips, palm = split_pads(in_contact(stream.values))
        palm_touches = np.asarray(palm.any(axis=(1, 2)))[:, None]
        pads = np.concatenate([tips.any(axis=(2, 3)), palm_touches], axis=1)
        places = np.concatenate([pads, pads.any(axis=1, keepdims=True)], axis=1)
        for column in np.flatnonzero(places.any(axis=0)):
            at = np.flatnonzero(places[:, column])
            first[row, column] = stream.t_ref_ns[at[0]] / _NS_PER_MS
            last[row, column] = stream.t_ref_ns[at[-1]] / _NS_PER_MS
    return ContactTimes(first, last)


def timing_errors(pairs: Sequence[tuple[ContactTimes, ContactTimes]]) -> TimingErrors:
    """Errors of all takes, as (human, replay) pairs.

    `num_missing` counts pads with contact in the human take only, `num_extra` in the replay only.
    """
    first, last = (
        np.array([[getattr(take, name) for take in pair] for pair in pairs])
        for name in ("first_ms", "last_ms")
    )
    late_first, late_last = first[:, 1] - first[:, 0], last[:, 1] - last[:, 0]
    human, replay = np.moveaxis(np.isfinite(first[..., :-1]), 1, 0)
    return TimingErrors(
        hand_first_ms=_finite(late_first[..., -1]),
        hand_last_ms=_finite(late_last[..., -1]),
        pad_first_ms=_finite(late_first[..., :-1]),
        pad_last_ms=_finite(late_last[..., :-1]),
        num_missing=int((human & ~replay).sum()),
        num_extra=int((replay & ~human).sum()),
    )


def _finite(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values[np.isfinite(values)].tolist())


TASKS: Final = ("stand_bottle", "stack_bowls")
_IMAGE_PX: Final = 128


@dataclass(frozen=True)
class ClosureTake:
    """One human take and its replay by one method."""

    task: str
    method: Method
    human_succeeded: bool
    succeeded: bool
    human_contact: ContactTimes
    contact: ContactTimes


@lru_cache(maxsize=4)
def closure_stage(task: str, domain: Domain) -> Stage:
    """The stage of a task and domain, compiled once per process."""
    return Stage(task, domain, TwinSettings(image_height_px=_IMAGE_PX, image_width_px=_IMAGE_PX))


def replay(
    task: str, take: RetargetedTake, trajectory: HandTrajectory
) -> tuple[bool, dict[str, TruthStream]]:
    """Success and streams of the robot hand, from the initial object poses of the human take.

    The trajectory is converted to 67-D actions and back, as in every episode.
    """
    stage = closure_stage(task, "robot")
    anchor = stage.start(Plan(take.object_poses, trajectory))
    commands = poses_from_actions(actions_from_poses(trajectory, anchor), anchor)
    recorder = Recorder(stage, TakeOptions(images=()))
    recorder.sample(0)
    for row in range(1, NUM_GRID_STEPS):
        for step_index in stage.simulation.advance(command_row(commands, row)):
            recorder.sample(step_index)
    return stage.task.succeeded(stage.simulation), recorder.streams()


def close_take(
    task: str,
    seed: int,
    methods: Iterable[Method],
    on_step: Callable[[str], None] = lambda _: None,
) -> list[ClosureTake]:
    """Replay one human take with every method."""
    episode = record(closure_stage(task, "human"), seed, TakeOptions(images=()))
    take = retarget_take(episode)
    human_contact = contact_times(episode.streams)
    results = []
    for method in methods:
        on_step(f"{task} {seed}: {method.name}")
        succeeded, streams = replay(task, take, robot_trajectory(take, method))
        contact = contact_times(streams)
        human = bool(episode.attributes.success)
        results.append(ClosureTake(task, method, human, succeeded, human_contact, contact))
    return results


FIRST_SEED = 100
AMOUNTS = Amounts(usual={"takes": 20}, quick={"takes": 1})
MIN_SUCCESS = 0.8
QUICK_METHODS = (METHODS[0], OURS)

Played = Mapping[tuple[str, Method], Sequence[ClosureTake]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    AMOUNTS.add_options(parser, takes="human takes per task")
    parser.add_argument(
        "--tasks", default=",".join(TASKS), metavar="A,B", help="tasks of the twin (%(default)s)"
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record human takes and replay each of them by every method."""
    num_takes = AMOUNTS.of(options)["takes"]
    tasks = options.tasks.split(",")
    methods = QUICK_METHODS if options.quick else METHODS
    played: dict[tuple[str, Method], list[ClosureTake]] = {
        (task, method): [] for task in tasks for method in methods
    }
    with bar("replaying", len(played) * num_takes) as step:
        for task in tasks:
            for seed in range(FIRST_SEED, FIRST_SEED + num_takes):
                for take in close_take(task, seed, methods, step):
                    played[task, take.method].append(take)
    return StageReport(
        stage="closure",
        packages=("numpy", "mujoco", "numba"),
        options={"takes": num_takes, "tasks": tasks},
        tables=[_table(played, num_takes)],
        requirements=[
            at_least(f"{task}: success of {OURS.name}", _rate(played[task, OURS]), MIN_SUCCESS)
            for task in tasks
        ],
        data={
            "succeeded": {
                f"{task}: {method.name}": [take.succeeded for take in takes]
                for (task, method), takes in played.items()
            }
        },
    )


def _table(played: Played, num_takes: int) -> ResultTable:
    rows = []
    for (task, method), takes in played.items():
        errors = timing_errors([(take.human_contact, take.contact) for take in takes])
        *late_ms, missing, extra = astuple(errors)
        means = map(_mean_ms, late_ms)
        name, rate = f"{task}: {method.name}", f"{_rate(takes):.2f}"
        rows.append((name, rate, *means, str(missing), str(extra)))
    return ResultTable(
        f"Replays of {num_takes} human takes a task; contact times against the human's in ms",
        ("", "success", "hand first", "hand last", "pad first", "pad last", "missing", "extra"),
        rows,
    )


def _rate(takes: Sequence[ClosureTake]) -> float:
    return mean(float(take.succeeded) for take in takes)


def _mean_ms(values: Sequence[float]) -> str:
    return f"{mean(abs(value) for value in values):.0f}" if values else "-"
