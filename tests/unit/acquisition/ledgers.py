"""What tests read in the ledgers of mock devices."""

import json
from array import array

import numpy as np

from services.acquisition.mocks.faults import ACCEPTED, FORMAT, DeviceLedger, Ledger

NUMBERS = ("sequence", "t_true_ns", "t_device_ns", "t_arrival_ns", "flipped_bits")


def accepted(ledger):
    """Sequence numbers of the packets that must become samples, in order."""
    return [s for s, fate in zip(ledger.sequence, ledger.fate, strict=True) if fate in ACCEPTED]


def true_times_ns(ledger, sequences):
    """True host time of the samples with these sequence numbers."""
    times = dict(zip(ledger.sequence, ledger.t_true_ns, strict=True))
    return np.array([times[s] for s in sequences.tolist()], dtype=np.int64)


def load(path):
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content.pop("format") == FORMAT
    devices = {name: DeviceLedger(**columns) for name, columns in content["devices"].items()}
    for device in devices.values():
        for name in NUMBERS:
            setattr(device, name, array("q", getattr(device, name)))
    return Ledger(content["seed"], content["start_host_ns"], devices)
