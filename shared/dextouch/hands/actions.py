"""The 67-D action: layout, packing, and changes of the anchor of relative poses.

Equation 5 of the paper: a_t = [e_L, e_R, q_L, q_R, e_c]. e is a pose relative to an anchor step,
3 numbers of translation (metres) then 6 of rotation (`rotation_to_6d`); q are the robot hand's 20
joint angles (radians), `RobotHand` order. e_c is the head camera's optical frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_from_6d, rotation_to_6d
from dextouch.hands.robot_hand import RobotHand

ACTION_DIM = 67  # three poses of 9 and two hands of 20 (docs/rollout_api.md)
POSE_DIM = 9  # translation and two columns of the rotation
WRIST_LEFT = slice(0, 9)
WRIST_RIGHT = slice(9, 18)
JOINTS_LEFT = slice(18, 38)
JOINTS_RIGHT = slice(38, 58)
CAMERA_HEAD = slice(58, 67)
PARTS = (WRIST_LEFT, WRIST_RIGHT, JOINTS_LEFT, JOINTS_RIGHT, CAMERA_HEAD)
POSE_SLICES = (WRIST_LEFT, WRIST_RIGHT, CAMERA_HEAD)
# All pose columns: converting the three parts together takes half the time.
_POSE_COLUMNS = np.concatenate([np.arange(part.start, part.stop) for part in POSE_SLICES])

IDENTITY_POSE_9D = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True)
class AnchorPoses:
    """Measured absolute poses of the anchor step, to which action poses are relative."""

    T_world_wrist_left: Float64[np.ndarray, "4 4"]
    T_world_wrist_right: Float64[np.ndarray, "4 4"]
    T_world_camera_head: Float64[np.ndarray, "4 4"]

    def as_tuple(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Left wrist, right wrist, head camera."""
        return self.T_world_wrist_left, self.T_world_wrist_right, self.T_world_camera_head


@dataclass(frozen=True)
class HandTrajectory:
    """Absolute poses and joint angles over time."""

    Ts_world_wrist_left: Float64[np.ndarray, "time 4 4"]
    Ts_world_wrist_right: Float64[np.ndarray, "time 4 4"]
    joints_left_rad: Float64[np.ndarray, "time 20"]
    joints_right_rad: Float64[np.ndarray, "time 20"]
    Ts_world_camera_head: Float64[np.ndarray, "time 4 4"]

    def anchor(self, index: int) -> AnchorPoses:
        """The three poses at one step."""
        return AnchorPoses(
            self.Ts_world_wrist_left[index],
            self.Ts_world_wrist_right[index],
            self.Ts_world_camera_head[index],
        )


def action_names(*, has_robot_joints: bool = True) -> list[str]:
    """Names of the 67 components of an action or a state, in order.

    A pose is a translation in metres and two columns of the rotation matrix. Joints without those
    of the robot's hands, such as of a human hand, have numbers in place of names.
    """
    rotation = [f"r{row}{column}" for column in (0, 1) for row in range(3)]
    left, right, head = (
        [f"{name}.{part}" for part in ("x_m", "y_m", "z_m", *rotation)]
        for name in ("wrist_left", "wrist_right", "camera_head")
    )
    joints = [
        f"{name}_rad" if has_robot_joints else f"{side}_joint_{index}_rad"
        for side in ("left", "right")
        for index, name in enumerate(RobotHand(side).joint_names)
    ]
    return [*left, *right, *joints, *head]


def all_finite(array: np.ndarray) -> bool:
    """Whether no number is NaN or infinite."""
    # A byte of it is 0 or 1; for the small arrays of a chunk `all` takes three times as long.
    return 0 not in np.isfinite(array).tobytes()


def check_actions(actions: np.ndarray, *, where: str = "actions") -> Float64[np.ndarray, "time 67"]:
    """Actions as float64 [T ≥ 1, 67]; raises ShapeError, or NonFiniteError with the place."""
    checked = np.asarray(actions, dtype=np.float64)
    if checked.ndim != 2 or checked.shape[1] != ACTION_DIM or len(checked) == 0:
        raise ShapeError(f"{where}: got shape {checked.shape}, expected [T ≥ 1, {ACTION_DIM}]")
    if not all_finite(checked):
        bad = np.argwhere(~np.isfinite(checked))
        row, column = bad[0]
        raise NonFiniteError(
            f"{where}: {len(bad)} values are NaN or infinite, first in row {row}, column {column}; "
            "expected finite numbers",
            row=int(row),
            column=int(column),
        )
    return checked


def pose_to_9d(T: np.ndarray) -> Float64[np.ndarray, "*batch 9"]:
    """Translation (m) and 6-D rotation of transforms [..., 4, 4]."""
    T = np.asarray(T, dtype=np.float64)
    return np.concatenate([T[..., :3, 3], rotation_to_6d(T[..., :3, :3])], axis=-1)


def pose_from_9d(pose: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """Transforms [..., 4, 4] of 9-D poses; degenerate rotations raise."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape[-1:] != (POSE_DIM,):
        raise ShapeError(f"9-D pose: got shape {pose.shape}, expected [..., {POSE_DIM}]")
    return transform(rotation_from_6d(pose[..., 3:]), pose[..., :3])


def relative_pose_9d(Ts_world_x: np.ndarray) -> Float64[np.ndarray, "time 9"]:
    """Poses [T, 4, 4] relative to the first: T_0⁻¹ T_t as 9-D; row 0 is exactly the identity."""
    Ts = np.asarray(Ts_world_x, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4) or len(Ts) == 0:
        raise ShapeError(f"poses: got shape {Ts.shape}, expected [T ≥ 1, 4, 4]")
    return _relative_9d(Ts[0], Ts)


def pack_action(
    *,
    wrist_left: np.ndarray,
    wrist_right: np.ndarray,
    joints_left_rad: np.ndarray,
    joints_right_rad: np.ndarray,
    camera_head: np.ndarray,
) -> Float64[np.ndarray, "*batch 67"]:
    """Actions [..., 67] from 9-D poses and 20 joint angles per hand."""
    parts = {
        "wrist_left": (wrist_left, POSE_DIM),
        "wrist_right": (wrist_right, POSE_DIM),
        "joints_left_rad": (joints_left_rad, 20),
        "joints_right_rad": (joints_right_rad, 20),
        "camera_head": (camera_head, POSE_DIM),
    }
    arrays = []
    for name, (part, size) in parts.items():
        array = np.asarray(part, dtype=np.float64)
        if array.shape[-1:] != (size,):
            raise ShapeError(f"{name}: got shape {array.shape}, expected [..., {size}]")
        arrays.append(array)
    return np.concatenate(arrays, axis=-1)


@dataclass(frozen=True)
class ActionParts:
    """The five blocks of actions [..., 67] (views)."""

    wrist_left: np.ndarray
    wrist_right: np.ndarray
    joints_left_rad: np.ndarray
    joints_right_rad: np.ndarray
    camera_head: np.ndarray


def unpack_action(actions: np.ndarray) -> ActionParts:
    """Split actions [..., 67] into their blocks; inverse of `pack_action`."""
    actions = np.asarray(actions)
    if actions.shape[-1:] != (ACTION_DIM,):
        raise ShapeError(f"actions: got shape {actions.shape}, expected [..., {ACTION_DIM}]")
    return ActionParts(*(actions[..., part] for part in PARTS))


def actions_from_poses(
    trajectory: HandTrajectory, anchor: AnchorPoses
) -> Float64[np.ndarray, "time 67"]:
    """Actions of absolute poses relative to the anchor's, whose own is exactly the identity.

    For measured actions the anchor is the trajectory's own first step; commanded actions are
    relative to the *measured* poses of the anchor step.
    """
    T_left, T_right, T_camera = anchor.as_tuple()
    return pack_action(
        wrist_left=_relative_9d(T_left, trajectory.Ts_world_wrist_left),
        wrist_right=_relative_9d(T_right, trajectory.Ts_world_wrist_right),
        joints_left_rad=trajectory.joints_left_rad,
        joints_right_rad=trajectory.joints_right_rad,
        camera_head=_relative_9d(T_camera, trajectory.Ts_world_camera_head),
    )


def _relative_9d(T_world_anchor: np.ndarray, Ts_world_x: np.ndarray) -> Float64[np.ndarray, "n 9"]:
    relative = pose_to_9d(invert(T_world_anchor) @ Ts_world_x)
    # Multiplication with the inverse leaves rounding errors of 1e-16 where nothing moved.
    relative[(Ts_world_x == T_world_anchor).all(axis=(1, 2))] = IDENTITY_POSE_9D
    return relative


def poses_from_actions(
    actions: np.ndarray, anchor: AnchorPoses, *, where: str = "actions", validated: bool = False
) -> HandTrajectory:
    """Absolute poses and joint angles of actions [T, 67]; inverse of `actions_from_poses`.

    Messages begin with `where`; `validated` actions come from `check_actions`.

    Raises:
        ShapeError, NonFiniteError: as `check_actions`.
        DegenerateRotationError: a 6-D rotation that is none.
    """
    checked = actions if validated else check_actions(actions, where=where)
    Ts_world_x = np.stack(anchor.as_tuple()) @ _poses(checked)
    return HandTrajectory(
        Ts_world_x[:, 0],
        Ts_world_x[:, 1],
        checked[:, JOINTS_LEFT].copy(),
        checked[:, JOINTS_RIGHT].copy(),
        Ts_world_x[:, 2],
    )


def _poses(actions: np.ndarray) -> Float64[np.ndarray, "time 3 4 4"]:
    return pose_from_9d(actions[:, _POSE_COLUMNS].reshape(-1, len(POSE_SLICES), POSE_DIM))


def reanchor(
    actions: np.ndarray, index: int, *, anchor_action: np.ndarray | None = None
) -> Float64[np.ndarray, "time 67"]:
    """Re-express actions [T, 67], all relative to one anchor, relative to the step at `index`.

    The poses of that step come out as exactly the identity. Commanded actions need `anchor_action`
    [67], the *measured* action of the step relative to the same anchor. Raises InvalidInputError
    for an index outside 0 … T-1.
    """
    checked = check_actions(actions)
    if not 0 <= index < len(checked):
        raise InvalidInputError(f"reanchor: got index {index}, expected 0 … {len(checked) - 1}")
    Ts_old_x = _poses(checked)
    Ts_old_new = (
        Ts_old_x[index] if anchor_action is None else _poses(check_actions(anchor_action[None]))[0]
    )
    new = pose_to_9d(invert(Ts_old_new) @ Ts_old_x)
    if anchor_action is None:
        new[index] = IDENTITY_POSE_9D
    moved = checked.copy()
    moved[:, _POSE_COLUMNS] = new.reshape(len(checked), -1)
    return moved
