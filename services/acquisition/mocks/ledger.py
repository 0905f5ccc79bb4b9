"""Ledger of a mock's packets and their faults, against which counters are tested."""

import json
from array import array
from collections import Counter
from collections.abc import Iterator, MutableSequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from dextouch.errors import CorruptDataError, UnknownNameError

FORMAT = "dextouch mock ledger 1"


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


ACCEPTED = (Fate.SENT, Fate.REPEATED, Fate.MARKED)
# Numbers that are text at the same time while a ledger is saved.
PIECE = 512
NUMBERS = ("sequence", "t_true_ns", "t_device_ns", "t_arrival_ns", "flipped_bits")


def _whole_numbers() -> MutableSequence[int]:
    """A column of signed 64-bit numbers: 8 bytes a packet, where a list takes 40."""
    return array("q")


@dataclass
class DeviceLedger:
    """One device's packets, column by column; times on the host's clock except `t_device_ns`.

    `script` names the faults that the device was given and their settings: what no single packet
    shows (skew, noise, pinned taxels) is told there.
    """

    path_delay_ns: int = 0
    script: dict[str, object] = field(default_factory=dict)
    sequence: MutableSequence[int] = field(default_factory=_whole_numbers)
    t_true_ns: MutableSequence[int] = field(default_factory=_whole_numbers)
    t_device_ns: MutableSequence[int] = field(default_factory=_whole_numbers)
    t_arrival_ns: MutableSequence[int] = field(default_factory=_whole_numbers)
    fate: list[str] = field(default_factory=list)
    flipped_bits: MutableSequence[int] = field(default_factory=_whole_numbers)

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

    def accepted(self) -> list[int]:
        """Sequence numbers of the packets that must become samples, in order."""
        return [s for s, fate in zip(self.sequence, self.fate, strict=True) if fate in ACCEPTED]

    def count_lost_between(self) -> int:
        """Packets lost between the first and the last that arrived whole: what sequences show."""
        whole = [index for index, fate in enumerate(self.fate) if fate in ACCEPTED]
        return whole[-1] - whole[0] + 1 - len(whole) if whole else 0

    def true_times_ns(self, sequences: np.ndarray) -> Int64[np.ndarray, " n"]:
        """True host time of the samples with these sequence numbers."""
        times = dict(zip(self.sequence, self.t_true_ns, strict=True))
        return np.array([times[int(sequence)] for sequence in sequences], dtype=np.int64)


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
        """Write it as JSON, piece by piece: the text of a long take is many times its columns."""
        with path.open("w", encoding="utf-8") as file:
            file.writelines(self._json())

    def _json(self) -> Iterator[str]:
        head = {"format": FORMAT, "seed": self.seed, "start_host_ns": self.start_host_ns}
        yield json.dumps(head)[:-1] + ', "devices": {'
        for number, (name, device) in enumerate(self.devices.items()):
            yield f"{', ' if number else ''}{json.dumps(name)}: {{"
            for index, column in enumerate(fields(device)):
                yield f"{', ' if index else ''}{json.dumps(column.name)}: "
                yield from _json_pieces(getattr(device, column.name))
            yield "}"
        yield "}}"

    @staticmethod
    def load(path: Path) -> "Ledger":
        """Read what `save` wrote.

        Raises:
            CorruptDataError: not such a file.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("format") != FORMAT:
                raise CorruptDataError(f"{path}: not a {FORMAT!r}")
            devices = {
                name: DeviceLedger(**columns) for name, columns in content["devices"].items()
            }
            for device in devices.values():
                for name in NUMBERS:
                    setattr(device, name, array("q", getattr(device, name)))
            return Ledger(content["seed"], content["start_host_ns"], devices)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise CorruptDataError(f"{path}: not a {FORMAT!r} ({error})") from error


def _json_pieces(value: object) -> Iterator[str]:
    if not isinstance(value, array):
        yield json.dumps(value)
        return
    yield "["
    for start in range(0, len(value), PIECE):
        rows = json.dumps(value[start : start + PIECE].tolist())
        yield f"{', ' if start else ''}{rows[1:-1]}"
    yield "]"
