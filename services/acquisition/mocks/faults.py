"""A seeded script of faults: what happens to each packet of a mock device, when, and inside it.

Each family of packets has its own `PacketEdits`. What a family cannot say (a hand, a version)
cannot be said wrongly either: such a fault is refused.
"""

import json
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int64
from pydantic import Field, model_validator

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.tactile.layout import SIDES
from services.acquisition.drivers.base import (
    REPORT_BYTES,
    REPORT_HEADER,
    ReportReassembler,
    split_into_reports,
)
from services.acquisition.drivers.packets import (
    CRC,
    HEADER,
    MAGIC_SIZE,
    SOURCE_NAMES,
    SOURCES,
    VERSION,
    Packet,
    encode_packet,
)

MILLISECOND_NS = 1_000_000
MAX_BOOT_NS = 10**12
OUR_MAGIC = b"DX"
FINGER_MAGIC = b"DXFT"
# Where the numbers of a payload begin, and what they are.
NUMBERS = {
    b"DXTG": (0, "<u2"),
    FINGER_MAGIC: (4, "<f4"),
    b"DXPT": (4, "<f4"),
    b"DXPM": (16, "<f4"),
    b"DXRS": (0, "<f8"),
}

Edit = Callable[[bytes], bytes]
Pinned = Literal["dead", "stuck", "saturated"]
WINDOWS = ("stalls_s", "unplugged_s", "occluded_s", "not_running_s", "jumped_s")
FORMAT = "dextouch mock ledger 1"
DRIFT_SHARE = 0.005
# A column of signed 64-bit numbers: 8 bytes a packet, where a list takes 40.
_numbers = partial(array, "q")


class DeviceFaults(FrozenModel):
    """What disturbs one device; the default is a perfect one.

    docs/device_packets.md lists what each of them does. Times in seconds count from the start of
    the device's first take, those of trackers from the start of every round. `jitter_ms` is the
    mean of an exponential delay on top of the constant `path_delay_ms`. What comes during one of
    `stalls_s` arrives at its end; with `burst_ms` packets arrive together at multiples of it.
    Taxels are raw cells; the zero of drifted ones is `drift_counts` from where it was at the tare
    (our glove only). Noise is per axis.
    """

    skew_ppm: float = Field(default=0.0, ge=-10_000, le=10_000)
    path_delay_ms: float = Field(default=0.0, ge=0, le=1_000)
    jitter_ms: float = Field(default=0.0, ge=0, le=1_000)
    drop_probability: float = Field(default=0.0, ge=0, le=1)
    duplicate_probability: float = Field(default=0.0, ge=0, le=1)
    reorder_probability: float = Field(default=0.0, ge=0, le=1)
    half_packet_probability: float = Field(default=0.0, ge=0, le=1)
    nan_probability: float = Field(default=0.0, ge=0, le=1)
    bit_error_rate: float = Field(default=0.0, ge=0, le=0.01)
    byte_loss_rate: float = Field(default=0.0, ge=0, le=0.01)
    stalls_s: tuple[tuple[float, float], ...] = ()
    burst_ms: float = Field(default=0.0, ge=0, le=1_000)
    position_noise_m: float = Field(default=0.0, ge=0, le=1)
    rotation_noise_rad: float = Field(default=0.0, ge=0, le=1)
    dead_taxels: tuple[int, ...] = ()
    stuck_taxels: tuple[int, ...] = ()
    saturated_taxels: tuple[int, ...] = ()
    drifted_taxels: tuple[int, ...] = ()
    drift_counts: int = Field(default=300, ge=-65_535, le=65_535)
    occluded_s: tuple[tuple[float, float], ...] = ()
    not_running_s: tuple[tuple[float, float], ...] = ()
    jumped_s: tuple[tuple[float, float], ...] = ()
    first_sequence: int = Field(default=0, ge=0, lt=2**32)
    wrong_side_from_s: float | None = None
    version_from_s: float | None = None
    unplugged_s: tuple[tuple[float, float], ...] = ()
    clock_step_at_s: float | None = None
    clock_step_s: float = Field(default=0.0, ge=-0.5, le=10)

    @model_validator(mode="after")
    def _windows_in_order(self) -> "DeviceFaults":
        for name in WINDOWS:
            windows: tuple[tuple[float, float], ...] = getattr(self, name)
            edges = [edge for window in windows for edge in window]
            if any(later <= earlier for earlier, later in pairwise(edges)):
                raise ValueError(f"{name}: got {windows}, expected growing times")
        return self


class FaultScript(FrozenModel):
    """The faults of every device of a station, by device name."""

    devices: Mapping[str, DeviceFaults] = {}
    others: DeviceFaults = DeviceFaults()

    def of(self, device: str) -> DeviceFaults:
        """What disturbs this device."""
        return self.devices.get(device, self.others)

    @staticmethod
    def first_light() -> "FaultScript":
        """What an ordinary station does to its data: the faults of the demo."""
        base = DeviceFaults(skew_ppm=50.0, jitter_ms=0.8, drop_probability=0.002)
        fingers = {"path_delay_ms": 4.0, "position_noise_m": 5e-4}
        changes: dict[str, dict[str, float]] = {
            "glove": {"path_delay_ms": 2.0, "bit_error_rate": 1e-6},
            "finger_tracker": fingers,
            "pose_tracker_wrist": {**fingers, "rotation_noise_rad": float(np.deg2rad(0.05))},
            "camera_wrist": {"path_delay_ms": 30.0},
        }
        devices = {
            f"{kind}_{side}": base.model_copy(update=change)
            for kind, change in changes.items()
            for side in SIDES
        }
        devices["pose_tracker_head"] = devices["pose_tracker_wrist_left"]
        devices["camera_head"] = devices["camera_wrist_left"]
        devices["robot_state"] = base.model_copy(update={"path_delay_ms": 1.0})
        return FaultScript(devices=devices, others=base)

    @staticmethod
    def worn_glove() -> "FaultScript":
        """A left glove with taxels out of order, as raw cells; all else is in order."""
        worn = DeviceFaults(
            dead_taxels=(148, 272, 9),
            stuck_taxels=(225, 235),
            saturated_taxels=(99, 255),
            drifted_taxels=(300, 143),
        )
        return FaultScript(devices={"glove_left": worn})


@dataclass(frozen=True)
class Schedule:
    """What happens to each packet of a device; times count from the start of the take."""

    t_true_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    t_arrival_ns: Int64[np.ndarray, " n"]
    is_dropped: Bool[np.ndarray, " n"]
    is_unplugged: Bool[np.ndarray, " n"]


def boot_time_ns(rng: np.random.Generator) -> int:
    """What a device's clock shows when the take starts."""
    return int(rng.integers(10**9, MAX_BOOT_NS))


def make_schedule(
    t_true_ns: np.ndarray, faults: DeviceFaults, *, boot_ns: int, rng: np.random.Generator
) -> Schedule:
    """When each sample is stamped by the device and when its packet reaches the host."""
    t_true_ns = np.asarray(t_true_ns, dtype=np.int64)
    t_device_ns = (
        boot_ns + t_true_ns + np.rint(t_true_ns * (faults.skew_ppm * 1e-6)).astype(np.int64)
    )
    if faults.clock_step_at_s is not None:
        stepped = t_true_ns >= faults.clock_step_at_s * 1e9
        t_device_ns = t_device_ns + stepped * round(faults.clock_step_s * 1e9)
    delay_ms = faults.path_delay_ms + rng.exponential(1.0, len(t_true_ns)) * faults.jitter_ms
    arrival_ns = t_true_ns + np.rint(delay_ms * MILLISECOND_NS).astype(np.int64)
    for start_s, stop_s in faults.stalls_s:
        stalled = (arrival_ns >= start_s * 1e9) & (arrival_ns < stop_s * 1e9)
        arrival_ns[stalled] = round(stop_s * 1e9)
    if faults.burst_ms:
        burst_ns = round(faults.burst_ms * MILLISECOND_NS)
        arrival_ns = -(-arrival_ns // burst_ns) * burst_ns
    arrival_ns = np.maximum.accumulate(arrival_ns)
    is_unplugged = np.zeros(len(t_true_ns), dtype=np.bool_)
    for start_s, stop_s in faults.unplugged_s:
        is_unplugged |= (arrival_ns >= start_s * 1e9) & (arrival_ns < stop_s * 1e9)
    return Schedule(
        t_true_ns,
        t_device_ns,
        arrival_ns,
        (rng.random(len(t_true_ns)) < faults.drop_probability) & ~is_unplugged,
        is_unplugged,
    )


def flip_bits(data: bytes, rate: float, rng: np.random.Generator) -> tuple[bytes, int]:
    """`data` after a line with this bit error rate, and how many bits it changed."""
    num_flips = int(rng.binomial(8 * len(data), rate)) if rate else 0
    if not num_flips:
        return data, 0
    damaged = bytearray(data)
    for bit in rng.choice(8 * len(data), num_flips, replace=False):
        damaged[bit // 8] ^= 1 << (bit % 8)
    return bytes(damaged), num_flips


def lose_bytes(data: bytes, rate: float, rng: np.random.Generator) -> tuple[bytes, int]:
    """`data` after a line that loses bytes at this rate, and how many it lost."""
    num_lost = int(rng.binomial(len(data), rate)) if rate else 0
    if not num_lost:
        return data, 0
    rest = np.delete(np.frombuffer(data, np.uint8), rng.choice(len(data), num_lost, replace=False))
    return rest.tobytes(), num_lost


@dataclass
class PacketFields:
    """What faults change inside a packet; None where the packets of a family do not tell it."""

    numbers: np.ndarray | None = None
    side: str | None = None
    version: int | None = None


class PacketEdits(ABC):
    """Faults inside one packet, by what its family takes it apart to and packs again.

    The last four methods take the bytes of one whole packet and give those of the changed one, its
    checksum right; they raise InvalidInputError for what packets of the family do not tell.
    `pinned` is what a pinned raw cell of a glove shows.
    """

    marks_nan = False

    def __init__(self, pinned: Mapping[Pinned, float] | None = None) -> None:
        self._pinned: Mapping[Pinned, float] = {"dead": 0.0, **pinned} if pinned else {}

    @abstractmethod
    def fields(self, data: bytes) -> PacketFields:
        """What a packet tells; its numbers may be changed."""

    @abstractmethod
    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet with other fields."""

    def apply(self, units: Sequence[bytes], edits: Sequence[Edit]) -> list[bytes]:
        """The units that a port sends for one packet, after edits of the packet."""
        # Behind a glove's packet may stand the reply to a command.
        return [_edited(units[0], edits), *units[1:]] if edits else list(units)

    def is_marked_when_nan(self, units: Sequence[bytes]) -> bool:
        """Whether a driver records a NaN as a missing part of a sample, and refuses no packet."""
        return self.marks_nan

    def pins(self, how: Pinned) -> bool:
        """Whether raw cells can be pinned so."""
        return how in self._pinned

    def pin(self, data: bytes, cells: Sequence[int], how: Pinned) -> bytes:
        """Raw cells of a glove that show the same whatever presses them."""
        fields = self.fields(data)
        if fields.numbers is None or not self.pins(how):
            raise _cannot("a taxel that is pinned")
        fields.numbers[list(cells)] = self._pinned[how]
        return self.packed(data, fields)

    def move_zero(self, data: bytes) -> bytes:
        """A glove whose zero has moved, by 0.5 % of full scale."""
        fields = self.fields(data)
        if fields.numbers is None or not self.pins("saturated"):
            raise _cannot("readings of a glove")
        full_scale = self._pinned["saturated"]
        fields.numbers[:] = np.minimum(fields.numbers + DRIFT_SHARE * full_scale, full_scale)
        return self.packed(data, fields)

    def put_nan(self, data: bytes) -> bytes:
        """The first number that is one is none."""
        fields = self.fields(data)
        numbers = fields.numbers
        if numbers is None or numbers.dtype.kind != "f":
            raise _cannot("a number that can be NaN")
        numbers[np.flatnonzero(np.isfinite(numbers))[0]] = np.nan
        return self.packed(data, fields)

    def other_side(self, data: bytes) -> bytes:
        """The packet of the other hand's device."""
        fields = self.fields(data)
        if fields.side is None:
            raise _cannot("a hand")
        fields.side = "right" if fields.side == "left" else "left"
        return self.packed(data, fields)

    def other_version(self, data: bytes) -> bytes:
        """The packet of a device with newer firmware."""
        fields = self.fields(data)
        if fields.version is None:
            raise _cannot("a version")
        fields.version += 1
        return self.packed(data, fields)


class OurPacketEdits(PacketEdits):
    """Faults inside the packets of our documented devices (docs/device_packets.md)."""

    def fields(self, data: bytes) -> PacketFields:
        """Version, source, and the numbers of those payloads that hold some."""
        magic = data[:MAGIC_SIZE]
        if not magic.startswith(OUR_MAGIC):
            raise InvalidInputError(
                f"mock fault: got a packet that begins with {magic!r}, expected one of ours; give "
                "its source PacketEdits of its family"
            )
        _, version, source, *_ = HEADER.unpack_from(data)
        numbers = None
        if magic in NUMBERS:
            start, dtype = NUMBERS[magic]
            numbers = np.frombuffer(data[HEADER.size + start : -CRC.size], dtype).copy()
        return PacketFields(numbers, SOURCE_NAMES[source], version)

    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet with other fields; its numbers stand at the end of the payload."""
        magic, _, _, _, sequence, t_device_ns = HEADER.unpack_from(data)
        payload = data[HEADER.size : -CRC.size]
        if fields.numbers is not None:
            payload = payload[: -fields.numbers.nbytes] + fields.numbers.tobytes()
        source, version = SOURCES[fields.side or "none"], fields.version or VERSION
        return encode_packet(magic, Packet(version, source, sequence, t_device_ns, payload))

    def apply(self, units: Sequence[bytes], edits: Sequence[Edit]) -> list[bytes]:
        """Joins the reports of a packet for the edits, and splits it again.

        Raises:
            InvalidInputError: reports that are no whole packet.
        """
        if not edits or not _is_report(units[0]):
            return super().apply(units, edits)
        reports = ReportReassembler()
        messages = [m for m in map(reports.feed, units) if m is not None]
        if len(messages) != 1:
            raise InvalidInputError(
                f"mock fault: got {len(units)} reports, expected one whole packet"
            )
        report_id, data = messages[0]
        counter = REPORT_HEADER.unpack_from(units[0])[1]
        return split_into_reports(report_id, counter, _edited(data, edits))

    def is_marked_when_nan(self, units: Sequence[bytes]) -> bool:
        """Finger trackers alone say of single nodes that they are not seen."""
        start = REPORT_HEADER.size if _is_report(units[0]) else 0
        return units[0].startswith(FINGER_MAGIC, start)


def halve_units(units: Sequence[bytes]) -> list[bytes]:
    """The first half of a packet's bytes, or of its reports."""
    if len(units) > 1:
        return list(units[: len(units) // 2])
    whole = units[0]
    return [whole[: len(whole) // 2]]


def _cannot(what: str) -> InvalidInputError:
    return InvalidInputError(
        f"mock fault: packets of this family do not tell {what}; leave the fault out of the script"
    )


def _is_report(unit: bytes) -> bool:
    return len(unit) == REPORT_BYTES and not unit.startswith(OUR_MAGIC)


def _edited(data: bytes, edits: Sequence[Edit]) -> bytes:
    for edit in edits:
        data = edit(data)
    return data


class Fate(StrEnum):
    """What became of one packet.

    `sent` arrived whole and in order, `repeated` also a second time, `late` behind its successor;
    of a `half` one the rest never came; a `refused` one arrived whole with something in it that a
    driver must not take (version, side, NaN); of a `marked` one a part is missing and must be
    marked in the sample (nodes not seen, cells that are no numbers). In an `occluded` one the
    tracker says that it does not track, in a `jumped` one it is elsewhere and does not say so.
    """

    SENT = "sent"
    REPEATED = "repeated"
    LATE = "late"
    HALF = "half"
    REFUSED = "refused"
    MARKED = "marked"
    OCCLUDED = "occluded"
    JUMPED = "jumped"
    DROPPED = "dropped"
    CORRUPTED = "corrupted"
    UNPLUGGED = "unplugged"
    OVERRUN = "overrun"


# What must become a sample.
ACCEPTED = (Fate.SENT, Fate.REPEATED, Fate.MARKED)


@dataclass
class DeviceLedger:
    """One device's packets, column by column; times on the host's clock except `t_device_ns`.

    `script` names the faults that the device was given and their settings: what no single packet
    shows (skew, noise, pinned taxels) is told there.
    """

    path_delay_ns: int = 0
    script: dict[str, object] = field(default_factory=dict)
    sequence: MutableSequence[int] = field(default_factory=_numbers)
    t_true_ns: MutableSequence[int] = field(default_factory=_numbers)
    t_device_ns: MutableSequence[int] = field(default_factory=_numbers)
    t_arrival_ns: MutableSequence[int] = field(default_factory=_numbers)
    fate: list[str] = field(default_factory=list)
    flipped_bits: MutableSequence[int] = field(default_factory=_numbers)

    def note(self, sequence: int, times_ns: tuple[int, int, int], fate: Fate, flips: int) -> None:
        """Add a packet with its true, device and arrival times."""
        self.sequence.append(sequence)
        self.t_true_ns.append(times_ns[0])
        self.t_device_ns.append(times_ns[1])
        self.t_arrival_ns.append(times_ns[2])
        self.fate.append(fate.value)
        self.flipped_bits.append(flips)

    def count(self, fate: Fate) -> int:
        """How many packets met this fate."""
        return Counter(self.fate)[fate.value]

    def count_lost_between(self) -> int:
        """Packets lost between the first and the last that arrived whole: what sequences show."""
        whole = [index for index, fate in enumerate(self.fate) if fate in ACCEPTED]
        return whole[-1] - whole[0] + 1 - len(whole) if whole else 0


@dataclass
class Ledger:
    """Everything the mocks of one take did."""

    seed: int
    start_host_ns: int
    devices: dict[str, DeviceLedger] = field(default_factory=dict)

    def of(self, device: str) -> DeviceLedger:
        """One device's packets.

        Raises:
            UnknownNameError: no such device took part.
        """
        if device not in self.devices:
            raise UnknownNameError("device", device, list(self.devices))
        return self.devices[device]

    def save(self, path: Path) -> None:
        """Write it as JSON, device by device: the text of a take is many times its columns."""
        with path.open("w", encoding="utf-8") as file:
            head = {"format": FORMAT, "seed": self.seed, "start_host_ns": self.start_host_ns}
            file.write(f'{json.dumps(head)[:-1]}, "devices": {{')
            for index, (name, device) in enumerate(self.devices.items()):
                text = json.dumps(vars(device), default=list)
                file.write(f"{', ' if index else ''}{json.dumps(name)}: {text}")
            file.write("}}")
