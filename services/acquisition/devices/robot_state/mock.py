"""A simulated robot that sends its state."""

from collections.abc import Mapping

import numpy as np

from dextouch.errors import InvalidInputError
from services.acquisition.devices.robot_state.driver import MAGIC, STREAM_SIZES
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.mocks.replay import PacketSource, ReplayStream


class RobotStateSource(PacketSource):
    """Packets of one robot.

    Args:
        streams: the six of `STREAM_SIZES`, all with the same times.

    Raises:
        InvalidInputError: one is missing, or their times differ.
    """

    def __init__(self, streams: Mapping[str, ReplayStream]) -> None:
        missing = sorted(set(STREAM_SIZES) - set(streams))
        if missing:
            raise InvalidInputError(f"robot state: streams {missing} are missing")
        parts = [streams[name] for name in STREAM_SIZES]
        if any(not np.array_equal(part.t_ns, parts[0].t_ns) for part in parts):
            raise InvalidInputError("robot state: the six streams have different times")
        self.t_ns = parts[0].t_ns
        self._numbers = np.concatenate([part.values for part in parts], axis=1).astype("<f8")

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        payload = self._numbers[index].tobytes()
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, payload)
        return [encode_packet(MAGIC, packet)]
