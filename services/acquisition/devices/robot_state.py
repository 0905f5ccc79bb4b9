"""State packets of a robot: the decoder of their joints and wrist poses, and their streams."""

import struct
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from pydantic import Field

from dextouch.errors import InvalidInputError
from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind, TcpSettings
from services.acquisition.drivers.base import Decoder, Driver, Readings, check_packet
from services.acquisition.drivers.packets import PacketDecoder
from services.acquisition.transports import tcp_transport

MAGIC = b"DXRS"
NUM_JOINTS = 40
NOMINAL_RATE_HZ = 100.0
DEVICE = "robot_state"
# In the order of the packet: all float64.
RobotStream = Literal[
    "joints_measured",
    "joints_commanded",
    "wrist_left",
    "wrist_right",
    "wrist_left_commanded",
    "wrist_right_commanded",
]
STREAM_SIZES: dict[str, int] = {
    name: NUM_JOINTS if name.startswith("joints") else 7 for name in get_args(RobotStream)
}
PAYLOAD = struct.Struct(f"<{sum(STREAM_SIZES.values())}d")
_NUMBER = np.dtype("<f8")


def robot_descriptor(stream: str) -> StreamDescriptor:
    """One of the six streams: joints in rad (left 20, then right 20), poses in the world frame."""
    is_pose = stream.startswith("wrist")
    side: Side = "left" if "left" in stream else "right"
    return StreamDescriptor(
        name=stream,
        kind="pose" if is_pose else "robot_state",
        shape=(STREAM_SIZES[stream],),
        dtype="float64",
        unit="pose_m_wxyz" if is_pose else "rad",
        nominal_rate_hz=NOMINAL_RATE_HZ,
        frame="world" if is_pose else None,
        side=side if is_pose else None,
        device=DEVICE,
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


class RobotStateDecoder(Decoder):
    """One packet gives one sample of each stream, all with the same stamps.

    `streams` are those that are wanted; the packets hold all six of `STREAM_SIZES`.

    Raises:
        InvalidInputError: no stream, or an unknown or repeated one.
    """

    def __init__(self, streams: Sequence[str] = tuple(STREAM_SIZES)) -> None:
        if not streams or len(set(streams)) < len(streams) or set(streams) - set(STREAM_SIZES):
            raise InvalidInputError(
                f"robot state: got streams {list(streams)}, expected some of {list(STREAM_SIZES)}, "
                "each once"
            )
        self._packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        # `refused` counts states that are not finite.
        self.statistics = self._packets.statistics
        self.descriptors = tuple(robot_descriptor(stream) for stream in streams)
        self._wanted = frozenset(streams)

    def reset(self) -> None:
        """Forget half a packet."""
        self._packets.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Samples of the wanted streams completed by `data`.

        Raises:
            DeviceError: another packet version.
        """
        readings: Readings = {}
        for packet in self._packets.feed(data):
            check_packet(packet, device=DEVICE, source=None)
            numbers = np.frombuffer(packet.payload, _NUMBER)
            if np.count_nonzero(np.isfinite(numbers)) < numbers.size:
                self.statistics.refused += 1
                continue
            start = 0
            for stream, size in STREAM_SIZES.items():
                if stream in self._wanted:
                    values = numbers[start : start + size]
                    sample = Sample(t_host_ns, values, packet.t_device_ns, packet.sequence)
                    readings.setdefault(stream, []).append(sample)
                start += size
        return readings


class RobotStateSettings(TcpSettings):
    """A robot's state server at a TCP address.

    `streams` names those of its six streams that are recorded: a station whose trackers give the
    wrists leaves `wrist_left` and `wrist_right` out.
    """

    kind: Literal["robot_state"] = "robot_state"
    streams: tuple[RobotStream, ...] = Field(default=get_args(RobotStream), min_length=1)


def build(settings: RobotStateSettings, clock: StationClock) -> Driver:
    """The driver of one robot."""
    decoder = RobotStateDecoder(settings.streams)
    return Driver(
        "robot_state",
        transport=tcp_transport(settings.host, settings.port),
        decoder=decoder,
        clock=clock,
    )


KIND = DeviceKind(name="robot_state", settings=RobotStateSettings, build=build)
