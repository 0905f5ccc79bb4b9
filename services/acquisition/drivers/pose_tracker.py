"""Pose tracker over HID: one report a pose comes in, poses of a running tracker go out."""

import struct
from enum import IntEnum

import numpy as np

from dextouch.streams.descriptors import ClockCapabilities, StreamDescriptor
from dextouch.streams.samples import Sample
from services.acquisition.drivers.base import Readings, check_packet
from services.acquisition.drivers.packets import SOURCES, DecoderStatistics, PacketDecoder
from services.acquisition.drivers.reports import ReportReassembler

MAGIC = b"DXPT"
# running state, three bytes of padding, x y z (m), qw qx qy qz
PAYLOAD = struct.Struct("<B3x7f")
NOMINAL_RATE_HZ = 100.0
NORM_TOLERANCE = 1e-3


class TrackingState(IntEnum):
    """What the tracker says about its own pose; only RUNNING_OK is a measurement."""

    UNINITIALIZED = 0
    CALIBRATING = 1
    OUT_OF_RANGE = 2
    FALLBACK_ROTATION_ONLY = 3
    RUNNING_OK = 200


def pose_descriptor(stream: str) -> StreamDescriptor:
    """The stream `wrist_left`, `wrist_right` or `head`."""
    side = {"wrist_left": "left", "wrist_right": "right"}.get(stream)
    return StreamDescriptor.model_validate(
        {
            "name": stream,
            "kind": "pose",
            "shape": (7,),
            "dtype": "float64",
            "unit": "pose_m_wxyz",
            "nominal_rate_hz": NOMINAL_RATE_HZ,
            "frame": "world",
            "side": side,
            "device": f"pose_tracker_{stream}",
            "capabilities": ClockCapabilities(crc=True, sequence=True, device_time=True),
        }
    )


class PoseTrackerDecoder:
    """Poses [x y z qw qx qy qz] in the world frame, only while the tracker runs.

    What a tracker sends in another state (some go on with a drifting pose and a "valid" flag) is
    counted in `not_running` and not passed on: a gap, never a wrong pose.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._device = f"pose_tracker_{stream}"
        self._source = stream.removeprefix("wrist_") if stream != "head" else "head"
        if self._source not in SOURCES:
            self._source = "none"
        self.reports = ReportReassembler()
        self._packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        self.not_running = 0

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far; `refused` counts poses that are no poses."""
        return self._packets.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The pose stream."""
        return (pose_descriptor(self._stream),)

    def reset(self) -> None:
        """Forget half a message."""
        self.reports.reset()
        self._packets.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Poses (float64 [7], unit quaternion) completed by one report.

        Raises:
            DeviceError: another version, or a tracker that sits elsewhere.
        """
        message = self.reports.feed(data)
        if message is None:
            return {}
        samples = []
        for packet in self._packets.feed(message[1]):
            check_packet(packet, device=self._device, source=self._source)
            state, *numbers = PAYLOAD.unpack(packet.payload)
            pose = np.array(numbers)
            norm = float(np.linalg.norm(pose[3:]))
            if state != TrackingState.RUNNING_OK:
                self.not_running += 1
            elif not np.all(np.isfinite(pose)) or abs(norm - 1.0) > NORM_TOLERANCE:
                self.statistics.refused += 1
            else:
                pose[3:] /= norm
                samples.append(Sample(t_host_ns, pose, packet.t_device_ns, packet.sequence))
        return {self._stream: samples} if samples else {}
