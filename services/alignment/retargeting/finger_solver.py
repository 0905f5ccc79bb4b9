"""Targets for fingers in, joint angles inside their limits out: batched Levenberg–Marquardt.

Every step and finger is a problem of its own: four joints, nine residuals (PIP, DIP and tip minus
knuckle, three coordinates each), minimised in a box. All problems advance together; those that
are done drop out. A joint at a limit whose gradient points outward is held there (active set), a
step that would leave the box is cut at its border, so limits hold exactly.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.hands.robot_hand import NUM_FINGERS, RobotHand

MAX_ITERATIONS = 60
STEP_TOLERANCE_RAD = 1e-8
# A zero gradient for targets in metres: below this no step improves anything that matters.
GRADIENT_TOLERANCE = 1e-14
# Keeps a joint that moves nothing where it is; far below what the targets see (m²/rad²).
RIDGE = 1e-12
DAMPING_START = 1e-6
DAMPING_RANGE = (1e-12, 1e3)


@dataclass(frozen=True)
class Solution:
    """Joint angles of every problem, what is left of its residual, and whether it came to rest."""

    joints_rad: Float64[np.ndarray, "time 5 4"]
    cost_m2: Float64[np.ndarray, "time 5"]
    converged: Bool[np.ndarray, "time 5"]


class FingerSolver:
    """Solves the fingers of one robot hand.

    Args:
        hand: whose tree, axes and limits are used.
    """

    def __init__(self, hand: RobotHand) -> None:
        self._hand = hand
        self._axes = np.array([[row.axis for row in finger.joints] for finger in hand.fingers])
        self._tips = np.array([finger.tip_m for finger in hand.fingers])
        self.lower_rad = hand.lower_rad.reshape(NUM_FINGERS, 4)
        self.upper_rad = hand.upper_rad.reshape(NUM_FINGERS, 4)

    def solve(self, targets_m: np.ndarray, start_rad: np.ndarray) -> Solution:
        """Minimise |(PIP, DIP, tip) - knuckle - target|² from one start.

        Args:
            targets_m: [T, 5, 3, 3] finite, wrist axes.
            start_rad: [T, 5, 4]; clipped into the limits.
        """
        joints = np.clip(np.asarray(start_rad, dtype=np.float64), self.lower_rad, self.upper_rad)
        residual, jacobian = self._linearize(joints, targets_m)
        cost = (residual**2).sum(axis=-1)
        damping = np.full(cost.shape, DAMPING_START)
        converged = np.zeros(cost.shape, dtype=bool)
        for _ in range(MAX_ITERATIONS):
            rows = np.flatnonzero(~converged.all(axis=1))
            if not rows.size:
                break
            step, at_rest = self._step(joints[rows], residual[rows], jacobian[rows], damping[rows])
            trial = np.clip(joints[rows] + step, self.lower_rad, self.upper_rad)
            moved = np.abs(trial - joints[rows]).max(axis=-1)
            trial_residual, trial_jacobian = self._linearize(trial, targets_m[rows])
            trial_cost = (trial_residual**2).sum(axis=-1)
            better = (trial_cost <= cost[rows]) & ~converged[rows]
            at = (rows[:, None] * np.ones(NUM_FINGERS, dtype=int))[better], np.nonzero(better)[1]
            joints[at], cost[at] = trial[better], trial_cost[better]
            residual[at], jacobian[at] = trial_residual[better], trial_jacobian[better]
            damping[rows] = np.clip(
                damping[rows] * np.where(better, 0.2, 8.0), DAMPING_RANGE[0], DAMPING_RANGE[1]
            )
            converged[rows] |= at_rest | (moved < STEP_TOLERANCE_RAD)
        return Solution(joints, cost, converged)

    def _step(
        self, joints: np.ndarray, residual: np.ndarray, jacobian: np.ndarray, damping: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Damped Gauss–Newton step with the held joints left out, and where none is left to do."""
        gradient = np.einsum("tfrj,tfr->tfj", jacobian, residual)
        hessian = np.einsum("tfrj,tfrk->tfjk", jacobian, jacobian)
        held = ((joints <= self.lower_rad) & (gradient > 0)) | (
            (joints >= self.upper_rad) & (gradient < 0)
        )
        free = np.where(held, 0.0, 1.0)
        gradient = gradient * free
        hessian = hessian * free[..., :, None] * free[..., None, :]
        diagonal = np.einsum("tfjj->tfj", hessian)
        diagonal += damping[..., None] * (1e-4 + diagonal) + RIDGE + (1.0 - free)
        step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        return step * free, np.abs(gradient).max(axis=-1) < GRADIENT_TOLERANCE

    def _linearize(
        self, joints: np.ndarray, targets_m: np.ndarray
    ) -> tuple[Float64[np.ndarray, "time 5 9"], Float64[np.ndarray, "time 5 9 4"]]:
        """Residuals and their derivatives: a hinge moves a point by axis × (point - hinge)."""
        frames = self._hand.joint_frames(joints.reshape(len(joints), -1))
        rotations, origins = frames[..., :3, :3], frames[..., :3, 3]
        axes = (rotations @ self._axes[..., None])[..., 0]
        tips = (rotations[:, :, 3] @ self._tips[..., None])[..., 0] + origins[:, :, 3]
        points = np.stack([origins[:, :, 2], origins[:, :, 3], tips], axis=2)
        knuckle = origins[:, :, 1]
        residual = points - knuckle[:, :, None] - targets_m
        jacobian = np.zeros((*residual.shape, 4))
        # Both knuckle joints turn the finger about the knuckle as far as differences to it go.
        for joint, hinge in (
            (0, knuckle),
            (1, knuckle),
            (2, origins[:, :, 2]),
            (3, origins[:, :, 3]),
        ):
            first = max(joint - 1, 0)
            arm = points[:, :, first:] - hinge[:, :, None]
            jacobian[:, :, first:, :, joint] = np.cross(axes[:, :, None, joint], arm)
        return residual.reshape(*residual.shape[:2], 9), jacobian.reshape(*residual.shape[:2], 9, 4)
