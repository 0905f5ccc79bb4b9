"""Simulated devices that send real packets, and the building blocks for mocks of other devices."""

from services.acquisition.mocks.faults import (
    DeviceFaults,
    FaultScript,
    PacketEdits,
    PacketFields,
    Pinned,
)
from services.acquisition.mocks.ports import HidPort, MockPort, PtyPort, SocketPort
from services.acquisition.mocks.replay import (
    MockDevice,
    MockPair,
    MockSlot,
    PacketSource,
    ReplayStream,
    at_rate,
    serial_mock,
)

__all__ = [
    "DeviceFaults",
    "FaultScript",
    "HidPort",
    "MockDevice",
    "MockPair",
    "MockPort",
    "MockSlot",
    "PacketEdits",
    "PacketFields",
    "PacketSource",
    "Pinned",
    "PtyPort",
    "ReplayStream",
    "SocketPort",
    "at_rate",
    "serial_mock",
]
