"""What the compiled solver reads and writes: a hand, a person, options, memory, results."""

from typing import NamedTuple, no_type_check

import numpy as np

from services.alignment.retargeting.solver.compiled import compiled

MAX_JOINTS = 6
NUM_POINTS = 4
# The rate at which `temporal_weight_m2` is stated.
NOMINAL_PERIOD_S = 1 / 60

# What became of a finger in a sample; see `RetargetStatus`.
SOLVED, PARTIAL, REACQUIRED, UNCONVERGED, IMPLAUSIBLE, MISSING = range(6)


class HandArrays(NamedTuple):
    """A robot hand of F fingers as numbers; joints beyond a finger's own are never read.

    Attributes:
        num_joints: int64 [F].
        rotation, position_m: [F, 6, 3, 3], [F, 6, 3], a joint's frame in its parent.
        axis: [F, 6, 3], unit vectors.
        point_joints: int64 [F, 3], the joints whose origins are knuckle, PIP and DIP.
        tip_m: [F, 3], in the last joint's frame.
        lower_rad, upper_rad: [F, 6].
        knuckle_m: [F, 3], at zero angles, wrist axes.
        starts_rad: [S, F, 6], where cold searches begin.
        radius_m: [F, 3], of the phalanges as capsules, knuckle to tip.
        nodes: int64 [F, 4], which keypoints are knuckle, PIP, DIP and tip.
        thumb: which finger is the thumb; -1 without one.
    """

    num_joints: np.ndarray
    rotation: np.ndarray
    position_m: np.ndarray
    axis: np.ndarray
    point_joints: np.ndarray
    tip_m: np.ndarray
    lower_rad: np.ndarray
    upper_rad: np.ndarray
    knuckle_m: np.ndarray
    starts_rad: np.ndarray
    radius_m: np.ndarray
    nodes: np.ndarray
    thumb: int


class PersonArrays(NamedTuple):
    """The tracked hand as numbers; see `HandProfile`.

    Attributes:
        bone_m: [F, 3], PIP, DIP and tip from the point before.
        bone_scale: [F, 3], the person's bone by the robot's.
        knuckle_m: [F, 3], wrist axes.
        travel: [F], how much of the robot's knuckle travel the tracked knuckle makes.
        freedom: [F], variance of the knuckle by variance of a measured point.
        is_known: False: bones are those of each sample, and nothing is known of knuckles.
    """

    bone_m: np.ndarray
    bone_scale: np.ndarray
    knuckle_m: np.ndarray
    travel: np.ndarray
    freedom: np.ndarray
    is_known: bool


class Tuning(NamedTuple):
    """`RetargetOptions` as numbers."""

    temporal_weight_m2: float
    velocity_limit_rad_s: float
    pinch_near_m: float
    pinch_far_m: float
    pinch_weight_near: float
    pinch_weight_far: float
    reacquire_after_s: float
    num_starts: int
    bone_tolerance: float
    bone_tolerance_m: float
    knuckle_tolerance_m: float
    max_bend_cosine: float
    keeps_fingers_apart: bool


class Memory(NamedTuple):
    """What one sample leaves for the next, changed in place: angles [F, 6], seconds unsolved [F].

    A finger that was never solved has infinite seconds.
    """

    joints_rad: np.ndarray
    unsolved_s: np.ndarray


class Output(NamedTuple):
    """Results: angles [T, F, 6], status [T, F] and of the sample [T], tip error [T, F]."""

    joints_rad: np.ndarray
    finger_status: np.ndarray
    status: np.ndarray
    tip_error_m: np.ndarray


class Scratch(NamedTuple):
    """Room to work in, by finger."""

    origin: np.ndarray  # [F, 7, 3], the tip is the last
    axis: np.ndarray  # [F, 6, 3]
    point: np.ndarray  # [F, 4, 3]
    slope: np.ndarray  # [F, 4, 6, 3], of the points by the joints
    tip_slope: np.ndarray  # [F, 6, 3]
    hessian: np.ndarray  # [F, 6, 6]
    coupling: np.ndarray  # [F, 6, 6], thumb rows, finger columns
    gradient: np.ndarray  # [F, 6]
    solved: np.ndarray  # [F, 6, 7]
    reduced: np.ndarray  # [6, 6]
    step: np.ndarray  # [F, 6]
    trial: np.ndarray  # [F, 6]
    lower: np.ndarray  # [F, 6]
    upper: np.ndarray  # [F, 6]
    before: np.ndarray  # [F, 6]
    pull_m2: np.ndarray  # [F]
    scale: np.ndarray  # [F, 3]
    freedom: np.ndarray  # [F]
    pinch_m: np.ndarray  # [F, 3]
    pinch_weight: np.ndarray  # [F]
    members: np.ndarray  # [F]
    turn: np.ndarray  # [3, 3, 3]
    own_slope: np.ndarray  # [2, 6, 3]
    row: np.ndarray  # [2, 6]
    measured: np.ndarray  # [F, 4, 3]
    usable: np.ndarray  # bool [F, 4]


@compiled
@no_type_check
def scratch_for(num_fingers):
    """Room for a hand of so many fingers."""
    f, j = num_fingers, MAX_JOINTS
    return Scratch(
        np.zeros((f, j + 1, 3)),
        np.zeros((f, j, 3)),
        np.zeros((f, NUM_POINTS, 3)),
        np.zeros((f, NUM_POINTS, j, 3)),
        np.zeros((f, j, 3)),
        np.zeros((f, j, j)),
        np.zeros((f, j, j)),
        np.zeros((f, j)),
        np.zeros((f, j, j + 1)),
        np.zeros((j, j)),
        np.zeros((f, j)),
        np.zeros((f, j)),
        np.zeros((f, j)),
        np.zeros((f, j)),
        np.zeros((f, j)),
        np.zeros(f),
        np.zeros((f, 3)),
        np.zeros(f),
        np.zeros((f, 3)),
        np.zeros(f),
        np.zeros(f, dtype=np.int64),
        np.zeros((3, 3, 3)),
        np.zeros((2, j, 3)),
        np.zeros((2, j)),
        np.zeros((f, NUM_POINTS, 3)),
        np.zeros((f, NUM_POINTS), dtype=np.bool_),
    )
