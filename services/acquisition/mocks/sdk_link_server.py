"""A simulated bridge: a local socket that says the same to every station."""

import contextlib
import itertools
import socket
import threading
from collections.abc import Callable

from services.acquisition.clock import StationClock
from services.acquisition.mocks.ports import SEND_TIMEOUT_S, SocketPort
from services.acquisition.mocks.sdk_link_sources import BridgeSource, sign_of_life

LIFE_PERIOD_NS = 50_000_000


class BridgePort(SocketPort):
    """A mock device's end of a bridge: a socket pair whose connections begin with the hello.

    While it is plugged it calls `show_life`, if that is set, as often as a bridge says that it
    lives. Without it a host on a real clock finds it silent while the device says nothing.
    """

    def __init__(self, name: str, hello: Callable[[], bytes]) -> None:
        super().__init__(name)
        self.show_life: Callable[[], None] | None = None
        self._hello = hello
        self._unplugged = threading.Event()
        self._life: threading.Thread | None = None

    def plug(self) -> None:
        """Accept connections, and show that the bridge lives."""
        super().plug()
        if self.show_life is not None:
            self._unplugged.clear()
            self._life = threading.Thread(
                target=self._live, args=(self.show_life,), name="bridge-life", daemon=True
            )
            self._life.start()

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        self._unplugged.set()
        if self._life is not None:
            self._life.join()
            self._life = None
        super().unplug()

    def _live(self, show_life: Callable[[], None]) -> None:
        while not self._unplugged.wait(LIFE_PERIOD_NS / 1e9):
            show_life()

    def _on_open(self) -> None:
        """Count the hello that waits in every new connection as sent."""
        self.link.add_sent(len(self._hello()))

    def _connect(self) -> socket.socket:
        host_end = super()._connect()
        if self._device_end is not None:
            self._device_end.sendall(self._hello())
        return host_end


class BridgeServer:
    """A bridge process's socket: says hello to every connection and sends all of them the same.

    Args:
        source: what is said.
        clock: paces the samples.
        port: to listen on; any free one if 0.
    """

    def __init__(self, source: BridgeSource, *, clock: StationClock, port: int = 0) -> None:
        self._source = source
        self._clock = clock
        self._lock = threading.Lock()
        self._connections: list[socket.socket] = []
        self._sequence = 0
        self._t_sent_ns = clock.now_ns()
        self._stopping = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self._threads = [
            threading.Thread(target=run, name=f"bridge-{name}", daemon=True)
            for name, run in (("accept", self._accept), ("life", self._show_life))
        ]

    def __enter__(self) -> "BridgeServer":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join()
        self.disconnect()

    def disconnect(self) -> None:
        """Close all connections, as a process does that ends."""
        with self._lock:
            for connection in self._connections:
                connection.close()
            self._connections.clear()

    def send_sample(self, index: int, t_device_ns: int) -> None:
        """Send one sample to every connection."""
        with self._lock:
            for unit in self._source.units(index, self._sequence, t_device_ns):
                self._send(unit)

    def play(self) -> None:
        """Send the whole source in its own time, round and round until the server ends."""
        waiter = self._clock.waiter(drives_time=True)
        t_ns = self._source.t_ns
        round_ns = int(t_ns[-1] + t_ns[-1] // max(1, len(t_ns) - 1))
        start_ns = self._clock.now_ns()
        for number in itertools.count():
            for index, sample_ns in enumerate(t_ns):
                due_ns = start_ns + number * round_ns + int(sample_ns)
                waiter.wait_until(due_ns)
                if self._stopping.is_set():
                    return
                self.send_sample(index, due_ns)

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:  # stopped
                return
            connection.settimeout(SEND_TIMEOUT_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock, contextlib.suppress(OSError):
                connection.sendall(self._source.hello())
                self._connections.append(connection)

    def _show_life(self) -> None:
        while not self._stopping.wait(LIFE_PERIOD_NS / 1e9):
            now_ns = self._clock.now_ns()
            with self._lock:
                if now_ns - self._t_sent_ns >= LIFE_PERIOD_NS:
                    self._send(sign_of_life(self._source.magic, self._sequence, now_ns))

    def _send(self, unit: bytes) -> None:
        self._sequence += 1
        self._t_sent_ns = self._clock.now_ns()
        for connection in list(self._connections):
            try:
                connection.sendall(unit)
            except OSError:  # the station has gone
                connection.close()
                self._connections.remove(connection)
