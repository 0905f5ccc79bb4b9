"""Packed fields and arrays come back as they went; foreign bytes are refused."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.streams.packing import pack, unpack


def test_round_trip():
    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros((0, 2), np.int64)}
    fields, back = unpack(pack({"n": 1, "t": "é"}, arrays), max_bytes=10_000)
    assert fields == {"n": 1, "t": "é"}
    assert set(back) == {"a", "b"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype


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
