"""Record types that the compiled solver reads and writes: hand, person, options, results.

Tables of fixed size are records: compiled functions hand on one pointer, and strides are constants.
"""

from typing import Final, NamedTuple

import numpy as np

MAX_FINGERS: Final = 5
MAX_JOINTS: Final = 6
NUM_POINTS: Final = 4
MAX_STARTS: Final = 8
# The rate at which `temporal_weight_m2` is stated.
NOMINAL_PERIOD_S: Final = 1 / 60
# Of a pinch that begins.
PINCH_WEIGHT_FAR: Final = 1e-3

# What became of a finger in a sample; see `RetargetStatus`.
SOLVED, PARTIAL, REACQUIRED, UNCONVERGED, IMPLAUSIBLE, MISSING = range(6)

_F, _J, _P = MAX_FINGERS, MAX_JOINTS, NUM_POINTS

# A robot hand; fingers and joints beyond its own are never read.
HAND: Final = np.dtype(
    [
        ("num_fingers", np.int64),
        # -1 without a thumb.
        ("thumb", np.int64),
        ("num_joints", np.int64, (_F,)),
        # A joint's frame in its parent, and its axis in its own frame.
        ("rotation", np.float64, (_F, _J, 3, 3)),
        ("position_m", np.float64, (_F, _J, 3)),
        ("axis", np.float64, (_F, _J, 3)),
        # Short cuts: whether (1) that frame is turned at all; which axis (0, 1, 2) it is or the
        # opposite of, with its sign, or 3.
        ("is_turned", np.uint8, (_F, _J)),
        ("axis_kind", np.int64, (_F, _J)),
        ("axis_sign", np.float64, (_F, _J)),
        # The joints whose origins are knuckle, PIP and DIP; the tip, in the last joint's frame.
        ("point_joints", np.int64, (_F, 3)),
        ("tip_m", np.float64, (_F, 3)),
        ("lower_rad", np.float64, (_F, _J)),
        ("upper_rad", np.float64, (_F, _J)),
        # At zero angles, wrist axes.
        ("knuckle_m", np.float64, (_F, 3)),
        # Where cold searches begin.
        ("starts_rad", np.float64, (MAX_STARTS, _F, _J)),
        # Phalanges as capsules, from knuckle to tip.
        ("radius_m", np.float64, (_F, 3)),
        # Which keypoints are knuckle, PIP, DIP and tip; -1 where the finger has no such joint.
        ("nodes", np.int64, (_F, _P)),
    ]
)

# The tracked hand; see `HandProfile`.
PERSON: Final = np.dtype(
    [
        # False: no bones or knuckles to compare a sample with.
        ("is_known", np.bool_),
        # False: bones are those of each sample as far as they are seen, and knuckles are free.
        ("is_rigid", np.bool_),
        # PIP, DIP and tip from the point before; and that by the robot's.
        ("bone_m", np.float64, (_F, 3)),
        ("bone_scale", np.float64, (_F, 3)),
        ("knuckle_m", np.float64, (_F, 3)),
        # How much of the robot's knuckle travel the tracked knuckle makes.
        ("travel", np.float64, (_F,)),
        # Variance of the knuckle by variance of a measured point.
        ("freedom", np.float64, (_F,)),
        # Further off, bones and knuckles are not this person's.
        ("bone_tolerance_m", np.float64, (_F, 3)),
        ("knuckle_tolerance_m", np.float64, (_F,)),
    ]
)

# Room to work in.
SCRATCH: Final = np.dtype(
    [
        # Points as measured, and whether (1) or not (0) they were.
        ("measured", np.float64, (_F, _P, 3)),
        ("usable", np.uint8, (_F, _P)),
        # Of the robot's joints, the tip after the last; of the virtual points and the robot's tip,
        # the slopes by the joints.
        ("origin", np.float64, (_F, _J + 1, 3)),
        ("axis", np.float64, (_F, _J, 3)),
        ("point", np.float64, (_F, _P, 3)),
        ("slope", np.float64, (_F, _P, _J, 3)),
        ("tip_slope", np.float64, (_F, _J, 3)),
        # Normal equations by finger; what couples thumb (rows) and finger (columns).
        ("hessian", np.float64, (_F, _J, _J)),
        ("coupling", np.float64, (_F, _J, _J)),
        ("gradient", np.float64, (_F, _J)),
        ("solved", np.float64, (_F, _J + 1, _J)),
        ("reduced", np.float64, (_J, _J)),
        ("step", np.float64, (_F, _J)),
        ("trial", np.float64, (_F, _J)),
        # Since the sample before, and what came out then.
        ("elapsed_s", np.float64),
        ("sent", np.float64, (_F, _J)),
        # The box, the sample before, and how strongly it pulls.
        ("lower", np.float64, (_F, _J)),
        ("upper", np.float64, (_F, _J)),
        ("before", np.float64, (_F, _J)),
        ("pull_m2", np.float64, (_F,)),
        # The posture that the points alone ask for, and how strongly a pinch keeps to it.
        ("posture", np.float64, (_F, _J)),
        ("posture_weight_m2", np.float64, (_F,)),
        ("scale", np.float64, (_F, 3)),
        ("freedom", np.float64, (_F,)),
        # Vector from fingertip to thumb tip and its weight; the fingers that are solved together.
        ("pinch_m", np.float64, (_F, 3)),
        ("pinch_weight", np.float64, (_F,)),
        ("members", np.int64, (_F + 1,)),
        ("is_near", np.uint8, (_F,)),
        # Of the innermost loops.
        ("turn", np.float64, (2, 3, 3)),
        ("own_slope", np.float64, (2, _J, 3)),
        ("row", np.float64, (2, _J)),
        ("bones", np.float64, (3, 3)),
        ("best", np.float64, (_J,)),
        ("push_m", np.float64, (3,)),
    ]
)


class Memory(NamedTuple):
    """State that one sample leaves for the next, changed in place.

    Attributes:
        joints_rad: [F, 6], previous result.
        alone_rad: [F, 6], what fingers would do if there were no pinch.
        unsolved_s: [F] since a finger was solved; infinite if it never was.
        is_behind: [F] whether a finger that was lost is still on its way to where it is tracked.
    """

    joints_rad: np.ndarray
    alone_rad: np.ndarray
    unsolved_s: np.ndarray
    is_behind: np.ndarray

    @staticmethod
    def starting_at(joints_rad: np.ndarray) -> "Memory":
        """Before the first sample."""
        num = len(joints_rad)
        unsolved_s, is_behind = np.full(num, np.inf), np.zeros(num, dtype=np.uint8)
        return Memory(joints_rad, joints_rad.copy(), unsolved_s, is_behind)


class Output(NamedTuple):
    """Results: angles [T, F, 6], status [T, F] and of the sample [T], tip error [T, F]."""

    joints_rad: np.ndarray
    finger_status: np.ndarray
    status: np.ndarray
    tip_error_m: np.ndarray

    @staticmethod
    def of(num_samples: int, num_fingers: int) -> "Output":
        """Room for the results of so many samples."""
        return Output(
            np.empty((num_samples, num_fingers, MAX_JOINTS)),
            np.empty((num_samples, num_fingers), dtype=np.uint8),
            np.empty(num_samples, dtype=np.uint8),
            np.empty((num_samples, num_fingers)),
        )
