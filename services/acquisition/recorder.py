"""Readings of all devices and an operator's actions come in; spooled, checked takes go out."""

import shutil
import threading
from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex

import structlog

from dextouch.episodes.log import SpoolWriter
from dextouch.errors import ConflictError, StorageError
from dextouch.schemas.episodes import Matrix
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch
from services.acquisition.clock import StationClock
from services.acquisition.completeness import (
    StreamFacts,
    TakeSpan,
    check_take,
    take_ledger,
)
from services.acquisition.counters import StreamCounters
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.schemas import (
    Action,
    RecorderStatus,
    SaveTake,
    State,
    TakeCheck,
    TakePrompt,
)

logger = structlog.get_logger(__name__)

ACTIONS: Mapping[State, tuple[Action, ...]] = {
    "idle": ("arm",),
    "armed": ("arm", "record", "discard"),
    "recording": ("stop", "discard"),
    "checking": ("save", "discard"),
    "saved": ("arm",),
    "discarded": ("arm",),
}


class Recorder:
    """idle → armed → recording → checking → saved or discarded, one take at a time.

    Everything goes to the spool first. A full disk ends the take; what is there stays and can be
    saved or discarded.

    Args:
        station: name of the station.
        spool_root: folder of the takes.
        drivers: whose streams are recorded.
        clock: of the station.
        calibration: matrices that travel with every recording.
    """

    def __init__(
        self,
        *,
        station: str,
        spool_root: Path,
        drivers: Sequence[Driver],
        clock: StationClock,
        calibration: Mapping[str, Matrix],
    ) -> None:
        self.spool_root = spool_root
        self._station = station
        self._drivers = {driver.name: driver for driver in drivers}
        self._clock = clock
        self._calibration = dict(calibration)
        self._lock = threading.RLock()
        self._state: State = "idle"
        self._forget()

    def _forget(self) -> None:
        self._prompt: TakePrompt | None = None
        self._spool: SpoolWriter | None = None
        self._span: TakeSpan | None = None
        self._started_ns = 0
        self._streams: dict[str, StreamCounters] = {}
        self._before: dict[str, DecoderStatistics] = {}
        self._facts: list[StreamFacts] = []
        self._check: TakeCheck | None = None
        self._failure: str | None = None

    def status(self) -> RecorderStatus:
        """Where it stands."""
        with self._lock:
            duration_s = None
            if self._state == "recording":
                duration_s = (self._clock.now_ns() - self._started_ns) / 1e9
            elif self._span is not None:
                duration_s = self._span.duration_s
            return RecorderStatus(
                state=self._state,
                actions=ACTIONS[self._state],
                recording_id=self._spool.attributes.recording_id if self._spool else None,
                prompt=self._prompt,
                duration_s=duration_s,
                num_samples={name: c.num_samples for name, c in self._streams.items()},
                problems=self._problems(),
                check=self._check,
            )

    def accept(self, device: str, readings: Readings) -> None:
        """Spool new readings while recording (called by the reader threads)."""
        del device
        with self._lock:
            if self._state != "recording" or self._spool is None:
                return
            try:
                for name, samples in readings.items():
                    self._spool.append(name, SampleBatch.from_samples(samples))
                    self._streams[name].add(samples)
            except StorageError as error:
                self._failure = error.message
                logger.error("stop_take_by_disk", error=error.message)  # noqa: TRY400 - one line
                self._finish()

    def arm(self, prompt: TakePrompt) -> RecorderStatus:
        """Announce what is going to be recorded."""
        with self._lock:
            self._expect("arm")
            self._forget()
            self._prompt = prompt
            self._state = "armed"
            return self.status()

    def record(self, recording_id: str | None = None) -> RecorderStatus:
        """Start the take.

        Raises:
            ConflictError: not armed.
            StorageError: the spool cannot be created.
        """
        with self._lock:
            self._expect("record")
            attributes = self._attributes(recording_id)
            self._spool = SpoolWriter(self.spool_root / attributes.recording_id, attributes)
            self._started_ns = attributes.started_t_host_ns or 0
            self._streams = {d.name: StreamCounters() for d in attributes.streams}
            self._before = {name: _copy(d.statistics) for name, d in self._drivers.items()}
            self._state = "recording"
            logger.info("start_take", recording_id=attributes.recording_id)
            return self.status()

    def stop(self) -> RecorderStatus:
        """End the take and check it."""
        with self._lock:
            self._expect("stop")
            self._finish()
            return self.status()

    def save(self, how: SaveTake) -> RecorderStatus:
        """Keep the take: its spool is closed and waits for the upload.

        Raises:
            ConflictError: nothing to save, or an incomplete take without `accept_incomplete`.
        """
        with self._lock:
            self._expect("save")
            spool, check = self._taken()
            if not check.complete and not how.accept_incomplete:
                reasons = "; ".join(p.message for p in check.problems if p.level == "ERROR")
                raise ConflictError(f"the take is incomplete: {reasons}. Accept or discard it")
            changed = {"success": how.success, "ledger": take_ledger(self._facts)}
            spool.set_attributes(spool.attributes.model_copy(update=changed))
            spool.close()
            self._state = "saved"
            logger.info("save_take", recording_id=spool.attributes.recording_id)
            return self.status()

    def discard(self) -> RecorderStatus:
        """Throw the take away, spool included."""
        with self._lock:
            self._expect("discard")
            if self._spool is not None:
                self._spool.abandon()
                shutil.rmtree(self._spool.path)
                logger.info("discard_take", recording_id=self._spool.attributes.recording_id)
            self._state = "discarded"
            return self.status()

    def close(self) -> None:
        """Give the files back; an unsaved take stays in the spool for the next start."""
        with self._lock:
            if self._spool is not None:
                self._spool.abandon()

    def _finish(self) -> None:
        self._span = TakeSpan(self._started_ns, self._clock.now_ns())
        spool = self._spool
        if spool is not None and self._failure is None:
            try:
                spool.flush()
            except StorageError as error:
                self._failure = error.message
        self._facts = [
            StreamFacts(
                descriptor,
                self._streams[descriptor.name],
                _difference(driver.statistics, self._before[name]),
            )
            for name, driver in self._drivers.items()
            for descriptor in driver.descriptors
        ]
        self._check = check_take(self._facts, self._span)
        self._state = "checking"

    def _attributes(self, recording_id: str | None) -> RecordingAttributes:
        prompt = self._prompt
        if prompt is None:
            raise ConflictError("record: nothing was armed; arm first")
        now = datetime.now(UTC)
        streams: list[StreamDescriptor] = []
        for driver in self._drivers.values():
            streams.extend(driver.descriptors)
        return RecordingAttributes(
            recording_id=recording_id or f"{now:%Y%m%d-%H%M%S}-{token_hex(3)}",
            station=self._station,
            started_at=now,
            started_t_host_ns=self._clock.now_ns(),
            calibration=self._calibration,
            streams=tuple(streams),
            **prompt.model_dump(),
        )

    def _expect(self, action: Action) -> None:
        if action not in ACTIONS[self._state]:
            allowed = ", ".join(ACTIONS[self._state])
            raise ConflictError(
                f"recorder: cannot {action} while {self._state}; possible now: {allowed}",
                state=self._state,
            )

    def _problems(self) -> tuple[str, ...]:
        failure = (self._failure,) if self._failure else ()
        found = self._check.problems if self._check else ()
        return (*failure, *(problem.message for problem in found))

    def _taken(self) -> tuple[SpoolWriter, TakeCheck]:
        if self._spool is None or self._check is None:
            raise ConflictError("recorder: there is no take; record one first")
        return self._spool, self._check


def _copy(statistics: DecoderStatistics) -> DecoderStatistics:
    return _difference(statistics, DecoderStatistics())


def _difference(later: DecoderStatistics, earlier: DecoderStatistics) -> DecoderStatistics:
    return DecoderStatistics(
        **{f.name: getattr(later, f.name) - getattr(earlier, f.name) for f in fields(later)}
    )
