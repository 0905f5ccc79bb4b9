"""`HandRetargeter`: joint angles of a robot hand that follow a tracked human hand."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import CHAINS, NUM_KEYPOINTS, mean_hand_m, solver_indices
from dextouch.hands.robot_hand import HandModel, RobotHand
from services.alignment.retargeting.hand_checks import checked_keypoints
from services.alignment.retargeting.hand_profile import HandProfile, measure_profile, person_arrays
from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    NOMINAL_PERIOD_S,
    SCRATCH,
    Memory,
    Output,
    RetargetOptions,
    hand_arrays,
    joint_places,
)
from services.alignment.retargeting.solver.smoothing import smoothed
from services.alignment.retargeting.solver.solve import retarget_samples


@dataclass(frozen=True)
class RetargetResult:
    """Joint angles over time, always finite and inside the limits.

    Attributes:
        joints_rad: angles in the order of the hand's joints (Wuji: 20, firmware order).
        status: `RetargetStatus` a sample.
        finger_status: `RetargetStatus` of every finger.
        tip_error_m: distance of each fingertip from its measured place, both seen from the
            knuckle, at the person's size; zero where `solved` is False, since there is none.
        solved: which fingers followed points of this sample.
    """

    joints_rad: Float64[np.ndarray, "time joints"]
    status: UInt8[np.ndarray, " time"]
    finger_status: UInt8[np.ndarray, "time fingers"]
    tip_error_m: Float64[np.ndarray, "time fingers"]
    solved: Bool[np.ndarray, "time fingers"]


class HandRetargeter:
    """Follows a tracked hand with the robot hand of the same side.

    `retarget` may run in several threads at once; `step` continues from the previous sample, so a
    retargeter can be used for one live stream only.

    Args:
        hand: "left" or "right" for the Wuji hand, or any hand with keypoints of its side.
        profile: of the person; if None, it is measured from the recording (`retarget`) or each
            sample is used alone (`step`).
        options: of the solver.

    Raises:
        UnknownNameError: any other side.
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

        Args:
            joints_rad: [J], where the robot's joints are; the next outputs lead from there at the
                rate limit. None knows of no joints: the next output is wherever the hand is.

        Raises:
            ShapeError: not one angle a joint.
            InvalidInputError: angles that are not finite.
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
        """Joint angles of the next sample, live; fingers that are not tracked hold their angles.

        No joint goes further from one output to the next than `velocity_limit_rad_s` allows in the
        time elapsed, nor than `max_step_rad`, whatever was lost before: a finger that is found
        again is REACQUIRED until it has caught up. Only the first output after the start or
        `reset` is where the hand is; give `reset` the robot's angles to begin there.

        Args:
            keypoints_m: [25, 3], metres, wrist axes; NaN marks a missing node.
            elapsed_s: since the sample before.

        Returns:
            A result of one sample (T = 1).

        Raises:
            ShapeError: wrong shape.
            InvalidInputError: elapsed time not positive and finite.
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

        Args:
            keypoints_m: [T, 25, 3], metres, wrist axes; NaN marks a missing node.
            valid: bool [T, 25], False for nodes that are not to be used; None uses all that are
                not NaN.
            t_s: [T] rising times, relative to any moment; None takes 60 Hz.

        Raises:
            ShapeError: wrong shapes.
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
        if never := [finger.chain for finger, is_other in fingers if is_other]:
            raise InvalidInputError(
                f"keypoints of the {self.hand.side} hand: {', '.join(never)} followed in no sample "
                "(bones or knuckles are not those of the profile, or nodes are missing); expected "
                "every finger that is tracked at least once"
            )
        return replace(result, joints_rad=self._filled(result, np.cumsum(elapsed_s)))

    def measure(self, keypoints_m: np.ndarray) -> HandProfile:
        """Measure the profile of a person from calibration samples.

        Args:
            keypoints_m: [T, 25, 3] of an open, closing and spreading hand.

        Raises:
            ShapeError: wrong shape.
            InvalidInputError: wrong unit, or a finger that is complete in no sample.
        """
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
        """Angles with untracked stretches of fingers filled linearly, in time; held at ends.

        So the rate limit, which the samples around keep, holds within as well.
        """
        filled = result.joints_rad.copy()
        for joint, finger in enumerate(np.nonzero(self._is_joint)[0]):
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
    """Keypoints with the mean hand's nodes of fingers that are complete in no sample.

    So that a person whose finger is never seen, or missing, has a profile of the others. Trackers
    may lack the metacarpals of all fingers, which no profile has.
    """
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
