"""Packed fields and arrays come back as they went; foreign bytes are refused."""

import contextlib
import struct
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.streams import pack, unpack


def test_round_trip():
    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros((0, 2), np.int64)}
    arrays |= {"one": np.array(0.5), "columns": np.arange(6, dtype=np.uint16).reshape(2, 3).T}
    fields, back = unpack(pack({"n": 1, "t": "é"}, arrays), max_bytes=10_000)
    assert fields == {"n": 1, "t": "é"}
    assert set(back) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
        assert (back[name].dtype, back[name].shape) == (array.dtype, array.shape)


def test_too_large_is_refused():
    data = pack({}, {"a": np.zeros(100)})
    with pytest.raises(LimitExceededError, match=r"got \d+ bytes, expected at most 100"):
        unpack(data, max_bytes=100)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93\x01\x02\x03", b"{}" * 10])
def test_foreign_bytes_are_refused(data):
    with pytest.raises(InvalidInputError, match="body"):
        unpack(data, max_bytes=1000)


def test_lying_shape_is_refused():
    data = pack({}, {"a": np.zeros(4, np.float32)})
    with pytest.raises(InvalidInputError, match="got 16 bytes, expected 20"):
        unpack(data.replace(b"\x91\x04", b"\x91\x05"), max_bytes=1000)


def test_numbers_that_do_not_travel_are_refused():
    with pytest.raises(InvalidInputError, match="whole number"):
        pack({"seed": 2**70}, {})


@pytest.mark.parametrize(
    "shape",
    [
        [0, 2**62, 320],
        [2**62, 0, 320],
        [0, 2**64 - 1],
        [2**40, 2**40, 0],
        [0] + [2**31] * 7,
        [0] * 9,
        [-1, 0],
        [1.0, 4],
        [True, 4],
        "44",
        None,
    ],
)
def test_absurd_shapes_are_refused(shape):
    """No bytes hold an empty array of any shape, so the number of bytes says nothing."""
    entry = {"dtype": "float32", "shape": shape, "data": b""}
    data = msgpack.packb({"fields": {}, "arrays": {"tactile": entry}})
    with pytest.raises(InvalidInputError, match="array 'tactile': shape"):
        unpack(data, max_bytes=10_000)


@pytest.mark.parametrize("changed", [{"dtype": ["float32"]}, {"dtype": None}, {"data": "ab"}])
def test_entries_of_other_types_are_refused(changed):
    entry = {"dtype": "float32", "shape": [0], "data": b""} | changed
    data = msgpack.packb({"fields": {}, "arrays": {"tactile": entry}})
    with pytest.raises(InvalidInputError, match="array 'tactile'"):
        unpack(data, max_bytes=10_000)


@pytest.mark.parametrize("where", ["fields", "arrays"])
def test_names_are_text(where):
    message = {"fields": {}, "arrays": {}} | {where: {b"x": 1}}
    with pytest.raises(InvalidInputError, match="names"):
        unpack(msgpack.packb(message), max_bytes=10_000)


def in_fields(value):
    """A message with msgpack bytes as one of its fields."""
    return b"\x82\xa6arrays\x80\xa6fields\x81\xa1x" + value


def list_of(items, count):
    return b"\xdd" + struct.pack(">I", count) + items


BOMBS = {
    "empty lists": in_fields(list_of(b"\x90" * 2**20, 2**20)),
    "lists of empty lists": in_fields(list_of((b"\xdc\x03\xe8" + b"\x90" * 1000) * 1000, 1000)),
    "announced lengths": in_fields(list_of(b"", 2**20 - 600) * 200 + bytes(2**20)),
    "numbers": in_fields(list_of(bytes(2**20), 2**20)),
    "maps": in_fields(list_of(b"\x80" * 2**20, 2**20)),
    "keys": in_fields(
        b"\xdf" + struct.pack(">I", 2**18) + b"".join(b"\xa4%04x\x00" % n for n in range(2**16)) * 4
    ),
    "arrays": b"\x82\xa6fields\x80\xa6arrays" + list_of(b"\x80" * 2**20, 2**20),
}


@pytest.mark.parametrize("name", BOMBS)
def test_many_small_things_are_refused_before_they_are_made(name):
    """A list takes 56 bytes of memory and one of the body's."""
    tracemalloc.start()
    try:
        with pytest.raises((InvalidInputError, LimitExceededError), match="body"):
            unpack(BOMBS[name], max_bytes=2**24)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_what_messages_hold_is_within_the_bounds():
    fields = {"matrix": [[1.0] * 30] * 30, "info": {f"score_{n}": 0.5 for n in range(500)}}
    got, arrays = unpack(pack(fields, {"a": np.zeros((0, 1080, 1920, 3))}), max_bytes=10**6)
    assert got == fields
    assert arrays["a"].shape == (0, 1080, 1920, 3)


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.binary()
    # Also times, which travel as an extension of msgpack, and other extensions.
    | st.text()
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20)),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["fields", "arrays", "dtype", "shape", "data"]), inner)
    ),
    max_leaves=6,
)
EMPTY = st.fixed_dictionaries(
    {
        "dtype": st.sampled_from(["float32", "bool"]),
        "shape": st.lists(st.sampled_from([0, 1, 7, 2**31, 2**62, 2**64 - 1]), max_size=9),
        "data": st.just(b""),
    }
)
ENTRY = EMPTY | st.fixed_dictionaries({"dtype": ANYTHING, "shape": ANYTHING, "data": ANYTHING})
MESSAGE = st.fixed_dictionaries(
    {"fields": st.dictionaries(st.text(), ANYTHING) | ANYTHING}
    | {"arrays": st.dictionaries(st.text(), ENTRY, max_size=3) | ANYTHING}
)


@pytest.mark.long
@given(data=st.binary() | (MESSAGE | ANYTHING).map(msgpack.packb), cut=st.integers(0, 5))
def test_whatever_comes_is_read_or_refused_by_name(data, cut):
    for body in (data, data[: len(data) - cut], data[cut:]):
        with contextlib.suppress(InvalidInputError, LimitExceededError):
            fields, arrays = unpack(body, max_bytes=100_000)
            assert all(isinstance(array, np.ndarray) for array in arrays.values())
            assert isinstance(fields, dict)
