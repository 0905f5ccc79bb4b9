"""A station whose devices are simulated and play one episode, through the real drivers."""

import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import structlog

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.schemas import Matrix, SaveTake, TakeCheck, TakePrompt
from services.acquisition.clock import StationClock, VirtualClock, Waiter
from services.acquisition.mock_devices import MockFactory, duration_ns
from services.acquisition.mock_links import MockLinks
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.ledger import Ledger
from services.acquisition.mocks.pair import MockPair
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.station import Station
from services.acquisition.supervisor import SpoolSafety

logger = structlog.get_logger(__name__)

LEDGER_FILE = "mock_ledger.json"
LEAD_NS = 20_000_000
LIVE_LEAD_NS = 200_000_000


@dataclass(frozen=True)
class MockTake:
    """A recorded take: where it lies, what was done to it, what the check found."""

    recording_id: str
    spool_path: Path
    ledger: Ledger
    check: TakeCheck


class MockStation:
    """A station whose devices are mocks that play one episode.

    Args:
        streams: of the episode.
        faults: what disturbs the devices.
        seed: of everything random.
        clock: a `VirtualClock` records a take in a fraction of its length, exactly repeatable; a
            `RealClock` lets real time and the operating system play their part.
        spool_root: folder of the takes.
        name: of the station.
        calibration: matrices beyond the gloves' and the path delays (such as `K_head`).
        links: how the devices are connected, and their protocols.
        safety: of the spool.
    """

    def __init__(  # noqa: PLR0913 - all but the first four have a sensible default
        self,
        streams: Sequence[ReplayStream],
        faults: FaultScript,
        seed: int,
        clock: StationClock,
        *,
        spool_root: Path,
        name: str = "mock_station",
        calibration: Mapping[str, Matrix] | None = None,
        links: MockLinks | None = None,
        safety: SpoolSafety | None = None,
    ) -> None:
        factory = MockFactory(streams, faults=faults, seed=seed, clock=clock, links=links)
        self.pairs = factory.build()
        self._clock = clock
        self._seed = seed
        self._lap_ns = duration_ns({s.descriptor.name: s for s in streams})
        self.station = Station(
            name=name,
            drivers=[pair.driver for pair in self.pairs],
            spool_root=spool_root,
            clock=clock,
            calibration={
                **factory.calibration(self.pairs),
                **factory.latencies(self.pairs),
                **(calibration or {}),
            },
            safety=safety,
        )
        self._players: list[tuple[threading.Thread, Waiter]] = []
        self._failures: list[str] = []
        self._epoch_ns: int | None = None

    def __enter__(self) -> "MockStation":
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Plug every device in and start the station."""
        for pair in self.pairs:
            pair.device.port.plug()
        self.station.start()
        self.station.wait_connected()

    def stop(self) -> None:
        """Stop players, station and devices."""
        for _, waiter in self._players:
            waiter.cancel()
        for thread, _ in self._players:
            thread.join()
        self.station.stop()
        for pair in self.pairs:
            pair.device.port.unplug()

    def run_take(
        self, prompt: TakePrompt, *, recording_id: str | None = None, how: SaveTake | None = None
    ) -> MockTake:
        """Record the whole episode once and save it; may be repeated.

        Args:
            prompt: task and instruction.
            recording_id: chosen by the recorder if None.
            how: how it is saved; incomplete takes are accepted if None.

        Raises:
            ConflictError: the recorder is busy.
            DeviceError: a mock could not play (its reader is stuck, or its faults are none that
                such a device can have).
        """
        recorder = self.station.recorder
        recorder.arm(prompt)
        status = recorder.record(recording_id)
        start_ns = self._clock.now_ns() + LEAD_NS
        self._play(start_ns, laps=1)
        for thread, _ in self._players:
            thread.join()
        self._drain()
        if recorder.status().state == "recording":
            recorder.stop()
        check = recorder.status().check
        recorder.save(how or SaveTake(accept_incomplete=True))
        if self._failures or check is None or status.recording_id is None:
            raise DeviceError(f"mock station: {'; '.join(self._failures) or 'no take'}")
        devices = {pair.device.name: pair.device.ledger for pair in self.pairs}
        ledger = Ledger(self._seed, start_ns, devices)
        path = recorder.spool_root / status.recording_id
        ledger.save(path / LEDGER_FILE)
        return MockTake(status.recording_id, path, ledger, check)

    def play_forever(self) -> None:
        """Let the devices go round and round, for a station that an operator uses.

        Raises:
            InvalidInputError: the clock is virtual; it would run away.
        """
        if isinstance(self._clock, VirtualClock):
            raise InvalidInputError("play_forever: needs a real clock")
        self._play(self._clock.now_ns() + LIVE_LEAD_NS, laps=None)

    def _play(self, start_ns: int, *, laps: int | None) -> None:
        # The devices' clocks and counters go on from one take to the next.
        if self._epoch_ns is None:
            self._epoch_ns = start_ns
        offset_ns = start_ns - self._epoch_ns
        # All waiters exist before the first thread runs: a virtual clock waits for all of them.
        waiters = [self._clock.waiter(drives_time=True) for _ in self.pairs]
        self._players = [
            (
                threading.Thread(
                    target=self._run,
                    args=(pair, waiter, (self._epoch_ns, offset_ns), laps),
                    name=f"mock-{pair.device.name}",
                    daemon=True,
                ),
                waiter,
            )
            for pair, waiter in zip(self.pairs, waiters, strict=True)
        ]
        for thread, _ in self._players:
            thread.start()

    def _run(
        self, pair: MockPair, waiter: Waiter, start: tuple[int, int], laps: int | None
    ) -> None:
        epoch_ns, first_offset_ns = start
        with closing(waiter):
            lap = 0
            try:
                while laps is None or lap < laps:
                    offset_ns = first_offset_ns + lap * self._lap_ns
                    if not pair.device.play(
                        self._clock, waiter, start_host_ns=epoch_ns, offset_ns=offset_ns
                    ):
                        return
                    lap += 1
            except (DeviceError, InvalidInputError) as error:
                self._failures.append(f"{pair.device.name}: {error.message}")
                logger.exception("stop_mock_device", device=pair.device.name)

    def _drain(self) -> None:
        for pair in self.pairs:
            if pair.device.port.link.is_open:
                pair.device.port.link.wait_consumed()
