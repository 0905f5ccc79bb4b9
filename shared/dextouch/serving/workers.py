"""Server processes: one that drains before it stops, or several workers that share one port."""

import asyncio
import gc
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from types import FrameType
from typing import Any

import structlog
import uvicorn
from fastapi import FastAPI
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors import Multiprocess

from dextouch.errors import DexTouchError, UnavailableError

logger = structlog.get_logger(__name__)

IsWorking = Callable[[], bool]
Renewed = Callable[[], Callable[[], FastAPI] | None]


class ServiceManager:
    """The service manager that started this process, by sd_notify(3); without one it is silent."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # A leading @ stands for the abstract namespace.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._watchdog_s = int(environment.get("WATCHDOG_USEC", "0")) / 1e6 if is_ours else 0.0

    def send(self, message: str) -> None:
        """Send a message; a manager that cannot be reached is no reason to stop."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            try:
                sender.sendto(message.encode(), self._address)
            except OSError as error:
                logger.warning("service_manager_not_reached", error=str(error))

    async def feed_watchdog(self, is_working: IsWorking | None) -> None:
        """Feed the watchdog twice a period, as long as the event loop runs and work goes on.

        `is_working` is called in a thread; where it is False or does not return, the manager
        restarts the service.
        """
        if not self._address or not self._watchdog_s:
            return
        while True:
            if is_working is None or await asyncio.to_thread(is_working):
                self.send("WATCHDOG=1")
            else:
                logger.error("service_stalled", watchdog_s=self._watchdog_s)
            await asyncio.sleep(self._watchdog_s / 2)


# A worker that takes longer to start, or does not respond for as long, is replaced.
WORKER_TIMEOUT_S = 60


class DrainingServer(uvicorn.Server):
    """Server that refuses new work for a while after SIGTERM before it closes its port.

    Load balancers see in that time that it is not ready. A second signal ends it. `drain` is called
    at SIGTERM, in the event loop's thread; the server shuts down `drain_s` later, and requests that
    run then still end. `is_working` is for the watchdog of systemd.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        *,
        drain: Callable[[], object] | None,
        drain_s: float,
        is_working: IsWorking | None = None,
    ) -> None:
        super().__init__(config)
        self._manager = ServiceManager()
        self._is_working = is_working
        self._watchdog: asyncio.Task[None] | None = None
        self._drain = drain
        self._drain_s = drain_s
        self._stop_at_s: float | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and report to systemd once the port is open."""
        await super().startup(sockets)
        if self.started:
            self._manager.send("READY=1")
            feeding = self._manager.feed_watchdog(self._is_working)
            self._watchdog = asyncio.create_task(feeding)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop, while the watchdog still watches."""
        self._manager.send("STOPPING=1")
        await super().shutdown(sockets)
        if self._watchdog is not None:
            self._watchdog.cancel()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to drain, or to shut down."""
        if sig != signal.SIGTERM or self._stop_at_s is not None or self._drain is None:
            super().handle_exit(sig, frame)
            return
        self._drain()
        self._stop_at_s = time.monotonic() + self._drain_s

    async def on_tick(self, counter: int) -> bool:
        """Shut down once the drain is over."""
        drained = self._stop_at_s is not None and time.monotonic() >= self._stop_at_s
        if drained and not self.should_exit:
            super().handle_exit(signal.SIGTERM, None)
        return await super().on_tick(counter)


class _Supervisor(Multiprocess):
    """uvicorn's supervisor, which notices at once if a worker dies while it is asked to respond."""

    renewed: Renewed | None = None

    def restart_all(self) -> None:
        if self.renewed is not None:
            create_app = self.renewed()
            if create_app is None:
                return
            # Also that of workers which take the places of dead ones later.
            self.config.app = partial(_in_worker, create_app)
        super().restart_all()

    def keep_subprocess_alive(self) -> None:
        for worker in self.processes:
            # While this process holds the worker's end of their pipe too, it never reads its end.
            worker.child_conn.close()
        super().keep_subprocess_alive()


def run_workers(
    create_app: Callable[[], FastAPI],
    *,
    host: str,
    port: int,
    num_workers: int,
    options: dict[str, Any],
    renewed: Renewed | None = None,
) -> None:
    """Serve with several processes until SIGINT or SIGTERM.

    uvicorn replaces workers that end or hang; on SIGHUP it replaces all, one after another, each
    once its successor serves. `create_app` is pickled, and called in every worker; at SIGHUP
    `renewed` gives that of the successors, or None to replace none. Raises UnavailableError if a
    worker could not start.
    """
    config = uvicorn.Config(
        partial(_in_worker, create_app),
        factory=True,
        host=host,
        port=port,
        workers=num_workers,
        timeout_worker_healthcheck=WORKER_TIMEOUT_S,
        **options,
    )
    with config.bind_socket() as listener:
        # Connections inherit it; without it responses wait for up to 40 ms.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        supervisor = _Supervisor(config, sockets=[listener])
        supervisor.renewed = renewed
        supervisor.run()
    if any(worker.exitcode == STARTUP_FAILURE for worker in supervisor.processes):
        raise UnavailableError("a worker could not start; the log above says why")


def _in_worker(create_app: Callable[[], FastAPI]) -> FastAPI:
    try:
        app = create_app()
    except DexTouchError as error:
        logger.error("worker_failed", error=error.message)  # noqa: TRY400 - the message says it all
        # With this status the supervisor ends, rather than start the worker again and again.
        sys.exit(STARTUP_FAILURE)
    gc.collect()
    gc.freeze()
    return app
