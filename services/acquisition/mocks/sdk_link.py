"""Simulated SDK processes behind a bridge: local sockets that say the same to every station."""

import contextlib
import socket
import threading

from services.acquisition.clock import PeriodicCall, StationClock, VirtualClock
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.sdk_link import (
    PROTOCOL,
    PROTOCOL_VERSION,
    BridgeDecoder,
    BridgeDriver,
    BridgeHello,
    FrameConvention,
)
from services.acquisition.mocks.ports import SEND_TIMEOUT_S, MockPort, SocketPort
from services.acquisition.mocks.replay import MockDevice, MockPair, MockPlace, PacketSource

# A left-handed sender in centimetres, and OpenVR's own frame: y up, looking along −z.
LEFT_HANDED = FrameConvention(handedness="left", axes=("+x", "+y", "-z"))
Y_UP = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
SOFTWARE = "dextouch mock bridge 1"
LIFE_PERIOD_NS = 50_000_000


class BridgeSource(PacketSource):
    """What one bridge process says.

    Attributes:
        magic: of its packets.
        hello: the first line of a connection.
    """

    magic: bytes
    hello: bytes


def mock_hello(**says: object) -> bytes:
    """First line of a mock bridge's connections: `BridgeHello` without protocol and software."""
    made = {"protocol": PROTOCOL, "version": PROTOCOL_VERSION, "software": SOFTWARE, **says}
    hello = BridgeHello.model_validate(made)
    return hello.model_dump_json(exclude_none=True).encode() + b"\n"


def sign_of_life(magic: bytes, sequence: int, t_device_ns: int) -> bytes:
    """A packet without a payload."""
    packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, b"")
    return encode_packet(magic, packet)


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


def signs_of_life(device: MockDevice, magic: bytes, clock: StationClock) -> PeriodicCall:
    """A thread that shows the bridge of a device to live while the device says nothing."""

    def show_life() -> None:
        device.send_aside(lambda sequence: sign_of_life(magic, sequence, 0))

    return PeriodicCall(show_life, period_ns=LIFE_PERIOD_NS, clock=clock, name="bridge-life")


def bridged_pair(place: MockPlace, source: BridgeSource, decoder: BridgeDecoder) -> MockPair:
    """A simulated device behind a bridge, and the driver that asks the bridge for it."""
    port, clock = BridgePort(place.name, source.hello), place.clock
    device = MockDevice(place, source, port)
    # With a virtual clock, time stands while nothing is sent.
    if not isinstance(clock, VirtualClock):
        port.life = signs_of_life(device, source.magic, clock)
    driver = BridgeDriver(place.name, transport=port.transport, decoder=decoder, clock=clock)
    return MockPair(device, driver)


class BridgeServer(MockPort):
    """A bridge process's socket: says hello to every connection and sends all of them the same.

    Args:
        hello: the first line of a connection.
        port: to listen on; any free one if 0.
    """

    def __init__(self, hello: bytes, *, port: int = 0) -> None:
        super().__init__()
        self._hello = hello
        self._lock = threading.Lock()
        self._connections: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self._accepting = threading.Thread(target=self._accept, name="bridge-accept", daemon=True)

    def plug(self) -> None:
        """Accept connections."""
        # It sends to whoever hears it, and to nobody.
        self.link.set_open(is_open=True)
        self._accepting.start()

    def unplug(self) -> None:
        """End, as a process does: for good."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._accepting.join()
        self.disconnect()

    def disconnect(self) -> None:
        """Close all connections."""
        with self._lock:
            for connection in self._connections:
                connection.close()
            self._connections.clear()

    def send(self, unit: bytes) -> bool:
        """Send to every connection."""
        with self._lock:
            for connection in list(self._connections):
                try:
                    connection.sendall(unit)
                except OSError:  # the station has gone
                    connection.close()
                    self._connections.remove(connection)
        return True

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:  # stopped
                return
            connection.settimeout(SEND_TIMEOUT_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock, contextlib.suppress(OSError):
                connection.sendall(self._hello)
                self._connections.append(connection)
