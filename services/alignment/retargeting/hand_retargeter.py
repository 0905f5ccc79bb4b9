"""`HandRetargeter`: joint angles of a robot hand that follow a tracked human hand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import CHAINS, NUM_KEYPOINTS, mean_hand_m, solver_indices
from dextouch.hands.robot_hand import HandModel, RobotHand
from services.alignment.retargeting.hand_checks import checked_keypoints, thinned
from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    MAX_JOINTS,
    NOMINAL_PERIOD_S,
    PERSON,
    SCRATCH,
    Memory,
    Output,
    RetargetOptions,
    hand_arrays,
    joint_places,
    zero_points_m,
)
from services.alignment.retargeting.solver.solve import retarget_samples, smoothed

NUM_FINGERS = 5
# Proximal phalanx of an index finger: that of the mean hand (39.7 mm) at the sizes that are
# accepted (0.55 … 1.5, SIZE_RANGE of hand_checks), and a tenth for fingers of other proportions and
# the tracker's noise. Outside, the unit is wrong: the nearest is inches, a factor of 39.
INDEX_PROXIMAL_RANGE_M = (0.0190, 0.0668)
BONE_RANGE_M = (0.003, 0.150)
_INDEX_FINGER = CHAINS.index("index")
NUM_COLUMNS = 9
# A person's knuckles turn in place (0), the robot's travel with its flexion axes (1).
RIGID_TRAVEL = 0.5

_NODES = np.array([solver_indices(chain) for chain in CHAINS])
# Samples that are looked at, spread over the recording: 240 know a bone to a tenth of the noise.
NUM_SAMPLES = 240
# Below this a tracker's noise makes no difference, and ratios of zeros would come up (metres).
LEAST_SIGMA_M = 1e-4
# A knuckle's spread is the difference of two variances, each known to some 8 % from 240 samples:
# less than this share of the tracker's noise is indistinguishable from none.
LEAST_SIGMA_SHARE = 0.3
# Standard deviations within which 95 of 100 points of a normal distribution in space lie.
CHI_95 = 2.7955
LEAST_KNUCKLE_SIGMA_M = 1e-5
# A robot's knuckle that moved less than this (RMS, metres) does not determine its travel.
LEAST_TRAVEL_M = 1e-3
UNKNOWN_FREEDOM = 1e6
# Of a robot's finger; shorter is none.
LEAST_BONE_M = 1e-6
# A bone that differs from the person's by more than all of these is an error of the tracker: a part
# of its length, a distance, and so many standard deviations of the tracker's noise.
BONE_TOLERANCE = 0.3
BONE_TOLERANCE_M = 0.008
BONE_SIGMAS = 5.0
# So is a knuckle that lies so many standard deviations from its place in the wrist frame, but no
# nearer and no further than this; neighbours are 16 mm or more apart.
KNUCKLE_SIGMAS = 3.5
KNUCKLE_TOLERANCE_M = (0.012, 0.015)
# Samples that lie seconds apart: no pinches, no pull.
EVERY_SAMPLE_ALONE = RetargetOptions(pinch_far_m=0.0051, temporal_weight_m2=0.0)


@dataclass(frozen=True)
class HandProfile:
    """Constant geometry of one person's hand, thumb … little, in wrist axes.

    Attributes:
        bone_m: MCP–PIP, PIP–DIP, DIP–tip (of the thumb CMC–MCP, MCP–IP, IP–tip).
        knuckle_m: the MCP (of the thumb: the CMC) in the wrist frame.
        travel: share of the robot's knuckle travel with flexion that the tracked one makes: 0 for
            people, whose knuckles turn in place, 1 for the robot hand itself.
        knuckle_sigma_m: standard deviation per axis of a knuckle's residual motion.
        point_sigma_m: standard deviation, an axis, of the tracker's noise.
    """

    bone_m: Float64[np.ndarray, "5 3"]
    knuckle_m: Float64[np.ndarray, "5 3"]
    travel: Float64[np.ndarray, "5"]
    knuckle_sigma_m: Float64[np.ndarray, "5"]
    point_sigma_m: float

    def __post_init__(self) -> None:
        rows = self.to_rows()
        if not np.isfinite(rows).all() or (rows[:, 7:] < 0).any():
            raise InvalidInputError("hand profile: expected finite numbers, no negative sigma")
        check_bone_unit(float(self.bone_m[_INDEX_FINGER, 0]), where="hand profile")
        low, high = BONE_RANGE_M
        if not ((self.bone_m >= low) & (self.bone_m <= high)).all():
            raise InvalidInputError(
                f"hand profile: bones {np.round(self.bone_m, 4).tolist()}, "
                f"expected {low} … {high} m"
            )

    @property
    def is_rigid(self) -> bool:
        """Whether this is the robot's own hand; those of people shift with the posture."""
        return bool(np.median(self.travel) >= RIGID_TRAVEL)

    def to_rows(self) -> Float64[np.ndarray, "5 9"]:
        """Rows: 3 bones, 3 knuckle coordinates, travel, knuckle sigma, the tracker's noise (m)."""
        noise_m = np.full(NUM_FINGERS, self.point_sigma_m)
        columns = self.bone_m, self.knuckle_m, self.travel, self.knuckle_sigma_m, noise_m
        return np.column_stack(columns).astype(np.float64)

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[float]]) -> "HandProfile":
        """From the matrix of `to_rows`; raises ShapeError or InvalidInputError."""
        table = np.asarray(rows, dtype=np.float64)
        if table.shape != (NUM_FINGERS, NUM_COLUMNS):
            raise ShapeError(f"hand profile: got shape {table.shape}, expected [5, {NUM_COLUMNS}]")
        return cls(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7], float(table[0, 8]))


def profile_name(side: str) -> str:
    """Name of the matrix in a recording's calibration."""
    return f"hand_profile_{side}"


def calibrated_profile(
    calibration: Mapping[str, Sequence[Sequence[float]]], side: str
) -> HandProfile | None:
    """The profile of a calibration, None if it has none; raises ShapeError, InvalidInputError."""
    rows = calibration.get(profile_name(side))
    return None if rows is None else HandProfile.from_rows(rows)


def check_bone_unit(index_proximal_m: float, *, where: str) -> None:
    """Refuse an index finger's proximal bone outside 19.0–66.8 mm; raises InvalidInputError."""
    low, high = INDEX_PROXIMAL_RANGE_M
    if not low <= index_proximal_m <= high:
        is_in_mm = low * 1e3 <= index_proximal_m <= high * 1e3
        hint = "these look like millimetres" if is_in_mm else "check nodes"
        raise InvalidInputError(
            f"{where}: the index finger's proximal bone measures {index_proximal_m:.4g}, expected "
            f"{low} … {high} m ({hint}); send metres in the order of dextouch.hands.NODES",
            got=index_proximal_m,
        )


def person_arrays(profile: HandProfile | None, hand: HandModel) -> np.ndarray:
    """Record `PERSON` for the robot's fingers; without a profile, each sample has its own bones."""
    record = np.zeros(1, dtype=PERSON)
    person, num, own_m = record[0], len(hand.fingers), robot_bone_m(hand)
    if profile is None:
        person["bone_m"][:num], person["bone_scale"][:] = own_m, 1.0
        person["knuckle_m"][:num], person["travel"][:] = zero_points_m(hand)[:, 0], 1.0
        person["freedom"][:], person["noise_m2"] = UNKNOWN_FREEDOM, -1.0
        return record
    rows = [CHAINS.index(finger.chain) for finger in hand.fingers]
    bone_m, knuckle_sigma_m = profile.bone_m[rows].copy(), profile.knuckle_sigma_m[rows]
    for finger, bone in zip(*np.nonzero(own_m[:, :2] < LEAST_BONE_M), strict=True):
        # Two bones of the person in a row are one of the robot's.
        bone_m[finger, bone + 1] += bone_m[finger, bone]
        bone_m[finger, bone] = 0.0
    person["is_known"], person["is_rigid"] = True, profile.is_rigid
    person["bone_m"][:num] = bone_m
    person["bone_scale"][:num] = bone_m / np.maximum(own_m, LEAST_BONE_M)
    person["knuckle_m"][:num] = profile.knuckle_m[rows]
    person["travel"][:num] = profile.travel[rows]
    person["freedom"][:num] = UNKNOWN_FREEDOM
    if profile.is_rigid:
        sigma_m = max(profile.point_sigma_m, LEAST_SIGMA_M)
        person["freedom"][:num] = (knuckle_sigma_m / sigma_m) ** 2
    else:
        person["noise_m2"] = 3.0 * profile.point_sigma_m**2
    noise_m = BONE_SIGMAS * np.sqrt(2) * profile.point_sigma_m
    least_m = max(BONE_TOLERANCE_M, noise_m)
    person["bone_tolerance_m"][:num] = np.maximum(BONE_TOLERANCE * bone_m, least_m)
    spread_m = KNUCKLE_SIGMAS * np.hypot(knuckle_sigma_m, profile.point_sigma_m)
    person["knuckle_tolerance_m"][:num] = np.clip(spread_m, *KNUCKLE_TOLERANCE_M)
    return record


def robot_bone_m(hand: HandModel) -> Float64[np.ndarray, "fingers 3"]:
    """Lengths from knuckle to PIP, DIP and tip of a robot hand at zero angles."""
    return np.asarray(np.linalg.norm(np.diff(zero_points_m(hand), axis=1), axis=-1))


def measure_profile(keypoints_m: np.ndarray, hand: HandModel) -> HandProfile:
    """Medians of bones and knuckles, and how the knuckles travel when fingers bend.

    Keypoints are [T, 25, 3], any samples of the hand, of which those with whole fingers count; the
    robot hand of the same side defines how far fingers are bent. Raises ShapeError: wrong shape;
    InvalidInputError: a finger is complete in no sample, or its bones are invalid (unit, order).
    """
    # Knuckle, PIP, DIP and tip of thumb … little (of the thumb: CMC, MCP, IP, tip).
    points_m = checked_keypoints(keypoints_m)[:, _NODES]
    whole = np.isfinite(points_m).all(axis=(-1, -2))
    _check_seen(whole, hand.side)
    points_m[~whole] = np.nan
    lengths = np.linalg.norm(np.diff(points_m, axis=2), axis=-1)
    check_bone_unit(float(np.nanmedian(lengths[:, _INDEX_FINGER, 0])), where="keypoints")
    low, high = BONE_RANGE_M
    lengths[~((lengths >= low) & (lengths <= high)).all(axis=-1)] = np.nan
    _check_seen(np.isfinite(lengths).all(axis=-1), hand.side)
    bone_m = np.nanmedian(lengths, axis=0)
    spread_m = 1.4826 * np.nanmedian(np.abs(lengths - bone_m), axis=0)
    # The length of a bone has the noise of two points along it.
    point_sigma_m = float(np.median(spread_m) / np.sqrt(2))
    rows = thinned(np.flatnonzero(whole.any(axis=1)), NUM_SAMPLES)
    moved_m = _knuckle_motion(points_m[rows], hand)
    usable = whole[rows] & np.isfinite(moved_m).all(axis=-1)
    knuckle_m, travel, sigma_m = np.zeros((NUM_FINGERS, 3)), np.zeros(5), np.zeros(5)
    for finger in range(NUM_FINGERS):
        kept = usable[:, finger]
        seen_m, with_it_m = points_m[rows][kept, finger, 0], moved_m[kept, finger]
        if not kept.any():
            # Seen in few samples, of which none may be among the rows.
            seen_m = points_m[whole[:, finger], finger, 0]
            with_it_m = np.full_like(seen_m, np.nan)
        knuckle_m[finger], travel[finger], left_m = _fit_knuckle(seen_m, with_it_m)
        least_m = max(LEAST_KNUCKLE_SIGMA_M, LEAST_SIGMA_SHARE * point_sigma_m)
        sigma_m[finger] = max(np.sqrt(max(left_m**2 - point_sigma_m**2, 0.0)), least_m)
    return HandProfile(bone_m, knuckle_m, travel, sigma_m, point_sigma_m)


def _check_seen(whole: np.ndarray, side: str) -> None:
    never = [name for name, seen in zip(CHAINS, whole.T, strict=True) if not seen.any()]
    if never:
        raise InvalidInputError(
            f"keypoints of the {side} hand: no step shows all nodes of {', '.join(never)} with "
            f"bones of {BONE_RANGE_M[0]} … {BONE_RANGE_M[1]} m; expected every finger at least once"
        )


def _knuckle_motion(points_m: np.ndarray, hand: HandModel) -> Float64[np.ndarray, "n 5 3"]:
    """Knuckles of the robot when its fingers point like the tracked ones; NaN if unknown."""
    own, num = hand_arrays(hand), len(points_m)
    rows = [CHAINS.index(finger.chain) for finger in hand.fingers]
    keypoints = np.full((num, NUM_KEYPOINTS, 3), np.nan)
    keypoints[:, _NODES] = points_m
    output, person = Output.of(num, len(rows)), person_arrays(None, hand)
    retarget_samples(
        (own, person, EVERY_SAMPLE_ALONE.tuning(), np.zeros(1, dtype=SCRATCH)),
        (keypoints, np.full(num, np.inf)),
        Memory.starting_at(np.zeros((len(rows), MAX_JOINTS))),
        output,
    )
    is_joint = joint_places(hand)
    knuckles = hand.chain_points_m(output.joints_rad[:, is_joint])[:, :, 0]
    moved_own_m = knuckles - own["knuckle_m"][0, : len(rows)]
    moved_own_m[output.finger_status >= IMPLAUSIBLE] = np.nan
    moved_m = np.full((num, NUM_FINGERS, 3), np.nan)
    moved_m[:, rows] = moved_own_m
    return moved_m


def _fit_knuckle(
    seen_m: np.ndarray, moved_m: np.ndarray
) -> tuple[Float64[np.ndarray, "3"], float, float]:
    if not np.isfinite(moved_m).all():
        moved_m = np.zeros_like(seen_m)
    centred = moved_m - moved_m.mean(axis=0)
    energy = float((centred**2).sum())
    travel = 0.0
    if energy > len(seen_m) * LEAST_TRAVEL_M**2:
        travel = float((centred * (seen_m - np.median(seen_m, axis=0))).sum() / energy)
        travel = min(max(travel, 0.0), 1.0)
    places = seen_m - travel * moved_m
    place = np.median(places, axis=0)
    # By the worst twentieth, not the middle: people's knuckles are off most in a fist.
    off_m = np.linalg.norm(places - place, axis=1)
    left_m = float(np.percentile(off_m, 95)) / CHI_95
    return place, travel, left_m


@dataclass(frozen=True)
class RetargetResult:
    """Joint angles over time, always finite and inside the limits.

    Attributes:
        joints_rad: angles in the order of the hand's joints (Wuji: 20, firmware order).
        status: `RetargetStatus` a sample.
        finger_status: `RetargetStatus` of every finger.
        tip_error_m: distance of each fingertip from its measured place, both seen from the knuckle,
            at the person's size; zero where `solved` is False.
        solved: which fingers followed points of this sample.
    """

    joints_rad: Float64[np.ndarray, "time joints"]
    status: UInt8[np.ndarray, " time"]
    finger_status: UInt8[np.ndarray, "time fingers"]
    tip_error_m: Float64[np.ndarray, "time fingers"]
    solved: Bool[np.ndarray, "time fingers"]


class HandRetargeter:
    """Follows a tracked hand with the robot hand of the same side.

    `retarget` may run in several threads at once; `step` continues from the previous sample of one
    live stream. The hand is "left" or "right" for the Wuji hand, or any one with keypoints of its
    side. A profile of None is measured from the recording (`retarget`), or each sample is used
    alone (`step`).
    """

    def __init__(
        self,
        hand: str | HandModel,
        profile: HandProfile | None = None,
        options: RetargetOptions | None = None,
    ) -> None:
        self.hand = RobotHand(hand) if isinstance(hand, str) else hand
        self.profile = profile
        self.options = options or RetargetOptions()
        self._arrays = hand_arrays(self.hand)
        self._is_joint = joint_places(self.hand)
        self._tuning = self.options.tuning()
        self._live = self.options.tuning(is_live=True)
        self._person = person_arrays(profile, self.hand)
        self._memory = self._blank()
        self._was_sent = False
        # Buffers of `step`, which is called often.
        self._scratch = np.zeros(1, dtype=SCRATCH)
        self._elapsed_s = np.zeros(1)

    def reset(self, joints_rad: np.ndarray | None = None) -> None:
        """Forget all samples: the next `step` searches from several starts.

        The next outputs lead at the rate limit from the robot's joints [J], if given. Raises
        ShapeError: not one angle a joint; InvalidInputError: angles that are not finite.
        """
        self._memory = self._blank()
        self._was_sent = joints_rad is not None
        if joints_rad is None:
            return
        angles, hand = np.asarray(joints_rad, dtype=np.float64), self.hand
        if angles.shape != hand.lower_rad.shape:
            raise ShapeError(f"joints_rad: got {angles.shape}, expected {hand.lower_rad.shape}")
        if not np.isfinite(angles).all():
            raise InvalidInputError(f"joints_rad: got {angles.tolist()}, expected finite angles")
        self._memory.joints_rad[self._is_joint] = np.clip(angles, hand.lower_rad, hand.upper_rad)

    def step(self, keypoints_m: np.ndarray, elapsed_s: float = NOMINAL_PERIOD_S) -> RetargetResult:
        """Joint angles of the next sample (T = 1), live; untracked fingers hold their angles.

        Keypoints are [25, 3] in wrist axes (m), NaN where missing, `elapsed_s` after the sample
        before. No joint goes further than `velocity_limit_rad_s` allows in the time elapsed, nor
        than `max_step_rad`: a finger that is found again is REACQUIRED until it has caught up. Only
        the first output after the start or `reset` is where the hand is. Raises ShapeError: wrong
        shape; InvalidInputError: elapsed time not positive and finite.
        """
        keypoints = np.ascontiguousarray(keypoints_m, dtype=np.float64)
        if keypoints.shape != (NUM_KEYPOINTS, 3):
            raise ShapeError(f"keypoints: got shape {keypoints.shape}, expected [25, 3]")
        if not 0 < elapsed_s < np.inf:
            raise InvalidInputError(f"elapsed_s: got {elapsed_s}, expected a positive time")
        self._elapsed_s[0] = elapsed_s
        tuning = self._live if self._was_sent else self._tuning
        self._was_sent = True
        tables = (self._arrays, self._person, tuning, self._scratch)
        return self._follow(tables, (keypoints[None], self._elapsed_s), self._memory)

    def retarget(
        self,
        keypoints_m: np.ndarray,
        valid: np.ndarray | None = None,
        *,
        t_s: np.ndarray | None = None,
    ) -> RetargetResult:
        """Joint angles of a whole recording; untracked stretches are interpolated in time.

        Keypoints are [T, 25, 3] in wrist axes (m), NaN, or False in `valid` [T, 25], where they are
        not to be used; times [T] rise (60 Hz if None). Raises ShapeError: wrong shapes;
        InvalidInputError: times that do not rise, wrong unit, or a finger that is tracked, but
        followed in no sample. Joints of one that is never tracked are at rest.
        """
        keypoints = checked_keypoints(keypoints_m)
        if valid is not None:
            keypoints = np.where(
                _checked_valid(valid, len(keypoints))[..., None], keypoints, np.nan
            )
        elapsed_s = _elapsed_s(len(keypoints), t_s)
        profile = self.profile or measure_profile(
            _with_every_finger(keypoints, self.hand.side), self.hand
        )
        person = person_arrays(profile, self.hand)
        if not profile.is_rigid:
            keypoints = smoothed(keypoints, profile.point_sigma_m)
            person["noise_m2"] = 0.0
        # Of slow trackers, not every sample is a loss.
        lost_s = max(self.options.reacquire_after_s, 1.5 * float(np.median(elapsed_s)))
        tuning = replace(self.options, reacquire_after_s=lost_s).tuning()
        tables = (self._arrays, person, tuning, np.zeros(1, dtype=SCRATCH))
        result = self._follow(tables, (keypoints, elapsed_s), self._blank())
        is_tracked = (result.finger_status == IMPLAUSIBLE).any(axis=0)
        if not result.solved.any():
            is_tracked[:] = True
        fingers = zip(self.hand.fingers, is_tracked & ~result.solved.any(axis=0), strict=True)
        if lost := [finger.chain for finger, is_other in fingers if is_other]:
            raise InvalidInputError(
                f"keypoints of the {self.hand.side} hand: {', '.join(lost)} followed in no sample "
                "(bones or knuckles are not those of the profile, or nodes are missing); expected "
                "every finger that is tracked at least once"
            )
        return replace(result, joints_rad=self._filled(result, np.cumsum(elapsed_s)))

    def measure(self, keypoints_m: np.ndarray) -> HandProfile:
        """A person's profile from an open, closing, spreading hand (`measure_profile`)."""
        return measure_profile(keypoints_m, self.hand)

    def _blank(self) -> Memory:
        rest = np.clip(0.0, self._arrays["lower_rad"][0], self._arrays["upper_rad"][0])
        return Memory.starting_at(rest[: len(self.hand.fingers)])

    def _follow(
        self, tables: tuple[np.ndarray, ...], samples: tuple[np.ndarray, ...], memory: Memory
    ) -> RetargetResult:
        output = Output.of(len(samples[0]), len(self.hand.fingers))
        retarget_samples(tables, samples, memory, output)
        return RetargetResult(
            joints_rad=output.joints_rad[:, self._is_joint],
            status=output.status,
            finger_status=output.finger_status,
            tip_error_m=output.tip_error_m,
            solved=output.finger_status < IMPLAUSIBLE,
        )

    def _filled(self, result: RetargetResult, t_s: np.ndarray) -> np.ndarray:
        """Angles with untracked stretches of fingers filled linearly, in time; held at ends."""
        filled = result.joints_rad.copy()
        for joint, finger in enumerate(self.hand.finger_of_joint):
            known = result.solved[:, finger]
            if not known.any():
                continue
            filled[~known, joint] = np.interp(
                t_s[~known], t_s[known], result.joints_rad[known, joint]
            )
        return filled


def warm_up() -> None:
    """Compile the solver, or load it from numba's cache: seconds once a machine, then a moment."""
    keypoints = np.full((1, NUM_KEYPOINTS, 3), np.nan)
    HandRetargeter("right").step(keypoints[0])
    smoothed(keypoints, 0.0)


def _with_every_finger(keypoints_m: np.ndarray, side: str) -> Float64[np.ndarray, "time 25 3"]:
    """Keypoints with the mean hand's nodes of fingers that are complete in no sample."""
    filled = keypoints_m
    for chain in CHAINS:
        nodes = solver_indices(chain)
        if not np.isfinite(keypoints_m[:, nodes]).all(axis=(-1, -2)).any():
            filled = filled.copy() if filled is keypoints_m else filled
            filled[:, nodes] = mean_hand_m(side)[nodes]
    return filled


def _checked_valid(valid: np.ndarray, num_samples: int) -> Bool[np.ndarray, "time 25"]:
    mask = np.asarray(valid)
    if mask.dtype != np.bool_ or mask.shape != (num_samples, NUM_KEYPOINTS):
        raise ShapeError(
            f"valid: got {mask.dtype} {list(mask.shape)}, expected bool "
            f"[{num_samples}, {NUM_KEYPOINTS}], one value for each node"
        )
    return mask


def _elapsed_s(num_samples: int, t_s: np.ndarray | None) -> Float64[np.ndarray, " time"]:
    elapsed = np.full(num_samples, NOMINAL_PERIOD_S)
    if t_s is not None:
        times = np.asarray(t_s, dtype=np.float64)
        if times.shape != (num_samples,):
            raise ShapeError(f"t_s: got shape {times.shape}, expected [{num_samples}]")
        elapsed[1:] = np.diff(times)
        wrong = ~((elapsed > 0) & np.isfinite(elapsed) & np.isfinite(times))
        if wrong.any():
            at = int(np.argmax(wrong))
            raise InvalidInputError(
                f"t_s: sample {at} is {elapsed[at]:g} s after the one before; expected finite, "
                "rising times"
            )
    return elapsed
