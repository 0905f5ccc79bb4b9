"""Ledger of a mock's packets and their faults, against which counters are tested."""

import json
from array import array
from collections import Counter
from collections.abc import MutableSequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path

from dextouch.errors import UnknownNameError

FORMAT = "dextouch mock ledger 1"
# A column of signed 64-bit numbers: 8 bytes a packet, where a list takes 40.
_numbers = partial(array, "q")


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
