"""Serialization with msgpack: named numpy arrays and plain fields, and messages of openpi.

In openpi's WebSocket protocol an array is {b"__ndarray__": true, b"data": bytes, b"dtype": str,
b"shape": [...]}, a numpy scalar {b"__npgeneric__": true, b"data": value, b"dtype": str}. Source:
msgpack_numpy.py of openpi-client 0.1.2 (github.com/Physical-Intelligence/openpi, Apache 2.0).
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgpack
import numpy as np
from jaxtyping import Shaped

from dextouch.errors import InvalidInputError, LimitExceededError

MAX_ARRAYS = 64
MAX_DIMENSIONS = 8
# Limits of items of one list or map, and of all of them in a message: fields are small, large data
# goes into arrays. A list takes 56 bytes of memory but one byte of a message.
MAX_ITEMS_A_CONTAINER = 1024
MAX_ITEMS = 16_384
# Limit of elements of one array, counting an axis of length zero as one: numpy refuses some shapes
# even of empty arrays.
MAX_NUMBERS = 1 << 31
DTYPES = ("uint8", "uint16", "int32", "int64", "float32", "float64", "bool")
_NAMES = {np.dtype(name).newbyteorder("<"): name for name in DTYPES}
# Kinds of dtypes of openpi that are read, bool, signed, unsigned and floating, and their names.
_KINDS: Final = "biuf"
_NUMPY: Final = (np.ndarray, np.generic)
_DTYPE: Final = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")


def pack(fields: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Serialize JSON-like fields and arrays (little endian, C order); raises InvalidInputError."""
    packed = {}
    for name, array in arrays.items():
        ordered = np.asarray(array, order="C")
        dtype = _NAMES.get(ordered.dtype)
        if dtype is None:
            dtype = ordered.dtype.name
            if dtype not in DTYPES:
                raise InvalidInputError(f"array {name!r}: dtype {dtype}, expected one of {DTYPES}")
            ordered = ordered.astype(np.dtype(dtype).newbyteorder("<"))
        packed[name] = {"dtype": dtype, "shape": ordered.shape, "data": ordered.data}
    try:
        return msgpack.packb({"fields": dict(fields), "arrays": packed})
    except OverflowError as error:
        raise InvalidInputError("body: a whole number outside -2^63 … 2^64-1") from error


def unpack(data: bytes, *, max_bytes: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Deserialize and validate bytes of an untrusted source; arrays are read-only views into them.

    Raises:
        LimitExceededError: more bytes, arrays, or items of lists and maps than allowed.
        InvalidInputError: not msgpack, or not of this layout.
    """
    message = unpack_bounded(data, max_bytes=max_bytes, what="body")
    if (
        not isinstance(message, dict)
        or not isinstance(message.get("fields"), dict)
        or not isinstance(message.get("arrays"), dict)
    ):
        raise InvalidInputError("body: expected a map with the maps 'fields' and 'arrays'")
    if not all(isinstance(name, str) for part in ("fields", "arrays") for name in message[part]):
        raise InvalidInputError("body: names of fields and arrays are text")
    if len(message["arrays"]) > MAX_ARRAYS:
        raise LimitExceededError(
            f"body: got {len(message['arrays'])} arrays, expected at most {MAX_ARRAYS}"
        )
    return message["fields"], {
        name: _array(name, entry) for name, entry in message["arrays"].items()
    }


def unpack_bounded(
    data: bytes, *, max_bytes: int, what: str, of_map: Callable[[dict[Any, Any]], Any] | None = None
) -> Any:  # noqa: ANN401 - whatever msgpack holds
    """Deserialize msgpack from an untrusted source, with a limit of lists' and maps' items.

    `what` names the message in errors; `of_map` is called with every map, whose place its result
    takes. Raises as `unpack`.
    """
    if len(data) > max_bytes:
        raise LimitExceededError(f"{what}: got {len(data)} bytes, expected at most {max_bytes}")
    num_items = 0

    def counted(container: Any) -> Any:  # noqa: ANN401 - a list or a map
        nonlocal num_items
        num_items += 1 + len(container)
        if num_items > MAX_ITEMS:
            raise LimitExceededError(f"{what}: lists and maps hold more than {MAX_ITEMS} items")
        return container if of_map is None or type(container) is list else of_map(container)

    try:
        return msgpack.unpackb(
            data,
            object_hook=counted,
            list_hook=counted,
            max_array_len=MAX_ITEMS_A_CONTAINER,
            max_map_len=MAX_ITEMS_A_CONTAINER,
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise InvalidInputError(f"{what}: not msgpack ({type(error).__name__}: {error})") from error


def _array(name: str, entry: object) -> np.ndarray:
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data"}:
        raise InvalidInputError(f"array {name!r}: expected a map of dtype, shape and data")
    dtype = entry["dtype"]
    if dtype not in DTYPES:
        raise InvalidInputError(f"array {name!r}: dtype {dtype!r}, expected one of {DTYPES}")
    little_endian = np.dtype(dtype).newbyteorder("<")
    return array_of(entry["data"], little_endian, entry["shape"], what=f"array {name!r}")


def array_of(
    data: object, dtype: "np.dtype[Any]", shape: object, *, what: str
) -> Shaped[np.ndarray, "..."]:
    """A read-only array view into bytes of an untrusted message, in C order; `dtype` is trusted.

    Raises InvalidInputError for a shape that is none, too many elements, or another number of
    bytes; `what` names the array.
    """
    counts: list[Any] | None = None
    if isinstance(shape, list) and len(shape) <= MAX_DIMENSIONS:
        counts = shape
    num_numbers = 1
    for n in counts or ():
        # Exactly int, since a bool is none.
        num_numbers *= n or 1 if type(n) is int and n >= 0 else MAX_NUMBERS + 1
    if counts is None or num_numbers > MAX_NUMBERS:
        raise InvalidInputError(
            f"{what}: shape {shape!r}, expected at most {MAX_DIMENSIONS} counts whose product is "
            f"at most {MAX_NUMBERS}"
        )
    expected = math.prod(counts) * dtype.itemsize
    if not isinstance(data, bytes) or len(data) != expected:
        got = len(data) if isinstance(data, bytes) else type(data).__name__
        raise InvalidInputError(f"{what}: got {got} bytes, expected {expected} for {counts}")
    return np.frombuffer(data, dtype=dtype).reshape(counts)


def pack_openpi(message: Mapping[str, Any]) -> bytes:
    """Serialize nested maps and lists of plain values and arrays; raises InvalidInputError."""
    try:
        return msgpack.packb(dict(message), default=_encoded)
    except (TypeError, OverflowError) as error:
        raise InvalidInputError(f"openpi message: {error}") from error


def unpack_openpi(data: bytes, *, max_bytes: int) -> dict[str, Any]:
    """Deserialize a message of an untrusted source; arrays are read-only views into it.

    Raises:
        LimitExceededError: more bytes or items than allowed.
        InvalidInputError: not msgpack, not a map with text keys, or an invalid array.
    """

    def of_map(found: dict[Any, Any]) -> Any:  # noqa: ANN401 - a map, an array or a number
        if b"__ndarray__" in found:
            return _openpi_array(found)
        if b"__npgeneric__" in found:
            return _openpi_array(found | {b"shape": [], b"data": _scalar_bytes(found)})[()]
        return found

    message = unpack_bounded(data, max_bytes=max_bytes, what="openpi message", of_map=of_map)
    if not isinstance(message, dict) or not all(isinstance(name, str) for name in message):
        raise InvalidInputError("openpi message: expected a map whose keys are text")
    return message


def _encoded(value: object) -> dict[bytes, Any]:
    if not isinstance(value, _NUMPY) or value.dtype.kind not in _KINDS:
        raise TypeError(f"got {type(value).__name__}, expected plain values and numeric arrays")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return {
        b"__ndarray__": True,
        b"data": np.ascontiguousarray(value).data,
        b"dtype": value.dtype.str,
        b"shape": value.shape,
    }


def _dtype(found: Mapping[Any, Any]) -> "np.dtype[Any]":
    name = found.get(b"dtype")
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise InvalidInputError(
            f"openpi message: got an array of dtype {name!r}, expected one of numbers, such as <f4"
        )
    return np.dtype(name)


def _scalar_bytes(found: Mapping[Any, Any]) -> bytes:
    value = found.get(b"data")
    if not isinstance(value, bool | int | float):
        raise InvalidInputError(f"openpi message: got the scalar {value!r}, expected a number")
    try:
        with np.errstate(over="ignore"):
            return np.asarray(value, dtype=_dtype(found)).tobytes()
    except (OverflowError, ValueError) as error:
        raise InvalidInputError(f"openpi message: scalar {value}: {error}") from error


def _openpi_array(found: Mapping[Any, Any]) -> np.ndarray:
    return array_of(
        found.get(b"data"), _dtype(found), found.get(b"shape"), what="openpi message: array"
    )
