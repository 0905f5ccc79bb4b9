"""A station whose devices are simulated and play one episode, through the real drivers."""

import threading
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import get_args

import structlog

from dextouch.errors import ConflictError, DeviceError, InvalidInputError
from dextouch.schemas import Matrix, SaveTake, SimulatedFault, TakeCheck, TakePrompt
from dextouch.tactile.layout import SIDES
from services.acquisition.clock import StationClock, VirtualClock, Waiter
from services.acquisition.devices import kinds
from services.acquisition.devices.camera import CameraDecoder
from services.acquisition.devices.robot_state import STREAM_SIZES, RobotStateDecoder
from services.acquisition.drivers.base import Decoder, Driver
from services.acquisition.mocks import replay
from services.acquisition.mocks.faults import Edit, FaultScript, Ledger, Pinned
from services.acquisition.mocks.ports import SocketPort
from services.acquisition.mocks.trackers_and_cameras import (
    CameraSource,
    RobotStateSource,
    mock_finger_tracker,
    mock_pose_tracker,
    video_camera,
)
from services.acquisition.settings import MockLinks, SpoolSafety
from services.acquisition.station import Station
from services.acquisition.watches import MakeFollowCheck

LATENCY_SIGMA_MS = 0.2
WRISTS = ("wrist_left", "wrist_right")
logger = structlog.get_logger(__name__)
LEDGER_FILE = "mock_ledger.json"
LEAD_NS = 20_000_000
LIVE_LEAD_NS = 200_000_000
# Longer than five periods of a glove or tracker, from which on health calls it an error.
SLOW_S = 0.1
# A raw cell that all kinds of gloves have.
DEAD_CELL = 9


def mock_glove_of(kind_name: str, slot: replay.MockSlot) -> replay.MockPair:
    """A simulated glove of a kind of this package or another one.

    Raises:
        UnknownNameError: no package brings the kind.
        InvalidInputError: the kind has no mock, it cannot be imported, or it gives something else.
    """
    kind = kinds.device_kind(kind_name)
    if kind.mock is None:
        raise InvalidInputError(
            f"kind of device {kind_name!r}: got no mock, expected one to simulate it; choose "
            f"another kind for the mock station ({', '.join(kinds.kind_names())}) or write its mock"
        )
    where = f"mock of kind {kind_name!r} ({kind.mock})"
    try:
        make = EntryPoint(kind_name, kind.mock, kinds.ENTRY_POINT_GROUP).load()
    except kinds.IMPORT_FAILURES as error:
        raise InvalidInputError(
            f"{where}: got {type(error).__name__}: {error}, expected a function 'module:function' "
            "of a MockSlot; fix the package that provides the kind"
        ) from error
    pair: object = make(slot)
    if not isinstance(pair, replay.MockPair):
        raise InvalidInputError(
            f"{where}: gave {type(pair).__name__}, expected a services.acquisition.mocks.MockPair; "
            "fix the package that provides the kind"
        )
    return pair


def build_mocks(
    streams: Sequence[replay.ReplayStream],
    *,
    faults: FaultScript,
    seed: int,
    clock: StationClock,
    links: MockLinks | None = None,
    unit_seed: int | None = None,
) -> list[replay.MockPair]:
    """The mock devices that a set of streams needs.

    Streams of ground truth alone are left out. `unit_seed` is that of the devices' own offsets and
    gains, by default the seed.

    Raises:
        InvalidInputError: two streams of one name, or none that any device sends.
    """
    links, named = links or MockLinks(), {stream.descriptor.name: stream for stream in streams}
    if len(named) != len(streams):
        raise InvalidInputError("mock station: two streams of the same name")

    def slot(name: str, stream: str) -> replay.MockSlot:
        return replay.MockSlot(
            name, named[stream], faults.of(name), seed, clock, links.trackers, unit_seed
        )

    pairs = []
    for side in SIDES:
        if (tactile := f"tactile_{side}") in named:
            pairs.append(mock_glove_of(links.gloves, slot(f"glove_{side}", tactile)))
        if (keypoints := f"keypoints_{side}") in named:
            pairs.append(mock_finger_tracker(slot(f"finger_tracker_{side}", keypoints)))
    trackers = [*WRISTS, "head"]
    if "joints_measured" in named:
        by_trackers = WRISTS if links.wrists == "trackers" else ()
        source = RobotStateSource({n: s for n, s in named.items() if n in STREAM_SIZES})
        decoder = RobotStateDecoder([name for name in STREAM_SIZES if name not in by_trackers])
        pairs.append(_on_socket(slot("robot_state", "joints_measured"), source, decoder))
        trackers = ["head", *by_trackers]
    pairs += [mock_pose_tracker(slot(f"pose_tracker_{n}", n)) for n in trackers if n in named]
    pairs += [_camera(slot(n, n), links) for n in named if n.startswith("camera_")]
    if not pairs:
        raise InvalidInputError(
            f"mock station: got streams {sorted(named)}, expected tactile_…, keypoints_…, "
            "wrist_…, head, camera_… or joints_…"
        )
    return pairs


def _camera(slot: replay.MockSlot, links: MockLinks) -> replay.MockPair:
    if links.cameras == "station":
        return video_camera(slot, encoding=links.images)
    height_px, width_px = slot.stream.descriptor.shape[:2]
    decoder = CameraDecoder(
        slot.name, height_px=height_px, width_px=width_px, encoding=links.images
    )
    return _on_socket(slot, CameraSource(slot.stream, encoding=links.images), decoder)


def _on_socket(
    slot: replay.MockSlot, source: replay.PacketSource, decoder: Decoder
) -> replay.MockPair:
    port = SocketPort(slot.name)
    driver = Driver(slot.name, transport=port.transport, decoder=decoder, clock=slot.clock)
    return replay.MockPair(replay.MockDevice(slot, source, port), driver)


def _known_of(
    pairs: Sequence[replay.MockPair], seed: int, *, error_ms: float = LATENCY_SIGMA_MS
) -> dict[str, Matrix]:
    """What a calibrated station knows of these devices.

    The path delay of each stream is wrong by about its sigma, as a measured one would be; with an
    `error_ms` of 0 it is the true one.
    """
    known: dict[str, Matrix] = {}
    for pair in pairs:
        known |= pair.calibration
        rng, faults = replay.device_rng(seed, f"latency_{pair.device.name}"), pair.device.faults
        wrong_ms = error_ms * rng.standard_normal() if faults.path_delay_ms else 0.0
        measured_ns = round(max(0.0, faults.path_delay_ms + wrong_ms) * 1e6)
        for descriptor in pair.driver.descriptors:
            known[f"{descriptor.name}_latency_ns"] = ((float(measured_ns),),)
            known[f"{descriptor.name}_latency_sigma_ns"] = ((LATENCY_SIGMA_MS * 1e6,),)
    return known


@dataclass(frozen=True)
class MockTake:
    """A recorded take: where it lies, what was done to it, what the check found.

    `true_calibration` is that of the mock devices: tare and gain of gloves, and all path delays.
    """

    recording_id: str
    spool_path: Path
    ledger: Ledger
    check: TakeCheck
    true_calibration: Mapping[str, Matrix]


class MockStation:
    """A station whose devices are mocks that play one episode.

    A `VirtualClock` records a take in a fraction of its length, exactly repeatable; with a
    `StationClock` real time and the operating system play their part. `calibration` is what is
    known beyond the gloves and path delays (`K_head`), `unknown_delays` are streams whose delay it
    does not hold. Stations of one `unit_seed` (by default the seed) have the same devices.
    """

    def __init__(  # noqa: PLR0913 - all but the first four have a sensible default
        self,
        streams: Sequence[replay.ReplayStream],
        faults: FaultScript,
        seed: int,
        clock: StationClock,
        *,
        spool_root: Path,
        name: str = "mock_station",
        calibration: Mapping[str, Matrix] | None = None,
        links: MockLinks | None = None,
        safety: SpoolSafety | None = None,
        unit_seed: int | None = None,
        follow: MakeFollowCheck | None = None,
        unknown_delays: Collection[str] = (),
    ) -> None:
        unit_seed = seed if unit_seed is None else unit_seed
        self.pairs = build_mocks(
            streams, faults=faults, seed=seed, clock=clock, links=links, unit_seed=unit_seed
        )
        self._clock = clock
        self._seed = seed
        # One round of all streams: the last sample and one period of its stream.
        self._lap_ns = max(int(s.t_ns[-1]) + s.descriptor.period_ns() for s in streams)
        known = _known_of(self.pairs, unit_seed)
        unknown = tuple(f"{stream}_latency_" for stream in unknown_delays)
        known = {name: m for name, m in known.items() if not name.startswith(unknown)}
        self.station = Station(
            name=name,
            drivers=[pair.driver for pair in self.pairs],
            spool_root=spool_root,
            clock=clock,
            calibration={**known, **(calibration or {})},
            safety=safety,
            simulated=True,
            follow=follow,
        )
        self._players: list[tuple[threading.Thread, Waiter]] = []
        self._failures: list[str] = []
        self._setting = threading.Lock()
        self._epoch_ns = 0

    def __enter__(self) -> "MockStation":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
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

        The recorder chooses an id if there is none; incomplete takes are accepted without `how`.

        Raises:
            ConflictError: the recorder is busy.
            DeviceError: a mock could not play (its reader is stuck, or its faults are none that
                such a device can have).
        """
        recorder = self.station.recorder
        recorder.arm(prompt)
        status = recorder.record(recording_id)
        start_ns = self._clock.now_ns() + LEAD_NS
        self._play(start_ns)
        for thread, _ in self._players:
            thread.join()
        for pair in self.pairs:
            if pair.device.port.link.is_open:
                pair.device.port.link.wait_consumed()
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
        truth = _known_of(self.pairs, self._seed, error_ms=0.0)
        return MockTake(status.recording_id, path, ledger, check, truth)

    def set_fault(self, fault: SimulatedFault, *, is_on: bool) -> tuple[SimulatedFault, ...]:
        """Begin or end a fault, of one glove or of the whole station; gives those that are on.

        Raises:
            ConflictError: no glove is simulated, or one of a kind that cannot have the fault.
        """
        gloves = [pair.device for pair in self.pairs if pair.device.name.startswith("glove")]
        if not gloves and fault != "slow_host":
            raise ConflictError(f"fault {fault}: no glove is simulated here, expected one")
        needs: dict[str, Pinned] = {"drift": "saturated", "dead_taxel": "dead"}
        if fault in needs and not gloves[0].source.edits.pins(needs[fault]):
            raise ConflictError(
                f"fault {fault}: the packets of {gloves[0].name} cannot show it, expected a mock "
                f"whose PacketEdits are given what a {needs[fault]!r} cell shows"
            )
        with self._setting:
            before = self.station.faults or ()
            known = get_args(SimulatedFault)
            now = tuple(f for f in known if (is_on if f == fault else f in before))
            self.station.slow_s = SLOW_S if "slow_host" in now else 0.0
            for glove in gloves[:1]:
                if fault == "unplug":
                    glove.set_plugged("fault", is_plugged=not is_on)
                edits = glove.source.edits
                dead = partial(edits.pin, cells=(DEAD_CELL,), how="dead")
                cells: dict[str, Edit] = {"drift": edits.move_zero, "dead_taxel": dead}
                glove.extra_edits = tuple(edit for f, edit in cells.items() if f in now)
            self.station.faults = now
        return now

    def play_forever(self) -> None:
        """Let the devices go round and round, for a station that an operator uses.

        Raises:
            InvalidInputError: the clock is virtual; it would run away.
        """
        if isinstance(self._clock, VirtualClock):
            raise InvalidInputError("play_forever: needs a real clock")
        self._play(self._clock.now_ns() + LIVE_LEAD_NS, forever=True)

    def _play(self, start_ns: int, *, forever: bool = False) -> None:
        # The devices' clocks and counters go on from one take to the next.
        self._epoch_ns = self._epoch_ns or start_ns
        # All waiters exist before the first thread runs: a virtual clock waits for all of them.
        waiters = [self._clock.waiter(drives_time=True) for _ in self.pairs]
        self._players = [
            (
                threading.Thread(
                    target=self._run,
                    args=(pair, waiter, start_ns - self._epoch_ns, forever),
                    name=f"mock-{pair.device.name}",
                    daemon=True,
                ),
                waiter,
            )
            for pair, waiter in zip(self.pairs, waiters, strict=True)
        ]
        for thread, _ in self._players:
            thread.start()

    def _run(self, pair: replay.MockPair, waiter: Waiter, offset_ns: int, forever: bool) -> None:  # noqa: FBT001 - of a thread
        device, epoch_ns = pair.device, self._epoch_ns
        with closing(waiter):
            try:
                while (
                    device.play(self._clock, waiter, start_host_ns=epoch_ns, offset_ns=offset_ns)
                    and forever
                ):
                    offset_ns += self._lap_ns
            except (DeviceError, InvalidInputError) as error:
                self._failures.append(f"{device.name}: {error.message}")
                logger.exception("stop_mock_device", device=device.name)
