"""Recorder of a station: the state machine of an operator's actions, one take at a time."""

import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex

import structlog

from dextouch.clocks import PathLatency
from dextouch.episodes import disk_errors
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import ConflictError
from dextouch.schemas import (
    Matrix,
    RecorderAction,
    RecorderState,
    RecorderStatus,
    RecordingAttributes,
    SaveTake,
    TakeCheck,
    TakePrompt,
)
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.image_encoding import begin_take
from services.acquisition.memory import give_back_free_memory
from services.acquisition.path_latency import add_latencies
from services.acquisition.supervisor import check_free_space
from services.acquisition.take import Take, TakeOptions

logger = structlog.get_logger(__name__)

ACTIONS: Mapping[RecorderState, tuple[RecorderAction, ...]] = {
    "idle": ("arm",),
    "armed": ("arm", "record", "discard"),
    "recording": ("stop", "discard", "rerecord"),
    "checking": ("save", "discard", "rerecord"),
    "saved": ("arm",),
    "discarded": ("arm",),
}


class Recorder:
    """idle → armed → recording → checking → saved or discarded, one take at a time.

    All samples are written to the spool first. A full disk ends the take, which can still be saved
    or discarded. Actions that name their recording are idempotent; an action for another take than
    the current one is refused.

    Args:
        station: name of the station.
        spool_root: folder of the takes.
        drivers: whose streams are recorded.
        clock: of the station.
        calibration: matrices that travel with every recording.
        options: how takes are kept.
    """

    def __init__(
        self,
        *,
        station: str,
        spool_root: Path,
        drivers: Sequence[Driver],
        clock: StationClock,
        calibration: Mapping[str, Matrix],
        options: TakeOptions | None = None,
    ) -> None:
        self.spool_root = spool_root
        self._station = station
        self._drivers = {driver.name: driver for driver in drivers}
        self._clock = clock
        self._calibration = dict(calibration)
        self._options = options or TakeOptions()
        self._latencies: Callable[[], Mapping[str, PathLatency]] = dict
        # Names that the station's calibration gave to the present take.
        self._stated: frozenset[str] = frozenset()
        # Held for a whole action, disk included; readers never take it.
        self._lock = threading.RLock()
        self._state: RecorderState = "idle"
        self._discarded_id: str | None = None
        self._forget()

    def _forget(self) -> None:
        self._prompt: TakePrompt | None = None
        self._take: Take | None = None
        self._check: TakeCheck | None = None
        self._done: dict[RecorderAction, SaveTake | None] = {}

    def measure_latencies(self, latencies: Callable[[], Mapping[str, PathLatency]]) -> None:
        """Give takes measured path delays of streams whose delay the calibration does not name."""
        self._latencies = latencies

    def status(self) -> RecorderStatus:
        """Where it stands."""
        with self._lock:
            self._settle()
            take = self._take
            return RecorderStatus(
                state=self._state,
                actions=ACTIONS[self._state],
                recording_id=self._recording_id(),
                prompt=self._prompt,
                duration_s=take.duration_s if take else None,
                num_samples={n: c.num_samples for n, c in take.streams.items()} if take else {},
                problems=self._problems(),
                check=self._check,
            )

    def accept(self, readings: Readings) -> None:
        """Spool new readings while recording (called by the reader threads)."""
        take = self._take
        if take is not None:
            take.accept(readings)

    def arm(self, prompt: TakePrompt) -> RecorderStatus:
        """Set the prompt of the next take."""
        with self._lock:
            self._expect("arm")
            self._forget()
            self._prompt = prompt
            self._state = "armed"
            return self.status()

    def record(self, recording_id: str | None = None) -> RecorderStatus:
        """Start the take.

        Raises:
            ConflictError: not armed, or the id is that of another take.
            StorageError: the spool cannot be created, or the disk is nearly full.
        """
        with self._lock:
            if self._is_done("record", recording_id):
                return self.status()
            self._expect("record")
            attributes = self._attributes(recording_id)
            with disk_errors(f"make the spool folder {self.spool_root}"):
                self.spool_root.mkdir(parents=True, exist_ok=True)
            check_free_space(self.spool_root, self._options.safety)
            spool = SpoolWriter(self.spool_root / attributes.recording_id, attributes)
            self._take = Take(
                spool, drivers=self._drivers, clock=self._clock, options=self._options
            )
            self._state = "recording"
            self._done["record"] = None
            logger.info("start_take", recording_id=attributes.recording_id)
            return self.status()

    def stop(self, recording_id: str | None = None) -> RecorderStatus:
        """End the take and check it."""
        with self._lock:
            self._settle()
            if self._is_done("stop", recording_id):
                return self.status()
            self._expect("stop")
            self._finish()
            return self.status()

    def save(self, how: SaveTake) -> RecorderStatus:
        """Keep the take: its spool is closed and waits for the upload.

        Raises:
            ConflictError: nothing to save, an incomplete take without `accept_incomplete`, or
                saved already in another way.
        """
        with self._lock:
            self._settle()
            if self._is_done("save", how.recording_id):
                before = self._done["save"]
                if before is not None and before.success != how.success:
                    raise ConflictError(
                        f"take {how.recording_id!r} was saved with success={before.success}, got "
                        f"{how.success}; saved takes cannot be changed"
                    )
                return self.status()
            self._expect("save")
            take, check = self._take, self._check
            if take is None or check is None:
                raise ConflictError("recorder: there is no take; record one first")
            if not check.complete and not how.accept_incomplete:
                reasons = "; ".join(p.message for p in check.problems if p.level == "ERROR")
                raise ConflictError(f"the take is incomplete: {reasons}. Accept or discard it")
            spool = take.spool
            calibration = add_latencies(
                spool.attributes.calibration, self._latencies(), stated=self._stated
            )
            changed = {
                "calibration": calibration,
                "success": how.success,
                "ledger": take.ledger(),
                "quality": take.quality(),
            }
            spool.set_attributes(spool.attributes.model_copy(update=changed))
            spool.close()
            self._state = "saved"
            self._done["save"] = how
            logger.info("save_take", recording_id=spool.attributes.recording_id)
            give_back_free_memory()
            return self.status()

    def discard(self, recording_id: str | None = None) -> RecorderStatus:
        """Throw the take away, spool included."""
        with self._lock:
            if self._is_done("discard", recording_id):
                return self.status()
            self._expect("discard")
            self._throw_away()
            self._state = "discarded"
            self._done["discard"] = None
            return self.status()

    def rerecord(self, recording_id: str | None = None) -> RecorderStatus:
        """Throw the take away and arm its prompt again."""
        with self._lock:
            again = recording_id is not None and recording_id == self._discarded_id
            if again and self._state == "armed":
                return self.status()
            self._is_done("rerecord", recording_id)
            self._expect("rerecord")
            prompt = self._prompt
            self._throw_away()
            self._forget()
            self._prompt = prompt
            self._state = "armed"
            return self.status()

    def close(self) -> None:
        """Give the files back; an unsaved take stays in the spool for the next start."""
        with self._lock:
            if self._take is not None:
                self._take.release()

    def _throw_away(self) -> None:
        take = self._take
        if take is None:
            return
        self._discarded_id = take.spool.attributes.recording_id
        take.release()
        with disk_errors(f"discard take {self._discarded_id!r}"):
            shutil.rmtree(take.spool.path)
        logger.info("discard_take", recording_id=self._discarded_id)
        give_back_free_memory()

    def _settle(self) -> None:
        """A take that ended because of the disk is checked on the next request."""
        if self._state == "recording" and self._take is not None and self._take.has_ended:
            self._finish()

    def _finish(self) -> None:
        if self._take is not None:
            self._check = self._take.end()
        self._state = "checking"
        self._done["stop"] = None

    def _attributes(self, recording_id: str | None) -> RecordingAttributes:
        prompt = self._prompt
        if prompt is None:
            raise ConflictError("record: nothing was armed; arm first")
        now = datetime.now(UTC)
        stated = self._calibration | begin_take(self._drivers.values())
        self._stated = frozenset(stated)
        streams: list[StreamDescriptor] = []
        for driver in self._drivers.values():
            streams.extend(driver.descriptors)
        return RecordingAttributes(
            recording_id=recording_id or f"{now:%Y%m%d-%H%M%S}-{token_hex(3)}",
            station=self._station,
            started_at=now,
            started_t_host_ns=self._clock.now_ns(),
            calibration=add_latencies(stated, self._latencies(), stated=self._stated),
            streams=tuple(streams),
            **prompt.model_dump(),
        )

    def _recording_id(self) -> str | None:
        return self._take.spool.attributes.recording_id if self._take else None

    def _is_done(self, action: RecorderAction, recording_id: str | None) -> bool:
        """Whether the action was done to the named take; an unnamed one is never a repetition."""
        present = self._recording_id()
        if recording_id is None or (action == "record" and present is None):
            return False
        if recording_id != present:
            raise ConflictError(
                f"recorder: cannot {action} take {recording_id!r}, the present one is {present!r}",
                state=self._state,
                recording_id=present,
            )
        return action in self._done

    def _expect(self, action: RecorderAction) -> None:
        if action not in ACTIONS[self._state]:
            allowed = ", ".join(ACTIONS[self._state])
            raise ConflictError(
                f"recorder: cannot {action} while {self._state}; possible now: {allowed}",
                state=self._state,
            )

    def _problems(self) -> tuple[str, ...]:
        own = self._take.problems() if self._take else ()
        found = self._check.problems if self._check else ()
        return (*own, *(problem.message for problem in found))
