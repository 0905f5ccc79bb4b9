"""Joint angles of any robot hand, loaded from its model file, that follow an aligned human hand."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from dextouch.episodes import EpisodeReader, disk_errors
from dextouch.errors import NotFoundError
from dextouch.hands.robot_hand import HandModel
from services.alignment.retargeting.hand_profile import calibrated_profile

NS_PER_S = 1e9
SOLVED = 0


@dataclass(frozen=True)
class HandMotion:
    """Joint angles of one robot hand over the time of an episode.

    Attributes:
        side: left or right.
        joint_names: in the order of the hand's mapping file.
        t_ref_ns: times on the episode's clock, at the rate at which the hand was tracked.
        joints_rad: angles, always inside the joints' limits.
        status: `RetargetStatus` of every sample; 0 where all fingers were solved.
        tip_error_m: distance of each fingertip from its measured place; 0 where it was not solved.
    """

    side: str
    joint_names: tuple[str, ...]
    t_ref_ns: Int64[np.ndarray, " time"]
    joints_rad: Float64[np.ndarray, "time joints"]
    status: UInt8[np.ndarray, " time"]
    tip_error_m: Float64[np.ndarray, "time fingers"]

    @property
    def share_solved(self) -> float:
        """Share of the samples in which every finger was solved."""
        return float(np.mean(self.status == SOLVED))

    def save(self, path: Path) -> None:
        """Write all arrays to an NPZ file.

        Raises:
            StorageError: it cannot be written.
        """
        with disk_errors(f"write {path}"), path.open("wb") as file:
            np.savez(
                file,
                joint_names=np.array(self.joint_names),
                t_ref_ns=self.t_ref_ns,
                joints_rad=self.joints_rad,
                status=self.status,
                tip_error_m=self.tip_error_m,
            )


def retarget_other_hand(episode: EpisodeReader, hand: HandModel) -> HandMotion:
    """Retarget the tracked hand of an episode to a robot hand of the same side.

    Raises:
        NotFoundError: the episode has no keypoints of this side.
        InvalidInputError: a finger of the robot was tracked in no sample.
    """
    # Loaded here, since compiling the solver takes time that other commands need not spend.
    from services.alignment.retargeting.hand_retargeter import HandRetargeter

    name = f"keypoints_{hand.side}"
    if name not in episode.streams:
        raise NotFoundError(
            f"episode {episode.attributes.episode_id!r}: has no {name!r}, only "
            f"{', '.join(sorted(episode.streams))}; expected an episode of a person"
        )
    stream = episode.read(name)
    retargeter = HandRetargeter(hand, calibrated_profile(episode.attributes.calibration, hand.side))
    t_s = (stream.t_ref_ns - stream.t_ref_ns[0]).astype(np.float64) / NS_PER_S
    result = retargeter.retarget(stream.values, t_s=t_s)
    return HandMotion(
        hand.side,
        tuple(hand.joint_names),
        stream.t_ref_ns,
        result.joints_rad,
        result.status,
        result.tip_error_m,
    )
