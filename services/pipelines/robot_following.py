"""Live check whether the robot's hand can follow a tracked hand, and why not, finger by finger."""

import os
from collections.abc import Mapping
from typing import Final

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.schemas import FollowCause, Matrix
from dextouch.tactile.layout import Side
from services.alignment.retargeting import (
    HandRetargeter,
    RetargetOptions,
    RetargetResult,
    RetargetStatus,
    warm_up,
)
from services.alignment.retargeting.hand_retargeter import calibrated_profile
from services.alignment.retargeting.wrist import (
    calibrated_transform,
    calibration_name,
    hand_axes_check,
    to_wrist_axes,
)

# Tip errors from which a finger is not followed. Of motions that the robot can make, simulated
# people leave up to 10 mm (99th percentile) and 19.5 mm (largest of 7200 samples, 30 Hz), most in
# pinches: the solver moves tips to close them, so that one it cannot close shows here, too. Beside
# a joint that is held at a limit or by its speed, less proves it.
BLOCKED_M: Final = 0.010
REACH_M: Final = 0.020
# Joints end exactly at their limits; rounding only.
AT_LIMIT_RAD: Final = 1e-6
# Of the axes of the keypoints, a second at 30 Hz: turned axes would look like joint limits.
NUM_AXES_SAMPLES: Final = 30


class RobotHandCheck:
    """Follows the keypoints of one hand with the robot's, one sample a call.

    Of the station's calibration, the wrist frame of the keypoints and the profile of the person's
    hand are used if it has them. Raises InvalidInputError or ShapeError if one of them is invalid.
    """

    def __init__(self, side: Side, calibration: Mapping[str, Matrix]) -> None:
        self._side: Side = side
        self._calibration = calibration
        self._T_keypoints_wrist = calibrated_transform(calibration, calibration_name(side))
        # The robot's controller leads joints at their velocity limit between two samples, too.
        options = RetargetOptions(max_step_rad=np.inf)
        profile = calibrated_profile(calibration, side)
        self._retargeter = HandRetargeter(side, profile, options)
        self._before_rad: np.ndarray | None = None
        self._first: list[np.ndarray] | None = []
        # Loads the compiled solver.
        self._retargeter.step(np.full((25, 3), np.nan))
        self._retargeter.reset()

    def __call__(
        self, keypoints_m: np.ndarray, elapsed_s: float
    ) -> Mapping[str, FollowCause] | None:
        """Cause by finger of those that the robot cannot follow; None in the first second.

        Keypoints are [25, 3], in metres as the tracker sends them, NaN where not seen. Raises
        ShapeError for others, and InvalidInputError if those of a second are not a hand of this
        side in wrist axes.
        """
        keypoints = np.asarray(keypoints_m, dtype=np.float64)
        if self._first is not None and not self._axes_are_right(keypoints):
            return None
        if self._T_keypoints_wrist is not None:
            keypoints = to_wrist_axes(keypoints[None], self._T_keypoints_wrist)[0]
        result = self._retargeter.step(keypoints, elapsed_s)
        causes = self._causes(result, elapsed_s)
        self._before_rad = result.joints_rad[0]
        return causes

    def _axes_are_right(self, keypoints: np.ndarray) -> bool:
        self._first = [*(self._first or ()), keypoints]
        if len(self._first) < NUM_AXES_SAMPLES:
            return False
        samples, self._first = np.stack(self._first), []
        try:
            hand_axes_check(samples, self._side, self._calibration)
        except InvalidInputError as error:
            if error.details.get("fault") == "unseen":
                return False
            raise
        self._first = None
        return True

    def _causes(self, result: RetargetResult, elapsed_s: float) -> dict[str, FollowCause]:
        hand, joints_rad = self._retargeter.hand, result.joints_rad[0]
        at_limit = (joints_rad <= hand.lower_rad + AT_LIMIT_RAD) | (
            joints_rad >= hand.upper_rad - AT_LIMIT_RAD
        )
        step_rad = self._retargeter.options.velocity_limit_rad_s * elapsed_s - AT_LIMIT_RAD
        before_rad = joints_rad if self._before_rad is None else self._before_rad
        too_fast = np.abs(joints_rad - before_rad) >= step_rad
        causes: dict[str, FollowCause] = {}
        for finger, name in enumerate(one.chain for one in hand.fingers):
            joints = hand.finger_of_joint == finger
            status, off_m = result.finger_status[0, finger], result.tip_error_m[0, finger]
            is_off = off_m > BLOCKED_M
            # One that was lost still comes from where it was then.
            is_late = is_off and status == RetargetStatus.REACQUIRED
            if is_late or status >= RetargetStatus.IMPLAUSIBLE:
                causes[name] = "unseen"
            elif is_off and too_fast[joints].any():
                causes[name] = "speed"
            elif is_off and at_limit[joints].any():
                causes[name] = "limit"
            elif off_m > REACH_M:
                causes[name] = "reach"
        return causes


if __name__ == "__main__":
    # The station that waits for it records meanwhile.
    os.nice(10)
    warm_up()
