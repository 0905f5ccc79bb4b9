"""Driver of one device behind a bridge, the process that holds a closed SDK."""

from typing import Protocol

from dextouch.errors import DeviceError, StaleDataError
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Decoder, Driver, Readings
from services.acquisition.drivers.bridge_protocol import BridgeConnection
from services.acquisition.transports.base import Transport

HELLO_READS = 20
SILENCE_NS = 200_000_000


class BridgeDecoder(Decoder, Protocol):
    """A decoder of the packets of one device behind a bridge."""

    @property
    def connection(self) -> BridgeConnection:
        """The bridge's hello."""
        ...


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
