"""Keypoints of a tracked hand in, the robot hand's joint angles with an error and a status out."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.errors import InvalidInputError
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from dextouch.hands.skeleton import CHAINS
from services.alignment.retargeting.finger_solver import FingerSolver, Solution
from services.alignment.retargeting.hand_normalization import normalize_hand

# Below this cost a problem is solved to well under a micrometre and needs no second start.
EXACT_COST_M2 = 1e-16
# Above it (3 mm) the search may sit in a wrong valley: all starts are tried.
SUSPICIOUS_COST_M2 = 9e-6
# Where searches start, as fractions from lower to upper limit.
FIRST_STARTS = ((0.45, 0.50, 0.40, 0.45), (0.75, 0.50, 0.75, 0.70))
MORE_STARTS = (
    (0.30, 0.25, 0.60, 0.50),
    (0.60, 0.80, 0.45, 0.55),
    (0.20, 0.60, 0.20, 0.20),
    (0.85, 0.30, 0.30, 0.85),
    (0.15, 0.85, 0.85, 0.15),
    (0.90, 0.75, 0.10, 0.50),
)


class RetargetStatus(IntEnum):
    """How much of a step is the solver's own answer; the worst that applies."""

    SOLVED = 0
    PARTIAL = 1
    UNCONVERGED = 2
    MISSING = 3


@dataclass(frozen=True)
class RetargetResult:
    """Joint angles over time, always finite and inside the limits.

    Attributes:
        joints_rad: 20 angles a step in firmware order.
        status: `RetargetStatus` a step. PARTIAL: some fingers, MISSING: all fingers were not
            tracked and are interpolated from the steps around.
        tip_error_m: distance of each fingertip from its target, both seen from the knuckle;
            zero where `solved` is False, since there is no target.
        solved: which fingers had usable keypoints.
    """

    joints_rad: Float64[np.ndarray, "time 20"]
    status: UInt8[np.ndarray, " time"]
    tip_error_m: Float64[np.ndarray, "time 5"]
    solved: Bool[np.ndarray, "time 5"]


class HandRetargeter:
    """Follows a tracked hand with the robot hand of the same side, finger by finger.

    Args:
        side: "left" or "right".

    Raises:
        UnknownNameError: any other side.
    """

    def __init__(self, side: str) -> None:
        self.hand = RobotHand(side)
        self._solver = FingerSolver(self.hand)
        span = self._solver.upper_rad - self._solver.lower_rad
        self._first_starts, self._more_starts = (
            [self._solver.lower_rad + np.array(fractions) * span for fractions in starts]
            for starts in (FIRST_STARTS, MORE_STARTS)
        )

    def retarget(self, keypoints_m: np.ndarray, valid: np.ndarray | None = None) -> RetargetResult:
        """Joint angles whose finger bones point where the tracked ones do.

        Args:
            keypoints_m: [T, 25, 3], metres, wrist axes; NaN marks a missing node.
            valid: bool [T, 25], what the tracker trusts; None trusts every finite node.

        Raises:
            ShapeError: wrong shapes.
            InvalidInputError: wrong unit, or a finger that is not tracked in any step.
        """
        targets = normalize_hand(keypoints_m, self.hand, valid)
        never = np.asarray(~targets.usable.any(axis=0))
        if never.any():
            names = ", ".join(name for name, gone in zip(CHAINS, never, strict=True) if gone)
            raise InvalidInputError(
                f"keypoints of the {self.hand.side} hand: no step shows all nodes of {names}; "
                "expected every finger at least once"
            )
        solution = self._solve(targets.from_knuckle_m, targets.usable)
        joints = _fill(solution.joints_rad, targets.usable)
        return RetargetResult(
            joints_rad=joints.reshape(-1, NUM_JOINTS),
            status=_status(targets.usable, solution.converged),
            tip_error_m=self._tip_errors(joints, targets.from_knuckle_m, targets.usable),
            solved=targets.usable,
        )

    def _solve(self, targets_m: np.ndarray, usable: np.ndarray) -> Solution:
        """Best of several starts; fixed ones first, then the neighbours' answers in time."""
        shape = (len(targets_m), NUM_FINGERS, 4)
        first, *others = (np.broadcast_to(start, shape) for start in self._first_starts)
        best = self._solver.solve(targets_m, first)
        for start in others:
            best = self._retry(best, targets_m, usable & (best.cost_m2 > EXACT_COST_M2), start)
        for fixed in self._more_starts:
            suspicious = usable & (best.cost_m2 > SUSPICIOUS_COST_M2)
            best = self._retry(best, targets_m, suspicious, np.broadcast_to(fixed, shape))
        for shift in (1, -1):
            suspicious = usable & (best.cost_m2 > SUSPICIOUS_COST_M2)
            best = self._retry(best, targets_m, suspicious, np.roll(best.joints_rad, shift, axis=0))
        return best

    def _retry(
        self, best: Solution, targets_m: np.ndarray, again_mask: np.ndarray, start_rad: np.ndarray
    ) -> Solution:
        """Search once more in the steps where a finger is marked; keep what is better."""
        open_rows = np.flatnonzero(again_mask.any(axis=1))
        if not open_rows.size:
            return best
        again = self._solver.solve(targets_m[open_rows], start_rad[open_rows])
        joints, cost, converged = best.joints_rad.copy(), best.cost_m2.copy(), best.converged.copy()
        # A hair of difference is rounding, not another minimum: keep the first.
        wins = again.cost_m2 < cost[open_rows] * (1 - 1e-6)
        at = open_rows[np.nonzero(wins)[0]], np.nonzero(wins)[1]
        joints[at], cost[at], converged[at] = (
            again.joints_rad[wins],
            again.cost_m2[wins],
            again.converged[wins],
        )
        return Solution(joints, cost, converged)

    def _tip_errors(
        self, joints: np.ndarray, targets_m: np.ndarray, usable: np.ndarray
    ) -> Float64[np.ndarray, "time 5"]:
        points = self.hand.chain_points_m(joints.reshape(-1, NUM_JOINTS))
        reached = points[:, :, 3] - points[:, :, 0]
        error = np.linalg.norm(reached - targets_m[:, :, 2], axis=-1)
        return np.where(usable, error, 0.0)


def _fill(joints: np.ndarray, usable: np.ndarray) -> Float64[np.ndarray, "time 5 4"]:
    """Untracked stretches of a finger, linearly between the steps around; held at the ends."""
    filled = joints.copy()
    steps = np.arange(len(joints))
    for finger in range(NUM_FINGERS):
        known = usable[:, finger]
        if known.all():
            continue
        for joint in range(4):
            filled[~known, finger, joint] = np.interp(
                steps[~known], steps[known], joints[known, finger, joint]
            )
    return filled


def _status(usable: np.ndarray, converged: np.ndarray) -> UInt8[np.ndarray, " time"]:
    status = np.full(len(usable), RetargetStatus.SOLVED, dtype=np.uint8)
    status[~usable.all(axis=1)] = RetargetStatus.PARTIAL
    status[(usable & ~converged).any(axis=1)] = RetargetStatus.UNCONVERGED
    status[~usable.any(axis=1)] = RetargetStatus.MISSING
    return status
