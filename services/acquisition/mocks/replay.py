"""A device that plays a stream of an episode as packets, and the driver on its other end."""

import heapq
import threading
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import EpisodeReader
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.schemas import Matrix
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock, VirtualClock, Waiter
from services.acquisition.drivers.base import Decoder, Driver
from services.acquisition.drivers.packets import SEQUENCE_MODULUS
from services.acquisition.mocks.faults import (
    DeviceFaults,
    DeviceLedger,
    Edit,
    Fate,
    OurPacketEdits,
    PacketEdits,
    Pinned,
    Schedule,
    boot_time_ns,
    flip_bits,
    halve_units,
    lose_bytes,
    make_schedule,
)
from services.acquisition.mocks.ports import MockPort, PtyPort

PLAYED_KINDS = ("tactile", "keypoints", "pose", "image", "robot_state")


@dataclass(frozen=True)
class ReplayStream:
    """One stream of a truth or recorded episode, ready to be played by a mock device.

    Raises:
        ShapeError: values that do not fit the descriptor or the times.
        NonFiniteError: NaN or infinity.
        InvalidInputError: no sample, or times that do not grow from 0 on.
    """

    descriptor: StreamDescriptor
    t_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __post_init__(self) -> None:
        name, shape = self.descriptor.name, self.descriptor.shape
        if self.values.shape != (len(self.t_ns), *shape):
            raise ShapeError(
                f"replay stream {name!r}: got values {self.values.shape}, expected "
                f"{(len(self.t_ns), *shape)}"
            )
        if len(self.t_ns) == 0 or self.t_ns[0] < 0 or np.any(np.diff(self.t_ns) <= 0):
            raise InvalidInputError(f"replay stream {name!r}: expected times growing from 0 on")
        if self.values.dtype.kind == "f" and not np.all(np.isfinite(self.values)):
            raise NonFiniteError(f"replay stream {name!r}: NaN or infinity in the values")


class PacketSource(ABC):
    """What one device says: packets made from replay streams.

    `t_ns` is when each sample is taken; `edits` are by default those of our documented devices.
    """

    t_ns: Int64[np.ndarray, " n"]
    edits: PacketEdits = OurPacketEdits()

    @abstractmethod
    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """The packet of sample `index`, as the units that the port sends (reports, or one)."""

    def fate(self, index: int) -> Fate:
        """What becomes of sample `index` if its packet arrives: SENT of a good one."""
        return Fate.SENT


@dataclass(frozen=True)
class MockSlot:
    """One device of a mock station.

    Attributes:
        name: of the device, such as `glove_left`.
        stream: what it plays; of a glove the pressures, float32 [n, taxels] in kPa in anatomical
            order of the layout of its descriptor; `at_rate` resamples them to the rate of a glove.
        faults: what disturbs the device. Its source sees to `dead_taxels`, raw cells that read 0.
        seed: of everything random.
        clock: of the station.
        link: of a tracker.
        unit_seed: of the offsets and gains of this very device, the same in every take; None: the
            seed.
    """

    name: str
    stream: ReplayStream
    faults: DeviceFaults
    seed: int
    clock: StationClock
    link: Literal["hid", "bridge"] = "hid"
    unit_seed: int | None = None

    @property
    def side(self) -> Side:
        """The hand that the device's name ends with."""
        return "left" if self.name.endswith("left") else "right"


class _Event(NamedTuple):
    """A packet or a plugging of a device, at a time counted from the start of the take."""

    t_ns: int
    sample_index: int | None
    plug: bool = False


class MockDevice:
    """Plays a packet source through a port, disturbed by its faults, keeping a ledger."""

    def __init__(self, slot: MockSlot, source: PacketSource, port: MockPort) -> None:
        faults = slot.faults
        self.name = slot.name
        self.source = source
        self.port = port
        self.faults = faults
        self._rng = device_rng(slot.seed, slot.name)
        self._boot_ns = boot_time_ns(self._rng)
        self._bit_error_rate = faults.bit_error_rate if port.has_bit_errors else 0.0
        self._byte_loss_rate = faults.byte_loss_rate if port.has_bit_errors else 0.0
        self._edits = source.edits
        pinned: dict[Pinned, tuple[int, ...]] = {
            "stuck": faults.stuck_taxels,
            "saturated": faults.saturated_taxels,
        }
        self._taxel_edits: list[Edit] = [
            partial(self._edits.pin, cells=cells, how=how) for how, cells in pinned.items() if cells
        ]
        # Of one who shows a fault on request.
        self.extra_edits: tuple[Edit, ...] = ()
        # Who holds it unplugged: the script of faults, and one who shows a fault.
        self._unplugged_by: set[str] = set()
        self._plugging = threading.Lock()
        self._next_sequence = faults.first_sequence
        # The device numbers all that it sends, in the order in which it sends it.
        self._numbering = threading.Lock()
        # The place in the ledger and the units of a packet that the next one overtakes.
        self._held: tuple[int, list[bytes]] | None = None
        self._start_host_ns = 0
        self.ledger = self._new_ledger()

    def play(
        self, clock: StationClock, waiter: Waiter, *, start_host_ns: int, offset_ns: int = 0
    ) -> bool:
        """Play the whole source once, unless the waiter is cancelled (False).

        Its clock counts from `start_host_ns`, when the device's first take started; this play
        begins `offset_ns` later. With a virtual clock the device waits for the host after each
        packet. The ledger is that of the last play.
        """
        lockstep = isinstance(clock, VirtualClock)
        self._start_host_ns = start_host_ns
        self.ledger = self._new_ledger()
        schedule = make_schedule(
            self.source.t_ns + offset_ns, self.faults, boot_ns=self._boot_ns, rng=self._rng
        )
        for event in self._events(schedule):
            if not waiter.wait_until(start_host_ns + event.t_ns):
                return False
            if event.sample_index is not None:
                with self._numbering:
                    self._send(event.sample_index, schedule)
            else:
                self.set_plugged("script", is_plugged=event.plug)
            if lockstep and (event.plug or event.sample_index is not None):
                self.port.link.wait_consumed()
            elif lockstep:
                self.port.link.wait_closed()
        if self._held is not None:
            # Nothing came behind it: it is the last and in order.
            self.ledger.fate[self._held[0]] = Fate.SENT.value
            self._send_held()
        return True

    def _events(self, schedule: Schedule) -> Iterator[_Event]:
        """Packets as they arrive, and plugging behind those of the same time."""
        start_ns, end_ns = schedule.t_true_ns[0], schedule.t_arrival_ns[-1]
        packets = (_Event(int(t_ns), i) for i, t_ns in enumerate(schedule.t_arrival_ns))
        edges = (
            _Event(t_ns, None, plug)
            for window_s in self.faults.unplugged_s
            for t_ns, plug in zip((round(s * 1e9) for s in window_s), (False, True), strict=True)
            if start_ns <= t_ns <= end_ns
        )
        return heapq.merge(packets, edges, key=attrgetter("t_ns"))

    def set_plugged(self, by: str, *, is_plugged: bool) -> None:
        """Plug in or pull out on behalf of somebody; it is plugged while nobody holds it out."""
        with self._plugging:
            was_out = bool(self._unplugged_by)
            (self._unplugged_by.discard if is_plugged else self._unplugged_by.add)(by)
            if was_out != bool(self._unplugged_by):
                (self.port.unplug if self._unplugged_by else self.port.plug)()

    def send_aside(self, make: Callable[[int], bytes]) -> None:
        """Send what is made of the next sequence number; it has no ledger entry."""
        with self._numbering:
            self.port.send(make(self._take_number()))

    def _take_number(self) -> int:
        sequence = self._next_sequence
        self._next_sequence = (sequence + 1) % SEQUENCE_MODULUS
        return sequence

    def _send(self, index: int, schedule: Schedule) -> None:
        sequence = self._take_number()
        t_device_ns = int(schedule.t_device_ns[index])
        fate, flips = Fate.SENT, 0
        if schedule.is_unplugged[index] or not self.port.link.is_open:
            fate = Fate.UNPLUGGED
        elif schedule.is_dropped[index]:
            fate = Fate.DROPPED
        else:
            fate = self.source.fate(index)
            units = self.source.units(index, sequence, t_device_ns)
            units, fate = self._edit(units, int(schedule.t_true_ns[index]), fate)
            fate, flips = self._deliver(units, fate)
        times_ns = (
            self._start_host_ns + int(schedule.t_true_ns[index]),
            t_device_ns,
            self._start_host_ns + int(schedule.t_arrival_ns[index]),
        )
        self.ledger.note(sequence, times_ns, fate, flips)

    def _deliver(self, units: list[bytes], fate: Fate) -> tuple[Fate, int]:
        """Send a packet through everything that can happen to it on its way."""
        if self._happens(self.faults.half_packet_probability):
            units, fate = halve_units(units), Fate.HALF
        elif fate is Fate.SENT:
            if self._held is None and self._happens(self.faults.reorder_probability):
                self._held = (len(self.ledger.fate), units)
                return Fate.LATE, 0
            if self._happens(self.faults.duplicate_probability):
                units, fate = units * 2, Fate.REPEATED
        fate, flips = self._put_on_line(units, fate)
        self._send_held()
        return fate, flips

    def _put_on_line(self, units: list[bytes], fate: Fate) -> tuple[Fate, int]:
        flips = 0
        for unit in units:
            damaged, num_flips = flip_bits(unit, self._bit_error_rate, self._rng)
            damaged, num_lost = lose_bytes(damaged, self._byte_loss_rate, self._rng)
            flips += num_flips
            if num_flips or num_lost:
                fate = Fate.CORRUPTED
            if not self.port.send(damaged):
                fate = Fate.OVERRUN
        return fate, flips

    def _send_held(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            self._put_on_line(held[1], Fate.LATE)

    def _happens(self, probability: float) -> bool:
        # No random number is drawn for what cannot happen, so that one fault does not change
        # what another one does.
        return probability > 0 and bool(self._rng.random() < probability)

    def _edit(self, units: list[bytes], t_true_ns: int, fate: Fate) -> tuple[list[bytes], Fate]:
        """What the device says instead, with what is wrong in itself."""
        faults = self.faults
        edits = [*self._taxel_edits, *self.extra_edits]
        for from_s, edit in (
            (faults.version_from_s, self._edits.other_version),
            (faults.wrong_side_from_s, self._edits.other_side),
        ):
            if from_s is not None and t_true_ns >= from_s * 1e9:
                edits.append(edit)
                fate = Fate.REFUSED
        if self._happens(faults.nan_probability):
            edits.append(self._edits.put_nan)
            if fate is Fate.SENT:
                is_marked = self._edits.is_marked_when_nan(units)
                fate = Fate.MARKED if is_marked else Fate.REFUSED
        return self._edits.apply(units, edits), fate

    def _new_ledger(self) -> DeviceLedger:
        return DeviceLedger(
            path_delay_ns=round(self.faults.path_delay_ms * 1e6),
            script=self.faults.model_dump(mode="json", exclude_defaults=True),
        )


@dataclass(frozen=True)
class MockPair:
    """A simulated device and the real driver on its other end.

    Attributes:
        device: plays the packets.
        driver: reads them.
        calibration: matrices by name that a calibrated station knows of such a device, such as
            `tactile_left_tare_counts`; none where its maker's devices come without them.
    """

    device: MockDevice
    driver: Driver
    calibration: Mapping[str, Matrix] = field(default_factory=dict)


def serial_mock(
    slot: MockSlot,
    *,
    source: PacketSource,
    decoder: Decoder,
    calibration: Mapping[str, Matrix] | None = None,
) -> MockPair:
    """A simulated device on a pseudo terminal, read by the real serial transport."""
    port = PtyPort(slot.name)
    driver = Driver(slot.name, transport=port.transport, decoder=decoder, clock=slot.clock)
    return MockPair(MockDevice(slot, source, port), driver, calibration or {})


def device_rng(seed: int, name: str) -> np.random.Generator:
    """The same random numbers for the same seed and device, whatever other devices there are."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def at_rate(stream: ReplayStream, rate_hz: float) -> ReplayStream:
    """The stream as a device of another rate shows it: interpolated between its samples."""
    ratio = rate_hz / stream.descriptor.nominal_rate_hz
    index = np.arange(round(len(stream.t_ns) * ratio)) / ratio
    # Behind the last sample the last value stands until the round begins again.
    before = np.minimum(index.astype(np.int64), len(stream.t_ns) - 1)
    after = np.minimum(before + 1, len(stream.t_ns) - 1)
    share = (index - before)[:, None]
    values = (1.0 - share) * stream.values[before] + share * stream.values[after]
    t_ns = stream.t_ns[0] + np.rint(index * (1e9 / stream.descriptor.nominal_rate_hz))
    descriptor = stream.descriptor.model_copy(update={"nominal_rate_hz": rate_hz})
    return ReplayStream(descriptor, t_ns.astype(np.int64), values.astype(stream.values.dtype))


def replay_streams(reader: EpisodeReader) -> list[ReplayStream]:
    """Every stream of a stored episode that a device could have sent."""
    streams = []
    for name, descriptor in reader.streams.items():
        if descriptor.kind not in PLAYED_KINDS or name == "object_poses":
            continue
        data = reader.read(name)
        plain = descriptor.model_copy(update={"unit": "rgb8"})
        played = plain if descriptor.kind == "image" else descriptor
        streams.append(ReplayStream(played, data.t_ref_ns, data.values))
    return streams
