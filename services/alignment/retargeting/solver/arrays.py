"""What the compiled solver reads and writes, as records: hand, person, options, results."""

from dataclasses import astuple, dataclass, fields
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.hands import solver_indices
from dextouch.hands.robot_hand import HandModel

MAX_FINGERS: Final = 5
MAX_JOINTS: Final = 6
NUM_POINTS: Final = 4
MAX_STARTS: Final = 8
# The rate at which `temporal_weight_m2` is stated.
NOMINAL_PERIOD_S: Final = 1 / 60
# Below this distance the vector from a fingertip to the thumb's has its full weight, beside points
# of unit weight. Then that of a pinch that begins, and the pull of joints in a pinch towards what
# their own points ask for.
PINCH_NEAR_M: Final = 0.005
PINCH_WEIGHT: Final = 100.0
PINCH_WEIGHT_FAR: Final = 1e-3
POSTURE_WEIGHT_M2: Final = 3e-3

# Beyond, products of weights and distances drown what the points say.
MAX_WEIGHT = 1e6
LEAST = 1e-6
# Where cold searches begin, as fractions from lower to upper limit, knuckle to tip. The first two
# find nearly all postures; the others are for the rest.
STARTS = (
    (0.45, 0.50, 0.40, 0.45),
    (0.75, 0.50, 0.75, 0.70),
    (0.30, 0.25, 0.60, 0.50),
    (0.60, 0.80, 0.45, 0.55),
    (0.20, 0.60, 0.20, 0.20),
    (0.85, 0.30, 0.30, 0.85),
    (0.15, 0.85, 0.85, 0.15),
    (0.90, 0.75, 0.10, 0.50),
)


class RetargetStatus(IntEnum):
    """How a finger was solved; for a sample, the worst status of its fingers.

    PARTIAL: some of its points were missing. REACQUIRED: it was lost and searched again; live, its
    joints are approaching the tracked pose at the velocity limit. UNCONVERGED: the solver did not
    converge. IMPLAUSIBLE: bones or knuckle do not match this hand. MISSING: fewer than two points.
    With the last two, the finger keeps its previous angles; a sample is IMPLAUSIBLE or MISSING if
    all fingers are, PARTIAL if some are.
    """

    SOLVED = 0
    PARTIAL = 1
    REACQUIRED = 2
    UNCONVERGED = 3
    IMPLAUSIBLE = 4
    MISSING = 5


# As the compiled solver knows them.
SOLVED, PARTIAL, REACQUIRED, UNCONVERGED, IMPLAUSIBLE, MISSING = map(int, RetargetStatus)

_F, _J, _P = MAX_FINGERS, MAX_JOINTS, NUM_POINTS

# A robot hand; fingers and joints beyond its own are never read.
HAND: Final = np.dtype(
    [
        ("num_fingers", np.int64),
        # -1 without a thumb.
        ("thumb", np.int64),
        ("num_joints", np.int64, (_F,)),
        # A joint's frame in its parent; it turns about its own z.
        ("rotation", np.float64, (_F, _J, 3, 3)),
        ("position_m", np.float64, (_F, _J, 3)),
        # Short cut: whether (1) that frame is turned at all.
        ("is_turned", np.uint8, (_F, _J)),
        # The joints whose origins are knuckle, PIP and DIP; the tip, in the last joint's frame.
        ("point_joints", np.int64, (_F, 3)),
        ("tip_m", np.float64, (_F, 3)),
        ("lower_rad", np.float64, (_F, _J)),
        ("upper_rad", np.float64, (_F, _J)),
        # At zero angles, wrist axes.
        ("knuckle_m", np.float64, (_F, 3)),
        # Where cold searches begin.
        ("starts_rad", np.float64, (MAX_STARTS, _F, _J)),
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
        # Mean square of the noise's length, which live points are smoothed by; negative where it
        # is to be found from the samples.
        ("noise_m2", np.float64),
    ]
)

# Room to work in.
SCRATCH: Final = np.dtype(
    [
        # Points as measured, and whether (1) or not (0) they were.
        ("measured", np.float64, (_F, _P, 3)),
        ("usable", np.uint8, (_F, _P)),
        # Of the robot's joints, the tip after the last; of the virtual points and the robot's own,
        # the slopes by the joints.
        ("origin", np.float64, (_F, _J + 1, 3)),
        ("axis", np.float64, (_F, _J, 3)),
        ("point", np.float64, (_F, _P, 3)),
        ("slope", np.float64, (_F, _P, _J, 3)),
        ("own_slope", np.float64, (_F, _P, _J, 3)),
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
        ("bone_weight", np.float64, (_F, 3)),
        # Vector from fingertip to thumb tip and its weight; the fingers that are solved together.
        ("pinch_m", np.float64, (_F, 3)),
        ("pinch_weight", np.float64, (_F,)),
        ("members", np.int64, (_F + 1,)),
        ("is_near", np.uint8, (_F,)),
        # Of the innermost loops.
        ("turn", np.float64, (3, 3)),
        ("row", np.float64, (2, _J)),
        ("bones", np.float64, (3, 3)),
        ("best", np.float64, (_J,)),
        ("push_m", np.float64, (3,)),
    ]
)


@dataclass(frozen=True)
class RetargetOptions:
    """Options of the solver; the defaults are what `python -m benchmarks retargeting` measures.

    Args:
        temporal_weight_m2: pull towards the sample before, m²/rad² at 60 Hz beside points of unit
            weight (directions of people's bones count as points at 40 mm), in proportion to the
            rate. 0 follows every sample exactly.
        velocity_limit_rad_s: no joint turns faster from sample to sample.
        max_step_rad: live, largest change of a joint between two outputs; the default is 9.6 rad/s
            at 30 Hz, the rate of the slowest trackers.
        pinch_far_m: from this distance of thumb and fingertip on they are solved apart.
        reacquire_after_s: a finger that was lost for so long is searched from several starts.
        num_starts: of such a search, 1 … 8.
    """

    temporal_weight_m2: float = 1e-4
    velocity_limit_rad_s: float = 9.6
    max_step_rad: float = 0.32
    pinch_far_m: float = 0.060
    reacquire_after_s: float = 0.1
    num_starts: int = len(STARTS)

    def __post_init__(self) -> None:
        ranges = {
            "temporal_weight_m2": (0.0, MAX_WEIGHT),
            "velocity_limit_rad_s": (LEAST, np.inf),
            "max_step_rad": (LEAST, np.inf),
            "pinch_far_m": (PINCH_NEAR_M + LEAST, 1.0),
            "reacquire_after_s": (LEAST, np.inf),
            "num_starts": (1, len(STARTS)),
        }
        wrong = [
            f"{name} {getattr(self, name):g} (expected {low:g} … {high:g})"
            for name, (low, high) in ranges.items()
            if not low <= getattr(self, name) <= high
        ]
        if wrong:
            raise InvalidInputError(f"retargeting options: got {', '.join(wrong)}")

    def tuning(self, *, is_live: bool = False) -> np.ndarray:
        """The options as the record [1] that the solver reads; `is_live`, steps are limited."""
        types = [(field.name, field.type) for field in fields(self)]
        return np.array([(*astuple(self), is_live)], dtype=[*types, ("is_live", bool)])


class Memory(NamedTuple):
    """State that one sample leaves for the next, changed in place.

    `joints_rad` [F, 6] are the previous result, `alone_rad` what it would be without pinches,
    `unsolved_s` [F] infinite for fingers never solved, `is_behind` those on the way to where they
    are tracked again, `points_m` [F, 4, 3] smoothed, NaN if never seen; others as in `solve`,
    `minimize`.
    """

    joints_rad: np.ndarray
    alone_rad: np.ndarray
    unsolved_s: np.ndarray
    is_behind: np.ndarray
    points_m: np.ndarray
    bones_m: np.ndarray
    ease: np.ndarray

    @staticmethod
    def starting_at(joints_rad: np.ndarray) -> "Memory":
        """Before the first sample."""
        num = len(joints_rad)
        unsolved_s, is_behind = np.full(num, np.inf), np.zeros(num, dtype=np.uint8)
        points_m, bones_m = np.full((num, NUM_POINTS, 3), np.nan), np.zeros((num, 3, 3))
        ease = np.ones((num, 3))
        return Memory(joints_rad, joints_rad.copy(), unsolved_s, is_behind, points_m, bones_m, ease)


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


def hand_arrays(hand: HandModel) -> np.ndarray:
    """The hand's tables as one record `HAND`, shape [1]."""
    record = np.zeros(1, dtype=HAND)
    row = record[0]
    row["num_fingers"] = len(hand.fingers)
    row["thumb"] = next((f for f, one in enumerate(hand.fingers) if one.chain == "thumb"), -1)
    fractions = np.full((MAX_STARTS, 1, MAX_JOINTS), 0.5)
    fractions[:, 0, :4] = STARTS
    for index, finger in enumerate(hand.fingers):
        row["num_joints"][index] = len(finger.joints)
        row["point_joints"][index] = finger.points
        row["nodes"][index] = solver_indices(finger.chain)
        for point in (1, 2):
            # A finger with fewer joints: one bone follows two of the person's.
            if finger.points[point] == finger.points[point - 1]:
                row["nodes"][index, point] = -1
        before = np.eye(3)
        for joint, one in enumerate(finger.joints):
            axes = _axes_around(np.array(one.axis))
            rotation = before.T @ rotation_from_quaternion(np.array(one.q_wxyz)) @ axes
            row["rotation"][index, joint] = rotation
            row["position_m"][index, joint] = before.T @ one.position_m
            row["is_turned"][index, joint] = not np.array_equal(rotation, np.eye(3))
            row["lower_rad"][index, joint], row["upper_rad"][index, joint] = one.limits_rad
            before = axes
        row["tip_m"][index] = before.T @ finger.tip_m
    row["starts_rad"] = row["lower_rad"] + fractions * (row["upper_rad"] - row["lower_rad"])
    row["knuckle_m"][: len(hand.fingers)] = zero_points_m(hand)[:, 0]
    return record


def _axes_around(axis: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """Right-handed axes whose z is this one; along x, y or z they are exact."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def joint_places(hand: HandModel) -> Bool[np.ndarray, "fingers 6"]:
    """Indices of the hand's joints in the solver's [fingers, 6] angles."""
    counts = np.array([len(finger.joints) for finger in hand.fingers])
    return np.asarray(np.arange(MAX_JOINTS) < counts[:, None])


def zero_points_m(hand: HandModel) -> Float64[np.ndarray, "fingers 4 3"]:
    """Knuckle, PIP, DIP and tip of every finger at zero angles."""
    return hand.chain_points_m(np.zeros((1, len(hand.joint_names))))[0]
