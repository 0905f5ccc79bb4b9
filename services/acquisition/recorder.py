"""Recorder of a station: one take at a time in a spool, and the count of saved ones."""

import ctypes
import gc
import threading
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Final

import numpy as np
import structlog
from pydantic import ValidationError

from dextouch import schemas
from dextouch.clocks import PathLatency
from dextouch.episodes import disk_errors, replace_file
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import ConflictError, InvalidInputError, StorageError
from dextouch.serving import ServedFolder
from dextouch.tracing import current_trace_id
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver
from services.acquisition.health.monitor import HealthMonitor
from services.acquisition.retention import discard_take
from services.acquisition.settings import SpoolSafety
from services.acquisition.take import (
    DeviceEvents,
    Take,
    TakeWatch,
    check_free_space,
    incomplete_cause,
)
from services.acquisition.watches import FollowWatch, add_latencies

logger = structlog.get_logger(__name__)

SESSION_FILE: Final = "session.json"
# Takes of these tasks show devices and a board; guided runs record them without an operator.
CALIBRATION: Final = ("calibrate-glove", "calibrate-time")
ACTIONS: Mapping[schemas.RecorderState, tuple[schemas.RecorderAction, ...]] = {
    "idle": ("arm",),
    "armed": ("arm", "record", "discard"),
    "recording": ("stop", "discard", "rerecord"),
    "checking": ("save", "discard", "rerecord"),
    "saved": ("arm",),
    "discarded": ("arm",),
}
# The state that each action leads to.
NEXT: Mapping[schemas.RecorderAction, schemas.RecorderState] = {
    "arm": "armed",
    "record": "recording",
    "stop": "checking",
    "save": "saved",
    "discard": "discarded",
    "rerecord": "armed",
}
# What numpy keeps of small arrays that were freed, for each size in bytes, to give it out again
# (numpy/_core/src/multiarray/alloc.c).
CACHED_BYTES, CACHED_ARRAYS = 1024, 7
# Looked up once: every handle of the C library is a class of its own, which only the collector of
# cycles removes.
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)


class Recorder:
    """idle → armed → recording → checking → saved or discarded, one take at a time.

    All samples are written to the spool first. A full disk ends the take, which can still be saved
    or discarded. Actions that name their recording are idempotent; an action for another take than
    the current one is refused. `take` is the running or ended one, which reader threads append to.

    With `needs_consent`, no take is armed without an operator who consented.

    `device_events` gives, by device, counts of named events since the station's start (those of the
    drivers if None), `latencies` the measured path delays of streams.
    """

    def __init__(  # noqa: PLR0913 - all by name
        self,
        *,
        station: str,
        spool_root: Path,
        drivers: Sequence[Driver],
        clock: StationClock,
        calibration: Mapping[str, schemas.Matrix],
        safety: SpoolSafety | None = None,
        device_events: Callable[[], DeviceEvents] | None = None,
        health: HealthMonitor | None = None,
        latencies: Callable[[], Mapping[str, PathLatency]] = dict,
        follow: FollowWatch | None = None,
    ) -> None:
        self.spool_root = spool_root
        self.spool_folder = ServedFolder(spool_root, "spool")
        self._station = station
        self._drivers = {driver.name: driver for driver in drivers}
        self._clock = clock
        self._calibration = dict(calibration)
        self._safety = safety or SpoolSafety()
        self._device_events, self._latencies = device_events, latencies
        self._health, self._follow = health, follow
        # Names that the station's calibration gave to the present take.
        self._stated: frozenset[str] = frozenset()
        # Held for a whole action, disk included; readers never take it.
        self._lock = threading.RLock()
        self._state: schemas.RecorderState = "idle"
        self._discarded_id: str | None = None
        self.session = SessionCount(spool_root)
        self.needs_consent = False
        self._arm(None)

    def status(self) -> schemas.RecorderStatus:
        """Where it stands."""
        with self._lock:
            self._settle()
            take, check = self.take, self._check
            problems = [problem.message for problem in check.problems] if check else []
            return schemas.RecorderStatus(
                state=self._state,
                actions=ACTIONS[self._state],
                recording_id=self._recording_id(),
                prompt=self._prompt,
                duration_s=take.watch.duration_s if take else None,
                num_samples={n: c.num_samples for n, c in take.watch.streams.items()}
                if take
                else {},
                problems=(*(take.problems() if take else ()), *problems),
                check=check,
                session=self.session.now,
                needs_consent=self.needs_consent,
            )

    def arm(self, prompt: schemas.TakePrompt) -> schemas.RecorderStatus:
        """Set the prompt of the next take.

        Raises:
            InvalidInputError: no operator or no consent, at a station that needs both.
        """
        is_agreed = bool(prompt.operator) and prompt.consent
        if self.needs_consent and not is_agreed and prompt.task not in CALIBRATION:
            given = "no consent" if prompt.operator else "no operator"
            raise InvalidInputError(
                f"arm: got {given}, expected the pseudonym of an operator who agreed to be "
                "recorded; name both, or start the station with --no-require-consent"
            )
        return self._act("arm", None, partial(self._arm, prompt))

    def record(self, recording_id: str | None = None) -> schemas.RecorderStatus:
        """Start the take.

        Raises:
            ConflictError: not armed, or the id is that of another take.
            StorageError: the spool cannot be created, or the disk is nearly full.
        """
        return self._act("record", recording_id, partial(self._record, recording_id))

    def stop(self, recording_id: str | None = None) -> schemas.RecorderStatus:
        """End the take and check it."""
        return self._act("stop", recording_id, self._stop)

    def save(self, how: schemas.SaveTake) -> schemas.RecorderStatus:
        """Keep the take: its spool is closed and waits for the upload.

        Raises:
            ConflictError: nothing to save, an incomplete take without `accept_incomplete`, or
                saved already in another way.
        """
        with self._lock:
            status = self._act("save", how.recording_id, partial(self._save, how))
            if how.success != self._saved_as:
                raise ConflictError(
                    f"take {how.recording_id!r} was saved with success={self._saved_as}, got "
                    f"{how.success}; saved takes cannot be changed"
                )
            return status

    def discard(self, recording_id: str | None = None) -> schemas.RecorderStatus:
        """Throw the take away, spool included."""
        return self._act("discard", recording_id, self._discard)

    def rerecord(self, recording_id: str | None = None) -> schemas.RecorderStatus:
        """Throw the take away and arm its prompt again."""
        with self._lock:
            again = recording_id is not None and recording_id == self._discarded_id
            if again and self._state == "armed":
                return self.status()
            return self._act("rerecord", recording_id, self._rerecord)

    def begin_session(self) -> schemas.RecorderStatus:
        """Count saved takes from zero again; what was saved stays."""
        self.session.begin()
        return self.status()

    def close(self) -> None:
        """Give the files back; an unsaved take stays in the spool for the next start."""
        with self._lock:
            if self.take is not None:
                self.take.release()

    def _act(
        self, action: schemas.RecorderAction, recording_id: str | None, do: Callable[[], None]
    ) -> schemas.RecorderStatus:
        """Do what is possible now and was not done to the named take before."""
        with self._lock:
            self._settle()
            if not self._is_done(action, recording_id):
                if action not in ACTIONS[self._state]:
                    allowed = ", ".join(ACTIONS[self._state])
                    raise ConflictError(
                        f"recorder: cannot {action} while {self._state}; possible now: {allowed}",
                        state=self._state,
                    )
                do()
                self._state = NEXT[action]
                self._done.add(action)
            return self.status()

    def _settle(self) -> None:
        """A take that ended because of the disk is checked on the next request."""
        if self._state == "recording" and self.take is not None and self.take.watch.has_ended:
            self._stop()
            self._state = "checking"
            self._done.add("stop")

    def _is_done(self, action: schemas.RecorderAction, recording_id: str | None) -> bool:
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

    def _arm(self, prompt: schemas.TakePrompt | None) -> None:
        self._prompt = prompt
        self.take: Take | None = None
        self._check: schemas.TakeCheck | None = None
        self._saved_as: bool | None = None
        self._done: set[schemas.RecorderAction] = set()

    def _record(self, recording_id: str | None) -> None:
        attributes = self._attributes(recording_id)
        self.spool_folder.open()
        self.spool_folder.check(writing=True)
        check_free_space(self.spool_root, self._safety)
        spool = SpoolWriter(self.spool_root / attributes.recording_id, attributes)
        watch = TakeWatch(
            self._drivers,
            self._clock,
            device_events=self._device_events,
            health=self._health,
            follow=self._follow,
        )
        self.take = Take(spool, watch, clock=self._clock, safety=self._safety)
        self._done = set()
        if self._health is not None:
            self._health.history.begin_take(attributes.recording_id, watch.started_ns)
        logger.info("start_take", recording_id=attributes.recording_id)

    def _stop(self) -> None:
        if self.take is not None:
            self._check = self.take.end()
            self._note_end(self.take)

    def _note_end(self, take: Take) -> None:
        if self._health is not None:
            stop_ns = take.watch.started_ns + round(take.watch.duration_s * 1e9)
            self._health.history.end_take(take.spool.attributes.recording_id, stop_ns)

    def _save(self, how: schemas.SaveTake) -> None:
        take, check = self.take, self._check
        if take is None or check is None:
            raise ConflictError("recorder: there is no take; record one first")
        if not check.complete and not how.accept_incomplete:
            reasons = "; ".join(p.message for p in check.problems if p.level == "ERROR")
            raise ConflictError(f"the take is incomplete: {reasons}. Accept or discard it")
        spool = take.spool
        known, measured = spool.attributes.calibration, self._latencies()
        changed = {
            "calibration": add_latencies(known, measured, stated=self._stated),
            "success": how.success,
            "complete": check.complete,
            "incomplete_cause": incomplete_cause(check),
            "ledger": take.watch.ledger(),
            "quality": take.watch.quality(),
            "trace_id": current_trace_id(),
        }
        spool.set_attributes(spool.attributes.model_copy(update=changed))
        spool.close()
        self._saved_as = how.success
        logger.info("save_take", recording_id=spool.attributes.recording_id)
        if self._prompt is not None:
            saved = spool.attributes
            cause = saved.incomplete_cause
            self.session.add(self._prompt, saved.recording_id, incomplete=cause)
        give_back_free_memory()

    def _discard(self) -> None:
        take = self.take
        if take is None:
            return
        # Where the disk is gone, the take would come back with it.
        self.spool_folder.check(writing=True)
        self._discarded_id = take.spool.attributes.recording_id
        take.release()
        self._note_end(take)
        if take.spool.path.exists():
            discard_take(take.spool.path)
        logger.info("discard_take", recording_id=self._discarded_id)
        give_back_free_memory()

    def _rerecord(self) -> None:
        self._discard()
        self._arm(self._prompt)

    def _attributes(self, recording_id: str | None) -> schemas.RecordingAttributes:
        prompt = self._prompt
        if prompt is None:
            raise ConflictError("record: nothing was armed; arm first")
        now = datetime.now(UTC)
        stated = dict(self._calibration)
        for driver in self._drivers.values():
            stated |= driver.begin_take()
        self._stated = frozenset(stated)
        return schemas.RecordingAttributes(
            recording_id=recording_id or f"{now:%Y%m%d-%H%M%S}-{token_hex(3)}",
            station=self._station,
            started_at=now,
            started_t_host_ns=self._clock.now_ns(),
            calibration=add_latencies(stated, self._latencies(), stated=self._stated),
            streams=tuple(d for driver in self._drivers.values() for d in driver.descriptors),
            **prompt.model_dump(),
        )

    def _recording_id(self) -> str | None:
        return self.take.spool.attributes.recording_id if self.take else None


class SessionCount:
    """The present session, for any thread; counts survive a restart and removals of takes.

    A session that cannot be written is counted in memory: a take that is saved must stay saved.
    """

    def __init__(self, spool_root: Path) -> None:
        self._path = spool_root / SESSION_FILE
        self._lock = threading.Lock()
        self.now = self._read() or schemas.RecorderSession(started_at=datetime.now(UTC))

    def begin(self) -> None:
        """Begin a new session, in which nothing was saved yet."""
        with self._lock:
            self._write(started_at=datetime.now(UTC), saved=())

    def add(self, prompt: schemas.TakePrompt, recording_id: str, *, incomplete: str = "") -> None:
        """Count a saved take; `incomplete` says why it is, if it is."""
        with self._lock:
            key = (prompt.task, prompt.operator)
            counts = {(item.task, item.operator): item.num_saved for item in self.now.saved}
            counts[key] = counts.get(key, 0) + 1
            saved = tuple(
                schemas.SavedTakes(task=task, operator=operator, num_saved=count)
                for (task, operator), count in counts.items()
            )
            self._write(saved=saved, last_saved=recording_id, last_incomplete=incomplete)

    def operators(self) -> tuple[str, ...]:
        """All operators that the counts name."""
        names = {item.operator for item in self.now.saved}
        return tuple(sorted(name for name in names if name is not None))

    def forget(self, operator: str) -> None:
        """Remove an operator's counts."""
        with self._lock:
            self._write(saved=tuple(item for item in self.now.saved if item.operator != operator))

    def _write(self, **changed: object) -> None:
        self.now = session = self.now.model_copy(update=changed)
        try:
            with disk_errors(f"write {self._path.name}"):
                # In a spool that is gone this fails: only a take may create it.
                replace_file(self._path, session.model_dump_json().encode())
        except StorageError as error:
            logger.warning("fail_session_count", error=error.message)

    def _read(self) -> schemas.RecorderSession | None:
        try:
            return schemas.RecorderSession.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            logger.warning("fail_session_count", error=str(error))
            return None


def keep_for_life() -> None:
    """Exclude all existing objects from garbage collection; call once, in a station's process.

    Otherwise each collection would visit modules, classes and devices and block all threads for
    tens of milliseconds. Automatic collections then also run after fewer takes. It also fills
    numpy's cache of small arrays (4 MB), which would otherwise grow over many takes.
    """
    small = [np.empty(n, np.uint8) for n in range(CACHED_BYTES) for _ in range(CACHED_ARRAYS)]
    small.clear()
    gc.collect()
    gc.freeze()
    # The next full collection starts when young objects exceed a quarter of these.
    gc.collect()


def give_back_free_memory() -> bool:
    """Between takes: milliseconds. False where the C library has no `malloc_trim` (not glibc).

    glibc keeps free memory in the process, a little more after each take, until this is called.
    Circles are looked for after `keep_for_life` only: without it that would hold up readers in the
    middle of a take, if it is an upload that calls this.
    """
    if gc.get_freeze_count():
        gc.collect()
    if _TRIM is None:
        return False
    _TRIM(ctypes.c_size_t(0))
    return True
