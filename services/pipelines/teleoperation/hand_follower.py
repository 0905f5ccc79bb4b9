"""A robot hand that follows a tracked one: watchdog, limits, and the next command.

It reads no clock and opens no connection: times are given, in seconds of any monotonic clock.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.hands.robot_hand import HandModel
from dextouch.schemas import Matrix
from dextouch.tactile.layout import Side
from services.alignment.retargeting import HandRetargeter, RetargetOptions, RetargetStatus
from services.alignment.retargeting.hand_retargeter import calibrated_profile, measure_profile
from services.alignment.retargeting.wrist import (
    calibrated_transform,
    calibration_name,
    hand_axes_check,
    to_wrist_axes,
)
from services.pipelines.teleoperation.finger_gaps import FingerGaps
from services.pipelines.teleoperation.settings import CommandLimits
from services.twin.hands import twin_hand

# Samples that are checked before the hand moves: 2 s at 60 Hz, as a profile needs.
NUM_CHECKED: Final = 120
# Clocks of devices drift by 100 parts in a million at most (quartz over temperature); so much the
# smallest delay may rise.
DRIFT: Final = 1e-4
# A sample that is so much earlier than its clock allows has a wrong time (chosen: longer than any
# network's jitter).
MAX_EARLY_S: Final = 1.0
# A joint this close to a limit is at it; solutions end exactly there.
AT_LIMIT_RAD: Final = 1e-3


class FollowerStatus(StrEnum):
    """What a hand does: see docs/teleoperation.md."""

    NOT_READY = "not_ready"
    FOLLOWING = "following"
    HOLDING = "holding"
    RELAXING = "relaxing"
    STOPPED = "stopped"


@dataclass(frozen=True)
class HandSample:
    """Keypoints of a hand ([25, 3], metres, NaN where not seen) and the tracker's time of them."""

    keypoints_m: Float64[np.ndarray, "25 3"]
    t_device_ns: int


@dataclass(frozen=True)
class Command:
    """Joint angles to go to within one period, and how they came about.

    `step` counts commands from 0. `t_device_ns` is the time of the sample that they follow, and
    `age_s` how long ago it was received and had been on its way beyond the usual; None before the
    first. `received_s` is when it was received, if this is the first command after it. Status and
    error of fingers are those of retargeting, `lag_rad` is the largest distance of a joint from the
    angle that it asks for, `at_limits` the share of joints at a limit of position, and
    `stopped_fingers` are those that would otherwise run into another one.
    """

    step: int
    status: FollowerStatus
    joints_rad: Float64[np.ndarray, " joints"]
    t_device_ns: int | None
    age_s: float | None
    received_s: float | None
    finger_status: tuple[RetargetStatus, ...]
    tip_error_m: Float64[np.ndarray, " fingers"]
    lag_rad: float
    at_limits: float
    stopped_fingers: tuple[str, ...]


class _SampleAges:
    """Ages of samples by the tracker's clock, whose offset to ours only the samples show.

    The smallest delay so far counts as none: what exceeds it is waiting time.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._offset_s = self._at_s = 0.0
        self._zero_ns = 0

    def delay_s(self, t_device_ns: int, t_s: float) -> float | None:
        """Waiting time of a sample that arrives now; None for a time that cannot be right."""
        if self._last_ns is None:
            self._zero_ns, self._offset_s = t_device_ns, t_s
        elif t_device_ns <= self._last_ns:
            return None
        offset_s = t_s - (t_device_ns - self._zero_ns) * 1e-9
        if offset_s < self._offset_s - MAX_EARLY_S:
            return None
        drifted_s = self._offset_s + DRIFT * (t_s - self._at_s)
        self._offset_s, self._at_s = min(offset_s, drifted_s), t_s
        self._last_ns = t_device_ns
        return offset_s - self._offset_s


class HandFollower:
    """Follows samples of a tracked hand with commands for the robot hand of the same side.

    Every command keeps these limits, whatever samples come or do not, and however late it is:
    joints are within the hand's limits; none goes further than its speed times the period from
    the command before; fingers stop before they overlap. Of the calibration, the matrices of
    `calibration.json`, it uses the person's wrist axes and profile, and raises InvalidInputError or
    ShapeError if they are invalid. `refused` counts samples that were not followed, by reason.
    """

    def __init__(
        self, side: Side, limits: CommandLimits, rate_hz: float, calibration: Mapping[str, Matrix]
    ) -> None:
        shape = twin_hand(side, "robot")
        self.hand: HandModel = shape.kinematics
        self.limits, self.period_s = limits, 1 / rate_hz
        self.refused: Counter[str] = Counter()
        self._side: Side = side
        self._calibration = calibration
        self._T_keypoints_wrist = calibrated_transform(calibration, calibration_name(side))
        self._profile = calibrated_profile(calibration, side)
        self._lower_rad = self.hand.lower_rad + limits.margin_rad
        self._upper_rad = self.hand.upper_rad - limits.margin_rad
        self._relaxed_rad = np.clip(0.0, self._lower_rad, self._upper_rad)
        self._gaps = FingerGaps(self.hand, np.array(shape.shape.radii_m))
        self.start(self._relaxed_rad)

    def start(self, joints_rad: np.ndarray) -> None:
        """Begin at the angles [J] that the robot measured, which the first command repeats.

        Raises InvalidInputError for not one finite angle a joint, or one that is beyond a limit by
        more than a joint may go in one period.
        """
        joints = np.asarray(joints_rad, dtype=np.float64)
        if joints.shape != self._lower_rad.shape or not np.isfinite(joints).all():
            raise InvalidInputError(
                f"joints of the {self._side} hand: got {joints.tolist()}, expected "
                f"{len(self._lower_rad)} finite angles, those that the motors are at"
            )
        inside = np.clip(joints, self._lower_rad, self._upper_rad)
        excess_rad = np.abs(joints - inside)
        if excess_rad.max() > self.limits.speed_rad_s * self.period_s:
            worst = int(np.argmax(excess_rad))
            raise InvalidInputError(
                f"joint {self.hand.joint_names[worst]}: got {joints[worst]:.3f} rad, expected "
                f"{self._lower_rad[worst]:.3f} … {self._upper_rad[worst]:.3f}; move the hand there"
            )
        self._joints_rad = self._target_rad = inside
        self._retargeter: HandRetargeter | None = None
        self._checked: list[np.ndarray] = []
        self._ages = _SampleAges()
        self._newest: tuple[HandSample, float, float] | None = None
        self._followed: HandSample | None = None
        self._solved_ns: int | None = None
        self._last_m: np.ndarray | None = None
        self._fresh_s = -np.inf
        self._sent_s: float | None = None
        self._step = 0
        self._is_stopped = False
        self._finger_status = (RetargetStatus.MISSING,) * len(self.hand.fingers)
        self._tip_error_m = np.zeros(len(self.hand.fingers))

    def stop(self) -> None:
        """Hold the present angles until the next `start`."""
        self._is_stopped = True

    def receive(self, sample: HandSample, t_s: float) -> None:
        """Take a sample; it is followed by the next command, unless a newer one comes before.

        Samples that say nothing new are counted in `refused` and do not calm the watchdog.
        """
        delay_s = self._ages.delay_s(sample.t_device_ns, t_s)
        if delay_s is None:
            self.refused["time"] += 1
            if self._retargeter is None:
                # It may be the one before that was wrong, such as an old one from a cache.
                self._ages = _SampleAges()
        elif delay_s > self.limits.hold_after_s:
            self.refused["late"] += 1
        elif not np.isfinite(sample.keypoints_m).all(axis=1).any():
            self.refused["missing"] += 1
        elif self._last_m is not None and np.array_equal(
            sample.keypoints_m, self._last_m, equal_nan=True
        ):
            self.refused["repeated"] += 1
        else:
            self._last_m = sample.keypoints_m
            if self._retargeter is None:
                self._checked.append(sample.keypoints_m)
            else:
                self._newest = sample, t_s, t_s - delay_s

    @property
    def can_check(self) -> bool:
        """Whether there are enough samples for `check_person`."""
        return self._retargeter is None and len(self._checked) >= NUM_CHECKED

    def check_person(self) -> None:
        """Check unit, side and axes of the first samples, and measure the person; takes 50 ms.

        From then on samples are followed. It may run in another thread than the commands. Raises
        InvalidInputError if they are not this hand in metres and in the wrist's axes, or do not
        show every finger; the next samples are checked instead.
        """
        keypoints_m, self._checked = np.stack(self._checked), []
        keypoints_m = hand_axes_check(keypoints_m, self._side, self._calibration)
        profile = self._profile or measure_profile(keypoints_m, self.hand)
        # Steps of commands are limited here, whatever the rate of the samples.
        options = RetargetOptions(velocity_limit_rad_s=self.limits.speed_rad_s, max_step_rad=np.inf)
        retargeter = HandRetargeter(self.hand, profile, options)
        retargeter.reset(self._joints_rad)
        self._retargeter = retargeter

    def command(self, t_s: float) -> Command:
        """The next command; called once a period."""
        since_s = 0.0 if self._sent_s is None else t_s - self._sent_s
        # Neither a late command nor two in quick succession may go further.
        elapsed_s = min(max(since_s, 0.0), self.period_s)
        self._sent_s = t_s
        received_s = self._follow_newest()
        age_s = t_s - self._fresh_s
        status = self._status(age_s)
        goal_rad = self._target_rad
        speed_rad_s = self.limits.speed_rad_s
        if status is FollowerStatus.RELAXING:
            goal_rad, speed_rad_s = self._relaxed_rad, self.limits.relax_speed_rad_s
        elif status is not FollowerStatus.FOLLOWING:
            goal_rad = self._joints_rad
        reach_rad = speed_rad_s * elapsed_s
        goal_rad = np.clip(goal_rad, self._lower_rad, self._upper_rad)
        step_rad = np.clip(goal_rad - self._joints_rad, -reach_rad, reach_rad)
        self._joints_rad, is_stopped = self._gaps.limited(
            self._joints_rad, step_rad, self.limits.clearance_m
        )
        if status is not FollowerStatus.FOLLOWING:
            # A finger that is not seen when samples come again stays where it is.
            self._target_rad = self._joints_rad
        self._step += 1
        return self._described(status, age_s, received_s, is_stopped)

    def _status(self, age_s: float) -> FollowerStatus:
        if self._is_stopped:
            return FollowerStatus.STOPPED
        if self._followed is None:
            return FollowerStatus.NOT_READY
        if age_s <= self.limits.hold_after_s:
            return FollowerStatus.FOLLOWING
        is_held = age_s <= self.limits.relax_after_s
        return FollowerStatus.HOLDING if is_held else FollowerStatus.RELAXING

    def _follow_newest(self) -> float | None:
        """Retarget the newest sample, and return when it was received; None if there is none."""
        if self._newest is None or self._retargeter is None:
            return None
        (sample, received_s, fresh_s), self._newest = self._newest, None
        keypoints_m = sample.keypoints_m
        if self._T_keypoints_wrist is not None:
            keypoints_m = to_wrist_axes(keypoints_m[None], self._T_keypoints_wrist)[0]
        since_s = self.period_s
        if self._solved_ns is not None:
            since_s = (sample.t_device_ns - self._solved_ns) * 1e-9
        self._solved_ns = sample.t_device_ns
        result = self._retargeter.step(keypoints_m, since_s)
        self._finger_status = tuple(RetargetStatus(int(each)) for each in result.finger_status[0])
        if not result.solved[0].any():
            self.refused["implausible"] += 1
            return None
        is_new = result.solved[0][self.hand.finger_of_joint]
        self._target_rad = np.where(is_new, result.joints_rad[0], self._target_rad)
        self._tip_error_m = result.tip_error_m[0]
        self._followed, self._fresh_s = sample, fresh_s
        return received_s

    def _described(
        self,
        status: FollowerStatus,
        age_s: float,
        received_s: float | None,
        is_stopped: np.ndarray,
    ) -> Command:
        joints = self._joints_rad
        to_limit_rad = np.minimum(joints - self._lower_rad, self._upper_rad - joints)
        fingers = self.hand.fingers
        followed = self._followed
        return Command(
            step=self._step - 1,
            status=status,
            joints_rad=joints,
            t_device_ns=None if followed is None else followed.t_device_ns,
            age_s=None if followed is None else age_s,
            received_s=received_s,
            finger_status=self._finger_status,
            tip_error_m=self._tip_error_m,
            lag_rad=float(np.abs(self._target_rad - joints).max()),
            at_limits=float((to_limit_rad <= AT_LIMIT_RAD).mean()),
            stopped_fingers=tuple(fingers[index].chain for index in np.flatnonzero(is_stopped)),
        )
