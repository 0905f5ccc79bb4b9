"""What simulated SDK processes behind a bridge have in common."""

from typing import Protocol, runtime_checkable

from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.sdk_link import (
    BridgeHello,
    FrameConvention,
)
from services.acquisition.mocks.replay import PacketSource

# A left-handed sender in centimetres, and OpenVR's own frame: y up, looking along −z.
LEFT_HANDED = FrameConvention(handedness="left", axes=("+x", "+y", "-z"))
Y_UP = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
SOFTWARE = "dextouch mock bridge 1"


@runtime_checkable
class BridgeSource(PacketSource, Protocol):
    """What one bridge process says."""

    magic: bytes

    def hello(self) -> bytes:
        """The first line of a connection."""
        ...


def sign_of_life(magic: bytes, sequence: int, t_device_ns: int) -> bytes:
    """A packet without a payload."""
    packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, b"")
    return encode_packet(magic, packet)


def hello_line(hello: BridgeHello) -> bytes:
    """A hello as it is sent."""
    return hello.model_dump_json(exclude_none=True).encode() + b"\n"
