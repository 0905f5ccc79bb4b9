import binascii
import struct

import numpy as np
import pytest

from dextouch.errors import DeviceError
from services.acquisition.devices.justfloat_glove import (
    TAIL,
    JustFloatGloveDecoder,
    are_readings,
    bits_of,
)
from services.acquisition.devices.wuji_glove import WujiGloveDecoder, are_pressures, crc16
from services.acquisition.mocks.gloves import encode_justfloat, encode_wuji


def cells(rng):
    values = rng.random(768, dtype=np.float32)
    values[::5] = np.nan
    return values.tobytes()


def wuji(sequence, time_ms, rng, *, hand=0):
    return encode_wuji(hand, sequence, time_ms, cells(rng))


def test_wuji_packet_is_as_published(rng):
    packet = wuji(0x0102, 0x03040506, rng)
    assert len(packet) == 3088
    assert packet[:8] == bytes.fromhex("aa55 100c 00 000000")
    assert struct.unpack_from("<HI", packet, 3080) == (0x0102, 0x03040506)
    assert struct.unpack_from("<H", packet, 3086)[0] == slow_crc16(packet[2:3086])


def slow_crc16(data):
    """The definition, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def test_crc16_is_the_one_of_the_catalogues():
    assert crc16(b"123456789") == 0x29B1


@pytest.mark.parametrize("seed", range(3))
def test_crc16_is_the_plain_one_at_every_length(seed):
    data = np.random.default_rng(seed).bytes(3088)
    for length in range(len(data) + 1):
        assert crc16(data[:length]) == binascii.crc_hqx(data[:length], 0xFFFF), length


def test_wuji_samples_carry_what_the_device_says(rng):
    decoder = WujiGloveDecoder("left")
    sent = cells(rng)
    (sample,) = decoder.feed(encode_wuji(0, 65_537, 2**32 + 7, sent), 9)
    assert (sample.t_host_ns, sample.t_device_ns, sample.sequence) == (9, 7_000_000, 1)
    assert sample.values.tobytes() == sent
    (descriptor,) = decoder.descriptors
    assert descriptor.capabilities.sequence_bits == 16
    assert descriptor.capabilities.tick_ns == 1_000_000
    assert descriptor.capabilities.device_time_bits == 32
    assert descriptor.numpy_dtype() == sample.values.dtype


def test_wuji_counters_wrap_and_restart(rng):
    decoder = WujiGloveDecoder("left")
    stamps = [(65_535, 2**32 - 4), (0, 4), (3, 28), (3, 28), (0, 5), (1, 13)]
    for sequence, time_ms in stamps:
        decoder.feed(wuji(sequence, time_ms, rng))
    statistics = decoder.statistics
    assert (statistics.packets, statistics.lost) == (6, 2)
    assert (statistics.repeated, statistics.restarts) == (1, 1)


def test_an_overtaken_wuji_packet_is_late_though_its_clock_steps_back(rng):
    decoder = WujiGloveDecoder("left")
    for sequence in (5, 7, 6, 8):
        decoder.feed(wuji(sequence, 8 * sequence, rng))
    statistics = decoder.statistics
    assert (statistics.packets, statistics.late) == (4, 1)
    assert (statistics.lost, statistics.restarts) == (0, 0)


@pytest.mark.parametrize(("hand", "words"), [(1, "'right'"), (7, "hand 7")])
def test_wrong_hand_is_named(rng, hand, words):
    with pytest.raises(DeviceError, match=words):
        WujiGloveDecoder("left").feed(wuji(0, 0, rng, hand=hand))


@pytest.mark.parametrize("number", [1.0000001, -1e-9, np.inf, -np.inf, 3e38])
def test_what_is_no_pressure_is_held_back(rng, number):
    values = np.frombuffer(cells(rng), "<f4").copy()
    values[700] = number
    decoder = WujiGloveDecoder("left")
    assert decoder.feed(encode_wuji(0, 0, 0, values.tobytes())) == []
    assert (decoder.statistics.suspects, decoder.statistics.packets) == (1, 0)


@pytest.mark.parametrize(
    "pattern", [0x7FC00000, 0x7F800001, 0xFFC00000, 0xFF800001, 0, 0x80000000, 0x3F800000]
)
def test_every_nan_and_the_ends_are_fine(pattern):
    assert are_pressures(np.full(768, pattern, np.uint32).view(np.float32))


def test_are_pressures_is_the_plain_check():
    rng = np.random.default_rng(5)
    patterns = rng.integers(0, 2**32, 200_000, dtype=np.uint32)
    for pattern in patterns[:3000]:
        value = np.full(2, pattern, np.uint32).view(np.float32)
        plain = bool(np.isnan(value[0]) or (0 <= value[0] <= 1))
        assert are_pressures(value) == plain, hex(pattern)


def justfloat(values):
    return JustFloatGloveDecoder("left", num_values=values, full_scale=4095.0, rate_hz=60.0)


def counts(rng, values=401):
    return rng.integers(0, 4096, values).astype("<f4")


def test_justfloat_says_what_it_cannot(rng):
    decoder = justfloat(401)
    sent = [counts(rng) for _ in range(3)]
    samples = decoder.feed(b"".join(map(encode_justfloat, sent)), 4)
    # Nothing says where the first packet began.
    assert [s.values.tobytes() for s in samples] == [v.tobytes() for v in sent[1:]]
    assert {(s.t_host_ns, s.t_device_ns, s.sequence) for s in samples} == {(4, -1, -1)}
    (descriptor,) = decoder.descriptors
    abilities = descriptor.capabilities
    assert (abilities.crc, abilities.sequence, abilities.device_time) == (False,) * 3


@pytest.mark.parametrize("number", [-1.0, 4095.5, np.nan, np.inf, 1e-40])
def test_numbers_that_are_no_readings_are_suspect(rng, number):
    packets = [encode_justfloat(counts(rng)) for _ in range(4)]
    values = counts(rng)
    values[200] = number
    decoder = justfloat(401)
    samples = decoder.feed(b"".join([*packets[:2], encode_justfloat(values), *packets[2:]]))
    assert [encode_justfloat(s.values) for s in samples] == packets[1:]
    assert decoder.statistics.suspects == 1


def test_tails_inside_the_data_mislead_nobody(rng):
    """A resting glove whose bytes hold a tail between two numbers, cut in the middle of it."""
    values = np.zeros(401, "<f4")
    values[100] = np.array([0x40007F80], np.uint32).view(np.float32)[0]
    packet = encode_justfloat(values)
    assert packet.count(TAIL) == 2
    decoder = justfloat(401)
    samples = decoder.feed(packet[7:] + packet * 6)
    assert len(samples) == 6
    assert all(s.values.tobytes() == values.tobytes() for s in samples)
    rest = decoder.feed(packet[:399] + packet[405:] + packet * 4)
    assert all(s.values.tobytes() == values.tobytes() for s in rest)
    assert len(rest) >= 3


def test_damaged_tail_costs_its_packet_alone(rng):
    sent = [encode_justfloat(counts(rng)) for _ in range(6)]
    spoiled = sent[2][:-1] + b"\x7e"
    decoder = justfloat(401)
    samples = decoder.feed(b"".join([*sent[:2], spoiled, *sent[3:]]))
    assert [encode_justfloat(s.values) for s in samples] == [sent[1], *sent[3:]]
    assert decoder.statistics.length_errors == 1


def test_another_version_is_named(rng):
    decoder = justfloat(401)
    data = b"".join(encode_justfloat(counts(rng, 415)) for _ in range(8))
    with pytest.raises(DeviceError, match="415 numbers, expected 401"):
        decoder.feed(data)


def test_readings_are_the_plain_check():
    patterns = np.random.default_rng(6).integers(0, 2**32, 3000, dtype=np.uint32)
    edges = np.array([0, 1, 0x7FFFFF, 0x800000, 0x457FF000, 0x457FF001, 0x80000000], np.uint32)
    for pattern in np.concatenate([patterns, edges]):
        value = np.full(2, pattern, np.uint32).view(np.float32)
        smallest = np.finfo(np.float32).tiny
        plain = pattern == 0 or bool(smallest <= value[0] <= np.float32(4095.0))
        assert are_readings(value, bits_of(4095.0)) == plain, hex(pattern)
