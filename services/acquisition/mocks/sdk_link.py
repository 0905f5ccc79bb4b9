"""Simulated SDK processes behind a bridge, on a socket pair with the driver of the station."""

import socket
from abc import abstractmethod
from functools import partial

from services.acquisition.clock import PeriodicCall, VirtualClock
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.sdk_link import (
    PROTOCOL,
    PROTOCOL_VERSION,
    BridgeDecoder,
    BridgeDriver,
    BridgeHello,
    FrameConvention,
)
from services.acquisition.mocks.ports import SocketPort
from services.acquisition.mocks.replay import MockDevice, MockPair, MockSlot, PacketSource

# A left-handed sender in centimetres, and OpenVR's own frame: y up, looking along −z.
LEFT_HANDED = FrameConvention(handedness="left", axes=("+x", "+y", "-z"))
Y_UP = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
SOFTWARE = "dextouch mock bridge 1"
LIFE_PERIOD_NS = 50_000_000


class BridgeSource(PacketSource):
    """What one bridge process says.

    Attributes:
        magic: of its packets.
        frame: its coordinates.
    """

    magic: bytes
    frame: FrameConvention

    @property
    @abstractmethod
    def hello(self) -> bytes:
        """The first line of a connection."""


def mock_hello(**says: object) -> bytes:
    """First line of a mock bridge's connections: `BridgeHello` without protocol and software."""
    made = {"protocol": PROTOCOL, "version": PROTOCOL_VERSION, "software": SOFTWARE, **says}
    hello = BridgeHello.model_validate(made)
    return hello.model_dump_json(exclude_none=True).encode() + b"\n"


class BridgePort(SocketPort):
    """A mock device's end of a bridge: a socket pair whose connections begin with the hello.

    While it is plugged, `life` says as often as a bridge that it lives. Without it a host on a real
    clock finds it silent while the device says nothing.
    """

    def __init__(self, name: str, hello: bytes) -> None:
        # The hello that waits in every new connection counts as sent.
        super().__init__(name, on_open=lambda: self.link.add_sent(len(self.hello)))
        self.life: PeriodicCall | None = None
        self.hello = hello

    def plug(self) -> None:
        """Accept connections, and show that the bridge lives."""
        super().plug()
        if self.life is not None:
            self.life.start()

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        if self.life is not None:
            self.life.stop()
        super().unplug()

    def _connect(self) -> socket.socket:
        host_end = super()._connect()
        if self._device_end is not None:
            self._device_end.sendall(self.hello)
        return host_end


def bridged_pair(place: MockSlot, source: BridgeSource, decoder: BridgeDecoder) -> MockPair:
    """A simulated device behind a bridge, and the driver that asks the bridge for it."""
    port, clock = BridgePort(place.name, source.hello), place.clock
    device = MockDevice(place, source, port)

    def sign_of_life(sequence: int) -> bytes:
        return encode_packet(source.magic, Packet(VERSION, SOURCES["none"], sequence, 0, b""))

    # With a virtual clock, time stands while nothing is sent.
    if not isinstance(clock, VirtualClock):
        port.life = PeriodicCall(
            partial(device.send_aside, sign_of_life),
            period_ns=LIFE_PERIOD_NS,
            clock=clock,
            name="bridge-life",
        )
    driver = BridgeDriver(place.name, transport=port.transport, decoder=decoder, clock=clock)
    return MockPair(device, driver)
