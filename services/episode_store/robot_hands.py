"""Robot hands of an episode's actions as points in the world, for 3-D views."""

from typing import Any

import numpy as np

from dextouch.episodes import EpisodeReader
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import ACTION_DIM, poses_from_actions
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import ActionKind
from dextouch.streams import pack

STREAMS: dict[ActionKind, str] = {"measured": "action", "commanded": "action_commanded"}
MAX_STEPS = 10_000


class RobotHandsQuery(FrozenModel):
    """Query of robot hands: start_ns ≤ t < stop_ns, and which actions."""

    start_ns: int
    stop_ns: int
    action_kind: ActionKind = "measured"


def robot_hands(reader: EpisodeReader, query: RobotHandsQuery) -> bytes:
    """Both robot hands of the actions in a span, by forward kinematics, as msgpack.

    Arrays: `t_ns` [n]; for each side `SIDE_points_world_m` [n, 5, 4, 3], knuckle, PIP, DIP and tip
    from thumb to little finger; `T_world_wrist_left`, `T_world_wrist_right` and
    `T_world_camera_head` [n, 4, 4].

    Raises:
        UnknownNameError: the episode has no such actions.
        InvalidInputError: actions that are not of the robot hand.
        LimitExceededError: too many steps.
    """
    stream = STREAMS[query.action_kind]
    count = reader.count(stream, query.start_ns, query.stop_ns)
    if count > MAX_STEPS:
        raise LimitExceededError(
            f"{stream}: the span holds {count} steps, expected at most {MAX_STEPS}; "
            "ask for a shorter time",
            got=count,
            expected=MAX_STEPS,
        )
    about = reader.attributes
    if reader.streams[stream].shape != (ACTION_DIM,):
        raise InvalidInputError(
            f"{stream}: got values of shape {reader.streams[stream].shape}, "
            f"expected ({ACTION_DIM},)"
        )
    if (about.domain, about.origin) == ("human", "twin"):
        raise InvalidInputError(
            f"episode {about.episode_id!r}: the actions of a person in the twin hold the joint "
            "angles of the human hand, expected those of the robot hand; align its recording"
        )
    read = reader.read(stream, query.start_ns, query.stop_ns)
    return pack({"action_kind": query.action_kind}, _points(reader, read.t_ref_ns, read.values))


def _points(
    reader: EpisodeReader, t_ref_ns: np.ndarray, actions: np.ndarray
) -> dict[str, np.ndarray]:
    arrays: dict[str, Any] = {"t_ns": t_ref_ns}
    if not len(t_ref_ns):
        return arrays
    anchor = reader.attributes.anchor.to_poses()
    where = f"actions of episode {reader.item_id!r}"
    hands = poses_from_actions(actions, anchor, where=where)
    for side, Ts_world_wrist, joints_rad in (
        ("left", hands.Ts_world_wrist_left, hands.joints_left_rad),
        ("right", hands.Ts_world_wrist_right, hands.joints_right_rad),
    ):
        points_wrist = RobotHand(side).chain_points_m(joints_rad)
        R, t = Ts_world_wrist[:, None, None, :3, :3], Ts_world_wrist[:, None, None, :3, 3]
        arrays[f"{side}_points_world_m"] = (R @ points_wrist[..., None])[..., 0] + t
        arrays[f"T_world_wrist_{side}"] = Ts_world_wrist
    return arrays | {"T_world_camera_head": hands.Ts_world_camera_head}
