"""openpi's encoding of arrays, against bytes written by hand from the msgpack specification."""

import msgpack
import numpy as np
import pytest

from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.streams import pack_openpi, unpack_openpi

# {"a": {b"__ndarray__": true, b"data": <2 float32>, b"dtype": "<f4", b"shape": [2]}}: a fixmap of
# one (81), "a" (a1 61), a fixmap of four (84), keys as bin 8 (c4 LENGTH), true (c3), an array (91).
BY_HAND = bytes.fromhex(
    "81 a1 61 84"
    "c4 0b 5f5f6e6461727261795f5f c3"
    "c4 04 64617461 c4 08 0000803f 00000040"
    "c4 05 6474797065 a3 3c6634"
    "c4 05 7368617065 91 02"
)
# The same way, "n" with a scalar: data 7 of dtype "<i8".
SCALAR_BY_HAND = bytes.fromhex(
    "81 a1 6e 83c4 0d 5f5f6e7067656e657269635f5f c3c4 04 64617461 07c4 05 6474797065 a3 3c6938"
)


def test_bytes_are_those_of_the_protocol():
    assert pack_openpi({"a": np.array([1, 2], dtype="<f4")}) == BY_HAND
    assert pack_openpi({"n": np.int64(7)}) == SCALAR_BY_HAND
    read = unpack_openpi(BY_HAND, max_bytes=1000)["a"]
    assert (read.dtype, read.tolist(), read.flags.writeable) == (np.float32, [1.0, 2.0], False)
    number = unpack_openpi(SCALAR_BY_HAND, max_bytes=1000)["n"]
    assert (number, number.dtype) == (7, np.int64)


def test_nested_messages_come_back():
    message = {
        "observation": {"image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3)},
        "prompt": "stand up",
        "list": [1, 2.5, None, True],
        "empty": np.zeros((0, 67)),
        "big": np.arange(3, dtype=">i4"),
    }
    again = unpack_openpi(pack_openpi(message), max_bytes=10_000)
    np.testing.assert_array_equal(again["observation"]["image"], message["observation"]["image"])
    assert again["empty"].shape == (0, 67)
    assert again["big"].tolist() == [0, 1, 2]
    assert (again["prompt"], again["list"]) == ("stand up", [1, 2.5, None, True])


def array(**changed):
    entry = {"__ndarray__": True, "data": b"\0" * 8, "dtype": "<f4", "shape": [2]} | changed
    return msgpack.packb({"a": {name.encode(): value for name, value in entry.items()}})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not msgpack"),
        (b"\xc1", "not msgpack"),
        (BY_HAND[:-1], "not msgpack"),
        (msgpack.packb([1]), "expected a map"),
        (msgpack.packb({b"a": 1}), "keys are text"),
        (array(dtype="O"), "dtype 'O'"),
        (array(dtype="V8"), "dtype 'V8'"),
        (array(dtype="<c8"), "dtype '<c8'"),
        (array(dtype="nonsense"), "dtype 'nonsense'"),
        (array(dtype=7), "dtype 7"),
        (array(dtype=","), "dtype ','"),
        (array(dtype=",f8"), "dtype ',f8'"),
        (array(dtype="i,,i"), "dtype 'i,,i'"),
        (array(dtype="<f16"), "dtype '<f16'"),
        (array(shape=[3]), "got 8 bytes, expected 12"),
        (array(shape=[-2]), "shape"),
        (array(shape=[0, 2**62]), "shape"),
        (array(shape=[1] * 9), "shape"),
        (array(shape=2), "shape"),
        (array(data="text"), "got str"),
        (SCALAR_BY_HAND.replace(b"\x07", b"\xc0"), "expected a number"),
        (SCALAR_BY_HAND.replace(b"<i8", b"|u1").replace(b"\x07", b"\xff"), "scalar"),
    ],
)
def test_hostile_bytes_are_refused(data, message):
    with pytest.raises(InvalidInputError, match=message):
        unpack_openpi(data, max_bytes=1000)


@pytest.mark.parametrize(
    "data", [b"\x91" * 2000 + b"\xc0", msgpack.packb({"a": [[]] * 1000 * 17}), b"\0" * 1001]
)
def test_small_messages_that_take_much_memory_are_refused(data):
    with pytest.raises((LimitExceededError, InvalidInputError)):
        unpack_openpi(data, max_bytes=max(1000, len(data) - 1 if data[0] == 0 else len(data)))


def test_what_the_protocol_cannot_hold_is_refused():
    for value in (np.array(["text"]), np.array([1j]), object(), np.array([None])):
        with pytest.raises(InvalidInputError, match="numeric arrays"):
            pack_openpi({"a": value})
