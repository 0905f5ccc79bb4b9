"""Poses of one tracked body come in; a pose tracker's HID reports, one a pose, go out."""

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.pose_tracker import MAGIC, PAYLOAD, TrackingState
from services.acquisition.drivers.reports import DATA_REPORT, split_into_reports
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.replay import ReplayStream


class PoseTrackerSource:
    """Reports of one pose tracker.

    Args:
        stream: float64 [n, 7], x y z (m) qw qx qy qz in the world frame.
        faults: position and rotation noise, per axis.
        rng: of the noise.
    """

    def __init__(
        self, stream: ReplayStream, *, faults: DeviceFaults, rng: np.random.Generator
    ) -> None:
        self._stream = stream
        self._source = SOURCES[stream.descriptor.name.removeprefix("wrist_")]
        self._poses = add_pose_noise(stream.values, faults, rng)

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet in one report."""
        payload = PAYLOAD.pack(TrackingState.RUNNING_OK, *self._poses[index])
        packet = Packet(VERSION, self._source, sequence, t_device_ns, payload)
        return split_into_reports(DATA_REPORT, sequence, encode_packet(MAGIC, packet))


def add_pose_noise(
    poses: np.ndarray, faults: DeviceFaults, rng: np.random.Generator
) -> Float64[np.ndarray, "n 7"]:
    """Poses with Gaussian noise on each axis of position and of the tracked body's rotation."""
    noisy = np.array(poses, dtype=np.float64)
    noisy[:, :3] += faults.position_noise_m * rng.standard_normal((len(noisy), 3))
    turns_rad = faults.rotation_noise_rad * rng.standard_normal((len(noisy), 3))
    R = rotation_from_quaternion(noisy[:, 3:]) @ rotation_from_vector(turns_rad)
    noisy[:, 3:] = quaternion_from_rotation(R)
    return noisy
