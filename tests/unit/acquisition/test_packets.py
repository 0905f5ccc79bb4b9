import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import DeviceError
from services.acquisition.devices.tactile_glove import (
    MAGIC,
    PAYLOAD_BYTES,
    TactileGloveDecoder,
)
from services.acquisition.drivers.packets import (
    SOURCES,
    DecoderStatistics,
    Packet,
    PacketDecoder,
    SequenceCounter,
    encode_packet,
)


def glove_packet(sequence, rng, *, version=1, source=SOURCES["left"], boot_ns=10**9):
    counts = rng.integers(0, 65536, 360, dtype=np.uint16)
    payload = counts.astype("<u2").tobytes()
    return encode_packet(MAGIC, Packet(version, source, sequence, boot_ns + sequence, payload))


def flip_bits(data, rate, rng):
    damaged = np.frombuffer(data, np.uint8).copy()
    flips = rng.choice(8 * len(data), rng.binomial(8 * len(data), rate), replace=False)
    np.bitwise_xor.at(damaged, flips // 8, (1 << flips % 8).astype(np.uint8))
    return damaged.tobytes()


def decode(data, sizes):
    decoder = TactileGloveDecoder("left")
    found = []
    position = 0
    while position < len(data):
        size = sizes[len(found) % len(sizes)] if sizes else len(data)
        found.extend(decoder.feed(data[position : position + size]))
        position += size
    return [(s.sequence, s.t_device_ns, s.values.tobytes()) for s in found], decoder.statistics


def test_header_is_as_documented(rng):
    packet = glove_packet(7, rng)
    assert len(packet) == 746
    assert packet[:4] == b"DXTG"
    assert struct.unpack_from("<BBIIQ", packet, 4) == (1, 1, 720, 7, 10**9 + 7)


def test_samples_carry_counts_and_stamps(rng):
    decoder = TactileGloveDecoder()
    data = glove_packet(3, rng)
    (sample,) = decoder.feed(data, 55)
    assert sample.t_host_ns == 55
    assert sample.t_device_ns == 10**9 + 3
    assert sample.sequence == 3
    assert sample.values.dtype == np.uint16
    assert sample.values.tobytes() == data[22:742]


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.lists(st.integers(1, 2000), min_size=1, max_size=30),
    rate=st.sampled_from([0.0, 1e-5, 1e-4, 1e-3]),
)
def test_portions_do_not_matter(seed, sizes, rate):
    rng = np.random.default_rng(seed)
    data = b"".join(glove_packet(i, rng) for i in range(6)) + rng.bytes(3)
    data = flip_bits(data, rate, rng)
    assert decode(data, sizes) == decode(data, [])


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=3000))
def test_no_bytes_break_it(data):
    decoder = TactileGloveDecoder("left")
    decoder.feed(b"DXTG" + data)
    assert decoder.statistics.packets == 0


def test_no_wrong_packet_under_bit_errors(rng):
    sent = [glove_packet(i, rng) for i in range(4000)]
    received = [flip_bits(packet, 1e-5, rng) for packet in sent]
    intact = [i for i, (a, b) in enumerate(zip(sent, received, strict=True)) if a == b]
    assert len(intact) < len(sent)
    samples, statistics = decode(b"".join(received), [512])
    assert [s[0] for s in samples] == intact
    assert all(values == sent[i][22:742] for i, _, values in samples)
    assert statistics.lost == intact[-1] - intact[0] + 1 - len(intact)
    assert statistics.packets == len(intact)
    assert 0 < statistics.crc_errors + statistics.length_errors <= len(sent) - len(intact)


def test_lost_bytes_cost_one_packet(rng):
    packets = [glove_packet(i, rng) for i in range(5)]
    packets[2] = packets[2][:100] + packets[2][101:]
    samples, statistics = decode(b"".join(packets), [])
    assert [s[0] for s in samples] == [0, 1, 3, 4]
    assert statistics.lost == 1
    assert statistics.resync_bytes == 745


def test_sequence_wraps_and_restarts(rng):
    sequences = [2**32 - 2, 2**32 - 1, 0, 2, 2]
    packets = [glove_packet(s, rng) for s in sequences] + [glove_packet(0, rng, boot_ns=0)]
    samples, statistics = decode(b"".join(packets), [])
    assert [sample[0] for sample in samples] == [2**32 - 2, 2**32 - 1, 0, 2, 0]
    assert statistics == DecoderStatistics(packets=6, lost=1, repeated=1, restarts=1)


@pytest.mark.parametrize(
    ("sequences", "expected"),
    [
        ([0, 2, 1, 3], {"late": 1}),
        ([0, 3, 2, 1, 4], {"late": 2}),
        ([0, 3, 1, 4], {"late": 1, "lost": 1}),
        # The very first one may be overtaken, too; nobody missed it.
        ([1, 0, 2], {"late": 1}),
        ([2**32 - 1, 1, 0, 2], {"late": 1}),
        # What came already, or is missing too long, is no late packet.
        ([5, 6, 7, 5, 6], {"restarts": 1}),
        ([0, 2, *range(3, 67), 1, 2], {"lost": 1, "restarts": 1}),
        ([100, 7, 6, 8], {"restarts": 1, "late": 1}),
        ([0, 1000, 936, 1001], {"lost": 998, "late": 1}),
        ([0, 1000, 935, 936], {"lost": 999, "restarts": 1}),
    ],
)
def test_a_packet_that_was_overtaken_is_late_and_no_loss(sequences, expected):
    statistics = DecoderStatistics()
    counter = SequenceCounter(statistics, bits=32)
    for sequence in sequences:
        counter.count(sequence)
    assert statistics == DecoderStatistics(packets=len(sequences), **expected)


@pytest.mark.parametrize(
    ("packets", "expected"),
    [
        # Once more behind a newer one, which a number alone does not tell from a restart.
        ([(5, 50), (6, 60), (5, 50), (7, 70)], {"repeated": 1}),
        ([(5, 50), (6, 60), (5, 3), (6, 13)], {"restarts": 1}),
        ([(5, 50), (5, 60), (6, 70)], {"restarts": 1}),
        ([(5, 50), (5, 60), (5, 70), (5, 80), (5, 90)], {"restarts": 1}),
        ([(5, 50), (7, 70), (6, 60), (6, 60), (8, 80)], {"late": 1, "repeated": 1}),
    ],
)
def test_the_devices_time_tells_a_repeated_packet_from_a_restart(packets, expected):
    statistics = DecoderStatistics()
    counter = SequenceCounter(statistics, bits=32)
    for sequence, t_device_ns in packets:
        counter.count(sequence, t_device_ns=t_device_ns)
    assert statistics == DecoderStatistics(packets=len(packets), **expected)


@pytest.mark.parametrize("first_run", [range(40, 60), range(30, 35), range(60, 63), range(5, 6)])
@pytest.mark.parametrize("is_link_lost", [False, True])
def test_a_restarted_device_loses_none_of_its_packets(first_run, is_link_lost):
    """Its numbers are among those before the first run, its clock is not."""
    decoder = PacketDecoder(b"TEST", min_payload=1, max_payload=1)
    period_ns, run_ns = 10_000_000, 10**12

    def packet(number, t_device_ns):
        return encode_packet(b"TEST", Packet(1, 0, number, t_device_ns, b"x"))

    for number in first_run:
        assert decoder.feed(packet(number, run_ns + number * period_ns))
    if is_link_lost:
        decoder.reset()
    kept = [decoder.feed(packet(number, number * period_ns)) for number in range(100)]
    assert [len(found) for found in kept] == [1] * 100
    statistics = decoder.statistics
    assert (statistics.restarts, statistics.late, statistics.lost) == (1, 0, 0)


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    start=st.sampled_from([0, 40, 2**16 - 100]),
    is_told_by_clock=st.booleans(),
)
def test_reordering_and_loss_are_told_apart(seed, start, is_told_by_clock):
    """Packets up to 20 places late: lost, late and packets are those of the sender."""
    rng = np.random.default_rng(seed)
    kept = np.flatnonzero(rng.random(300) > 0.1)
    delays = np.where(rng.random(len(kept)) < 0.1, rng.integers(1, 20, len(kept)) + 0.5, 0)
    order = kept[np.argsort(kept + delays, kind="stable")].tolist()
    statistics = DecoderStatistics()
    counter = SequenceCounter(statistics, bits=16)
    newest = -1
    for number in order:
        is_back = number < newest
        counter.count((start + number) % 2**16, is_restarted=is_back and is_told_by_clock)
        newest = max(newest, number)
    num_from_first = sum(number >= order[0] for number in order)
    lost = max(order) - order[0] + 1 - num_from_first
    late = sum(number < max(order[:index], default=-1) for index, number in enumerate(order))
    assert statistics == DecoderStatistics(packets=len(kept), lost=lost, late=late)


def test_magic_inside_the_payload_is_payload():
    payload = (MAGIC * PAYLOAD_BYTES)[:PAYLOAD_BYTES]
    data = b"".join(encode_packet(MAGIC, Packet(1, 1, number, 0, payload)) for number in range(3))
    samples, statistics = decode(data, [5])
    assert len(samples) == 3
    assert statistics.resync_bytes == 0


def test_a_stamp_that_no_batch_can_hold_is_held_back(rng):
    decoder = TactileGloveDecoder("left")
    data = b"".join(
        glove_packet(n, rng, boot_ns=b) for n, b in ((1, 5), (2, 2**63), (3, 2**63 - 4))
    )
    assert [sample.t_device_ns for sample in decoder.feed(data)] == [6, 2**63 - 1]
    assert (decoder.statistics.suspects, decoder.statistics.lost) == (1, 1)


@pytest.mark.parametrize(("version", "source", "words"), [(2, 1, "version 2"), (1, 2, "'right'")])
def test_foreign_glove_is_refused(rng, version, source, words):
    data = glove_packet(0, rng, version=version, source=source)
    with pytest.raises(DeviceError, match=words):
        TactileGloveDecoder("left").feed(data)


def test_reset_forgets_half_a_packet(rng):
    decoder = PacketDecoder(MAGIC, min_payload=720, max_payload=720)
    packet = glove_packet(0, rng)
    decoder.feed(packet[:300])
    decoder.reset()
    assert len(decoder.feed(packet)) == 1
    assert decoder.statistics.resync_bytes == 300
