"""The robot hand: joint names, limits and forward kinematics in wrist coordinates."""

from functools import cached_property

import numpy as np
from jaxtyping import Float64

from dextouch.errors import NonFiniteError, ShapeError, UnknownNameError
from dextouch.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from dextouch.geometry.transforms import transform
from dextouch.hands.wuji_hand_2 import LEFT_HAND, RIGHT_HAND, FingerTable

NUM_JOINTS = 20
NUM_FINGERS = 5


class RobotHand:
    """Wuji Hand 2: five fingers × four hinges, thumb … little, from the wrist outwards.

    The four hinges of a finger are S1 flexion, S2 abduction, S3 and S4 flexion.

    Args:
        side: "left" or "right".

    Raises:
        UnknownNameError: any other side.
    """

    def __init__(self, side: str) -> None:
        tables = {"left": LEFT_HAND, "right": RIGHT_HAND}
        if side not in tables:
            raise UnknownNameError("side", side, list(tables))
        self.side = side
        self.fingers: tuple[FingerTable, ...] = tables[side]

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The 20 joint names in firmware order."""
        return tuple(row.name for finger in self.fingers for row in finger.joints)

    @cached_property
    def lower_rad(self) -> Float64[np.ndarray, "20"]:
        """Lower joint limits."""
        return np.array([row.limits_rad[0] for finger in self.fingers for row in finger.joints])

    @cached_property
    def upper_rad(self) -> Float64[np.ndarray, "20"]:
        """Upper joint limits."""
        return np.array([row.limits_rad[1] for finger in self.fingers for row in finger.joints])

    @cached_property
    def _offsets(self) -> Float64[np.ndarray, "5 4 4 4"]:
        rows = [list(finger.joints) for finger in self.fingers]
        R = rotation_from_quaternion(np.array([[row.q_wxyz for row in f] for f in rows]))
        return transform(R, np.array([[row.position_m for row in f] for f in rows]))

    @cached_property
    def _axes(self) -> Float64[np.ndarray, "5 4 3"]:
        return np.array([[row.axis for row in finger.joints] for finger in self.fingers])

    @cached_property
    def _tips(self) -> Float64[np.ndarray, "5 3"]:
        return np.array([finger.tip_m for finger in self.fingers])

    def joint_frames(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 5 4 4 4"]:
        """T_wrist_joint of every hinge, after its own turn.

        Args:
            joints_rad: [T, 20] joint angles in firmware order.

        Raises:
            ShapeError: not [T, 20].
            NonFiniteError: NaN or infinity.
        """
        q = np.asarray(joints_rad, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != NUM_JOINTS:
            raise ShapeError(f"joint angles: got shape {q.shape}, expected [T, {NUM_JOINTS}]")
        if not np.isfinite(q).all():
            raise NonFiniteError(f"joint angles of the {self.side} hand hold NaN or infinity")
        angles = q.reshape(-1, NUM_FINGERS, 4)
        turns = transform(rotation_from_vector(angles[..., None] * self._axes), np.zeros(3))
        frames = np.empty((len(q), NUM_FINGERS, 4, 4, 4))
        T_wrist_parent = np.broadcast_to(np.eye(4), (len(q), NUM_FINGERS, 4, 4))
        for joint in range(4):
            T_wrist_parent = T_wrist_parent @ self._offsets[:, joint] @ turns[:, :, joint]
            frames[:, :, joint] = T_wrist_parent
        return frames

    def chain_points_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 5 4 3"]:
        """MCP, PIP, DIP and tip of every finger in wrist coordinates, metres.

        "MCP" is the origin of the abduction frame (of the thumb: of the second CMC frame), the
        last common point of a finger before its first phalanx.
        """
        frames = self.joint_frames(joints_rad)
        tips = frames[:, :, 3, :3, :3] @ self._tips[:, :, None]
        tip_points = tips[..., 0] + frames[:, :, 3, :3, 3]
        return np.concatenate([frames[:, :, 1:, :3, 3], tip_points[:, :, None]], axis=2)

    def fingertips_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 5 3"]:
        """Fingertips, thumb … little, in wrist coordinates, metres, for joint angles [T, 20]."""
        return self.chain_points_m(joints_rad)[:, :, 3]
