"""Messages of openpi's WebSocket protocol: msgpack with numpy arrays as maps.

An array is {b"__ndarray__": true, b"data": bytes, b"dtype": str, b"shape": [...]}, a numpy scalar
{b"__npgeneric__": true, b"data": value, b"dtype": str}. Source: msgpack_numpy.py of openpi-client
0.1.2 (github.com/Physical-Intelligence/openpi, Apache 2.0).
"""

import re
from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.streams.packing import array_of, unpack_bounded

# Kinds of dtypes that are read, bool, signed, unsigned and floating, and their names.
_KINDS: Final = "biuf"
_DTYPE: Final = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")


def pack_openpi(message: Mapping[str, Any]) -> bytes:
    """Serialize nested maps and lists of plain values and arrays.

    Raises:
        InvalidInputError: a value that msgpack does not hold.
    """
    try:
        return msgpack.packb(dict(message), default=_encoded)
    except (TypeError, OverflowError) as error:
        raise InvalidInputError(f"openpi message: {error}") from error


def unpack_openpi(data: bytes, *, max_bytes: int) -> dict[str, Any]:
    """Deserialize a message; arrays are read-only views into `data`.

    Args:
        data: from an untrusted source.
        max_bytes: size limit.

    Raises:
        LimitExceededError: more bytes or items than allowed.
        InvalidInputError: not msgpack, not a map with text keys, or an invalid array.
    """

    def of_map(found: dict[Any, Any]) -> Any:  # noqa: ANN401 - a map, an array or a number
        if b"__ndarray__" in found:
            return _array(found)
        if b"__npgeneric__" in found:
            return _array(found | {b"shape": [], b"data": _scalar_bytes(found)})[()]
        return found

    message = unpack_bounded(data, max_bytes=max_bytes, what="openpi message", of_map=of_map)
    if not isinstance(message, dict) or not all(isinstance(name, str) for name in message):
        raise InvalidInputError("openpi message: expected a map whose keys are text")
    return message


def _encoded(value: object) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.kind not in _KINDS:
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


def _array(found: Mapping[Any, Any]) -> np.ndarray:
    return array_of(
        found.get(b"data"), _dtype(found), found.get(b"shape"), what="openpi message: array"
    )
