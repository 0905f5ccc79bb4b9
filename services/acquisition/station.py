"""A running station: supervisors of its devices, recorder, health and live views."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from dextouch.errors import DeviceError
from dextouch.schemas import Matrix
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.health import HealthMonitor
from services.acquisition.live import LiveView
from services.acquisition.path_latency import PathWatch
from services.acquisition.recorder import Recorder
from services.acquisition.supervisor import DeviceSupervisor, SpoolSafety
from services.acquisition.take import DeviceEvents, TakeOptions

CONNECT_TIMEOUT_S = 10.0


class Station:
    """Everything that runs beside the devices.

    Args:
        name: of the station.
        drivers: of its devices.
        spool_root: folder of the takes.
        clock: stamps and waits.
        calibration: matrices that travel with every recording.
        safety: how often the spool reaches the disk, and how much space is kept.
    """

    def __init__(
        self,
        *,
        name: str,
        drivers: Sequence[Driver],
        spool_root: Path,
        clock: StationClock,
        calibration: Mapping[str, Matrix],
        safety: SpoolSafety | None = None,
    ) -> None:
        self.name = name
        self.clock = clock
        self.live = LiveView(drivers, calibration)
        self.supervisors = [
            DeviceSupervisor(driver, sink=self._accept, clock=clock) for driver in drivers
        ]
        self.paths = PathWatch(self.supervisors, clock=clock)
        self.health = HealthMonitor(
            self.supervisors,
            station=name,
            calibration=calibration,
            clock=clock,
            paths=self.paths,
        )
        self.recorder = Recorder(
            station=name,
            spool_root=spool_root,
            drivers=drivers,
            clock=clock,
            calibration=calibration,
            options=TakeOptions(
                safety or SpoolSafety(), self._device_events, self.health, self.paths.latencies
            ),
        )

    def start(self) -> None:
        """Start all readers and the health evaluation."""
        for supervisor in self.supervisors:
            supervisor.start()
        self.health.start()
        self.paths.start()

    def wait_connected(self, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Block until every device answers.

        Raises:
            DeviceError: some do not; the message names them.
        """
        missing = [s.driver.name for s in self.supervisors if not s.connected.wait(timeout_s)]
        if missing:
            raise DeviceError(f"devices {missing} did not connect within {timeout_s:g} s")

    def stop(self) -> None:
        """Stop everything; an unsaved take stays in the spool."""
        # First, while the readers still bring the answer that it may wait for.
        self.paths.stop()
        self.health.stop()
        stoppers = [threading.Thread(target=supervisor.stop) for supervisor in self.supervisors]
        for stopper in stoppers:
            stopper.start()
        for stopper in stoppers:
            stopper.join()
        self.recorder.close()

    def _device_events(self) -> DeviceEvents:
        return {s.driver.name: s.events() for s in self.supervisors}

    def _accept(self, readings: Readings) -> None:
        self.recorder.accept(readings)
        self.live.accept(readings)
        self.health.accept(readings)
        self.paths.accept(readings)
