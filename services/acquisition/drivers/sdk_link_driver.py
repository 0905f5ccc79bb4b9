"""Driver of one device behind a bridge, the process that holds a closed SDK."""

from abc import abstractmethod

from dextouch.errors import DeviceError, StaleDataError
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, Readings, StreamDecoder
from services.acquisition.drivers.packets import Packet
from services.acquisition.drivers.sdk_link_protocol import (
    BridgeConnection,
    BridgeHello,
    FreshnessGate,
)
from services.acquisition.transports.base import Transport

HELLO_READS = 20
SILENCE_NS = 200_000_000


class BridgeDecoder(StreamDecoder[Packet]):
    """Base of the decoders of one device behind a bridge.

    Args:
        descriptor: of the stream.
        connection: the bridge's hello and packets; `statistics` are of all devices of the bridge.
    """

    def __init__(self, descriptor: StreamDescriptor, connection: BridgeConnection) -> None:
        super().__init__(descriptor, connection)
        connection.on_hello = self._learn
        self.connection = connection
        self.freshness = FreshnessGate()

    def reset(self) -> None:
        """The connection was lost."""
        super().reset()
        self.freshness.reset()

    @abstractmethod
    def _learn(self, hello: BridgeHello) -> None:
        """Take in what a new connection's hello says of the sender."""


class BridgeDriver(Driver):
    """A device behind a bridge: waits for the hello, and takes silence for loss.

    A bridge shows at least every 50 ms that it lives. A bridge that sends nothing for 200 ms has
    stopped or is disconnected, which the socket alone would not indicate for minutes.
    """

    def __init__(
        self, name: str, *, transport: Transport, decoder: BridgeDecoder, clock: StationClock
    ) -> None:
        super().__init__(name, transport=transport, decoder=decoder, clock=clock)
        self._connection = decoder.connection
        self._t_heard_ns = 0
        self._first: Readings = {}

    def open(self) -> None:
        """Connect and learn who is there.

        Raises:
            DeviceError: no connection, no hello within 2 s, or another device than requested.
        """
        super().open()
        self._t_heard_ns = self._clock.now_ns()
        for _ in range(HELLO_READS):
            self._first = super().read()
            if self._connection.hello is not None:
                self._t_heard_ns = self._clock.now_ns()
                return
        raise DeviceError(
            f"{self.name}: {self.info} sends no hello; is this the address of a bridge?",
            device=self.name,
            event="wrong_hello",
        )

    def read(self) -> Readings:
        """New samples; empty when nothing came.

        Raises:
            StaleDataError: the bridge has sent nothing for 200 ms.
            DeviceError: the bridge is disconnected or uses another protocol.
        """
        if self._first:
            first, self._first = self._first, {}
            return first
        data = self.transport.read()
        t_host_ns = self._clock.now_ns()
        if data:
            self._t_heard_ns = t_host_ns
            return self.decoder.decode(data, t_host_ns)
        silence_ns = t_host_ns - self._t_heard_ns
        if silence_ns > SILENCE_NS:
            raise StaleDataError(
                f"{self.name}: {self.info} has sent nothing for {silence_ns / 1e6:.0f} ms, "
                "expected a heartbeat every 50 ms; is the SDK process still running?",
                device=self.name,
                event="silent_bridge",
            )
        return {}
