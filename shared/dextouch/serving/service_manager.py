"""Messages of a service to systemd: ready, stopping, and a watchdog that only a working one feeds.

The protocol is sd_notify(3): datagrams to the socket that NOTIFY_SOCKET names.
"""

import asyncio
import os
import socket
from collections.abc import Callable, Mapping

import structlog

logger = structlog.get_logger(__name__)

IsWorking = Callable[[], bool]


class ServiceManager:
    """The service manager that started this process; without one nothing is sent.

    Args:
        environment: of the process, by default.
    """

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

        Args:
            is_working: called in a thread; where it is False or does not return, the manager
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
