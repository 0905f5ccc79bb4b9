"""Damaged, cut and foreign bytes: trackers' decoders give what was sent or nothing, never more."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import DeviceError
from services.acquisition.devices.finger_tracker import (
    BridgeFingerTrackerDecoder,
    FingerTrackerDecoder,
)
from services.acquisition.devices.pose_tracker import (
    BridgePoseTrackerDecoder,
    PoseTrackerDecoder,
)
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.trackers_and_cameras import (
    BridgeFingerTrackerSource,
    BridgePoseSource,
    FingerTrackerSource,
    PoseTrackerSource,
)

NUM_SENT = 6
STREAMS = {stream.descriptor.name: stream for stream in pattern_streams(1.0)}
PERFECT = DeviceFaults()


def rng():
    return np.random.default_rng(1)


def finger_reports():
    source = FingerTrackerSource(STREAMS["keypoints_left"], side="left", rng=rng())
    return FingerTrackerDecoder("left"), source.answer(b"\x02"), source


def pose_reports():
    source = PoseTrackerSource(STREAMS["wrist_left"], faults=PERFECT, rng=rng())
    return PoseTrackerDecoder("wrist_left"), [], source


def finger_bridge():
    source = BridgeFingerTrackerSource(STREAMS["keypoints_left"], side="left", rng=rng())
    return BridgeFingerTrackerDecoder("left"), [source.hello], source


def pose_bridge():
    source = BridgePoseSource(STREAMS["wrist_left"], faults=PERFECT, rng=rng())
    return BridgePoseTrackerDecoder("wrist_left"), [source.hello], source


MAKERS = (finger_reports, pose_reports, finger_bridge, pose_bridge)


def sent_units(source):
    return [
        unit
        for index in range(NUM_SENT)
        for unit in source.units(index, index, 10**12 + int(source.t_ns[index]))
    ]


def samples_of(decoder, units):
    found = []
    for number, unit in enumerate(units):
        for samples in decoder.decode(unit, 10**9 + number).values():
            found += [(s.sequence, s.values.tobytes()) for s in samples]
    return found


@cache
def undamaged(make):
    """Greeting, packets and the samples they make."""
    decoder, greeting, source = make()
    samples_of(decoder, greeting)
    units = sent_units(source)
    truth = dict(samples_of(decoder, units))
    assert sorted(truth) == list(range(NUM_SENT))
    return greeting, units, truth


@pytest.mark.long
@pytest.mark.parametrize("make", MAKERS)
@settings(max_examples=50)
@given(
    flips=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 511)), max_size=12),
    lost=st.sets(st.integers(0, 40), max_size=3),
    cut=st.integers(0, 63),
)
def test_what_comes_out_was_sent(make, flips, lost, cut):
    greeting, units, truth = undamaged(make)
    damaged = [bytearray(unit) for number, unit in enumerate(units) if number not in lost]
    for where, bit in flips:
        unit = damaged[where % len(damaged)]
        unit[bit // 8 % len(unit)] ^= 1 << bit % 8
    damaged[-1] = damaged[-1][: len(damaged[-1]) - cut]
    decoder, _, _ = make()
    samples_of(decoder, greeting)
    found = samples_of(decoder, map(bytes, damaged))
    assert all(truth[sequence] == values for sequence, values in found)
    sequences = [sequence for sequence, _ in found]
    assert sequences == sorted(set(sequences))


@pytest.mark.long
@pytest.mark.parametrize("make", MAKERS)
@given(st.lists(st.binary(max_size=80), max_size=20))
def test_foreign_bytes_give_nothing(make, units):
    decoder, greeting, _ = make()
    samples_of(decoder, greeting)
    try:
        assert samples_of(decoder, units) == []
    except DeviceError:  # a device that speaks another protocol may be refused
        assert decoder.statistics.packets
