"""Decoders of all glove families against damaged, cut and foreign bytes."""

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import DeviceError
from tests.fuzz.glove_families import FAMILIES, content

NAMES = sorted(FAMILIES)


def stream(family, seed, count):
    rng = np.random.default_rng(seed)
    made = [family.make(index, rng) for index in range(count)]
    return [packet for packet, _ in made], [values for _, values in made]


def run(family, data, sizes):
    """All that a decoder says to `data` cut into portions of these sizes, going round."""
    decoder = family.decoder()
    found, position, turn = [], 0, 0
    while position < len(data):
        size = sizes[turn % len(sizes)]
        turn += 1
        try:
            found += [content(item) for item in decoder.feed(data[position : position + size])]
        except DeviceError as error:
            return found, None, error.message
        position += size
    return found, asdict(decoder.statistics), None


def damage(data, edits):
    """Flip, drop, repeat or insert bytes at the given places."""
    damaged = bytearray(data)
    for place, kind, byte in edits:
        at = place % max(1, len(damaged))
        if kind == "flip":
            damaged[at] ^= byte or 1
        elif kind == "drop":
            del damaged[at]
        elif kind == "cut":
            del damaged[at : at + 8 * byte]
        else:
            damaged[at:at] = bytes([byte])
        if not damaged:
            break
    return bytes(damaged)


EDITS = st.lists(
    st.tuples(
        st.integers(0, 30_000),
        st.sampled_from(["flip", "drop", "insert", "cut"]),
        st.integers(0, 255),
    ),
    max_size=6,
)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    edits=EDITS,
    sizes=st.lists(st.integers(1, 5000), min_size=1, max_size=20),
)
def test_portions_do_not_matter(name, seed, edits, sizes):
    family = FAMILIES[name]
    packets, _ = stream(family, seed, 5)
    data = damage(b"".join(packets), edits)
    found, statistics, error = run(family, data, sizes)
    whole, whole_statistics, whole_error = run(family, data, [max(1, len(data))])
    # A device that is refused is refused either way; what came before it may have been given.
    assert error == whole_error
    if error is None:
        assert (found, statistics) == (whole, whole_statistics)


@pytest.mark.parametrize("name", [n for n in NAMES if FAMILIES[n].has_checksum])
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), edits=EDITS)
def test_only_whole_packets_come_out(name, seed, edits):
    family = FAMILIES[name]
    packets, values = stream(family, seed, 5)
    found, _, error = run(family, damage(b"".join(packets), edits), [4096])
    assert error is None
    assert all(item in values for item in found)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40)
@given(data=st.binary(max_size=4000))
def test_foreign_bytes_are_survived(name, data):
    family = FAMILIES[name]
    packet, _ = family.make(0, np.random.default_rng(0))
    mark = packet[-4:] if name == "justfloat" else packet[:4]
    found, statistics, error = run(family, mark + data + mark + data, [97])
    assert found == []
    assert error is not None or statistics["packets"] == 0


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), place=st.integers(0, 10**6), kind=st.integers(0, 2))
def test_damage_costs_its_packet_alone(name, seed, place, kind):
    family = FAMILIES[name]
    packets, values = stream(family, seed, 6)
    at = place % len(packets[2])
    spoiled = bytearray(packets[2])
    if kind == 0:
        del spoiled[at]
    else:
        # The highest bit of a float's last byte is its sign: no reading is negative.
        at = at if family.has_checksum else len(packets[2]) - 4 * (1 + at // 4) + 3
        spoiled[at] ^= 0x80
    data = b"".join([*packets[:2], bytes(spoiled), *packets[3:]])
    found, _, _ = run(family, data, [1 + place % 700])
    # A family without marks at the start needs one packet to find its place.
    first = 0 if name != "justfloat" else 1
    whole = [*values[first:2], *values[3:]]
    if len(data) < len(packets[0]) * 6:
        # A dropped byte may be one that its neighbour replaces.
        assert found in (whole, values[first:])
    else:
        assert found == whole
