"""Actions of hands that a person moves from the page, by increments within limits of speed."""

from collections.abc import Sequence
from typing import Annotated, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from dextouch import schemas
from dextouch.frozen_model import FrozenModel, example
from dextouch.geometry import invert
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import (
    JOINTS_LEFT,
    JOINTS_RIGHT,
    WRIST_LEFT,
    WRIST_RIGHT,
    pose_from_9d,
    pose_to_9d,
)
from dextouch.hands.robot_hand import SIDES, RobotHand

# Chosen: as fast as demonstrators move hands; a task then takes its usual five seconds.
SPEED_M_S: Final = 0.25
TURN_RAD_S: Final = 1.5
JOINT_RAD_S: Final = 2.0
# Of a wrist from its start along each axis: what the arms reach on every task.
REACH_M: Final = 0.5
# Flexion of closed fingers, as a share of the joint's limit.
CLOSED: Final = 0.8
_COLUMNS: Final = {"left": (WRIST_LEFT, JOINTS_LEFT), "right": (WRIST_RIGHT, JOINTS_RIGHT)}
Side = Literal["left", "right"]
Share = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]


class HandMove(FrozenModel):
    """How one hand moves over a chunk; every number is a share of the largest speed, −1 … 1.

    `right` and `forward` are horizontal, as the head camera sees them; `turn` is about the forearm,
    `tilt` about the camera's horizontal axis; `close` makes a fist, negative opens the fingers.
    """

    right: Share = 0.0
    forward: Share = 0.0
    up: Share = 0.0
    turn: Share = 0.0
    tilt: Share = 0.0
    close: Share = 0.0


class Moves(FrozenModel):
    """Body of POST /v1/comparisons/{id}/moves: hands that are not named stay where they are."""

    model_config = example(hands={"right": {"forward": 1.0}})

    hands: dict[Side, HandMove] = Field(default={})


class HandDriver:
    """Turns moves into rows of actions, from the pose in which a rollout began."""

    def __init__(
        self, first: schemas.Observation, origin: schemas.RolloutOrigin, *, rate_hz: float
    ) -> None:
        self._row = np.array(first.action_reached[-1], np.float64)
        self._period_s = 1.0 / rate_hz
        T_left, T_right, T_camera = origin.anchor.as_tuple()
        self._anchors = {"left": T_left, "right": T_right}
        self._fingers = {side: _fingers(RobotHand(side)) for side in SIDES}
        # Axes of the person who looks at the picture; z of the world is up.
        up = np.array([0.0, 0.0, 1.0])
        forward = np.cross(up, T_camera[:3, 0])
        forward /= np.linalg.norm(forward)
        self._axes = np.stack([np.cross(forward, up), forward, up], axis=1)

    def rows(self, moves: Moves, num_steps: int) -> Float64[np.ndarray, "steps 67"]:
        """The next actions, relative to step 0."""
        made = []
        for _ in range(num_steps):
            for side, move in moves.hands.items():
                self._advance(side, move)
            made.append(self._row.copy())
        return np.stack(made)

    def _advance(self, side: Side, move: HandMove) -> None:
        wrist, joints = _COLUMNS[side]
        anchor = self._anchors[side]
        T_world_wrist = anchor @ pose_from_9d(self._row[wrist])
        shift_m = self._axes @ self._limited((move.right, move.forward, move.up), SPEED_M_S)
        place_m = T_world_wrist[:3, 3] + shift_m
        T_world_wrist[:3, 3] = np.clip(place_m, anchor[:3, 3] - REACH_M, anchor[:3, 3] + REACH_M)
        turn, tilt = self._limited((move.turn, move.tilt), TURN_RAD_S)
        about_fingers = rotation_from_vector(np.array([0.0, 0.0, -turn]))
        R = rotation_from_vector(tilt * self._axes[:, 0]) @ T_world_wrist[:3, :3] @ about_fingers
        T_world_wrist[:3, :3] = R
        self._row[wrist] = pose_to_9d(invert(anchor) @ T_world_wrist)
        bends, opened_rad, closed_rad = self._fingers[side]
        wanted_rad = closed_rad if move.close > 0 else opened_rad
        step_rad = abs(move.close) * JOINT_RAD_S * self._period_s
        steps_rad = np.clip(wanted_rad - self._row[joints], -step_rad, step_rad)
        self._row[joints] += np.where(bends, steps_rad, 0.0)

    def _limited(self, shares: Sequence[float], speed: float) -> Float64[np.ndarray, " n"]:
        """The step along several axes, together no faster than `speed`."""
        direction = np.array(shares, np.float64)
        return direction / max(1.0, float(np.linalg.norm(direction))) * speed * self._period_s


def _fingers(hand: RobotHand) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which joints bend, and their angles in an open and in a closed hand (rad)."""
    bends = np.array(["abd" not in name for name in hand.joint_names])
    opened_rad = np.clip(0.0, hand.lower_rad, hand.upper_rad)
    return bends, opened_rad, np.clip(CLOSED * hand.upper_rad, hand.lower_rad, hand.upper_rad)
