"""Joint angles of any robot hand, loaded from its model file, that follow an aligned human hand."""

from pathlib import Path

import numpy as np
from jaxtyping import Int64

from dextouch.episodes import EpisodeReader, disk_errors
from dextouch.errors import NotFoundError
from dextouch.hands.robot_hand import HandModel
from services.alignment.retargeting import HandRetargeter, RetargetResult
from services.alignment.retargeting.hand_profile import calibrated_profile

NS_PER_S = 1e9


def retarget_other_hand(
    episode: EpisodeReader, hand: HandModel
) -> tuple[Int64[np.ndarray, " time"], RetargetResult]:
    """Retarget the tracked hand of an episode to a robot hand of the same side.

    Returns:
        Times on the episode's clock, at the rate at which the hand was tracked, and joint angles.

    Raises:
        NotFoundError: the episode has no keypoints of this side.
        InvalidInputError: a finger of the robot was tracked in no sample.
    """
    name = f"keypoints_{hand.side}"
    if name not in episode.streams:
        raise NotFoundError(
            f"episode {episode.attributes.episode_id!r}: has no {name!r}, only "
            f"{', '.join(sorted(episode.streams))}; expected an episode of a person"
        )
    stream = episode.read(name)
    retargeter = HandRetargeter(hand, calibrated_profile(episode.attributes.calibration, hand.side))
    t_s = (stream.t_ref_ns - stream.t_ref_ns[0]).astype(np.float64) / NS_PER_S
    return stream.t_ref_ns, retargeter.retarget(stream.values, t_s=t_s)


def save_motion(path: Path, hand: HandModel, t_ref_ns: np.ndarray, motion: RetargetResult) -> None:
    """Write the motion of a robot hand to an NPZ file.

    Raises:
        StorageError: it cannot be written.
    """
    with disk_errors(f"write {path}"), path.open("wb") as file:
        np.savez(
            file,
            joint_names=np.array(hand.joint_names),
            t_ref_ns=t_ref_ns,
            joints_rad=motion.joints_rad,
            status=motion.status,
            tip_error_m=motion.tip_error_m,
        )
