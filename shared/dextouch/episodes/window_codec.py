"""Serialization of windows with msgpack, for the store's HTTP interface."""

from typing import Any, get_args

import numpy as np

from dextouch.episodes.window import Window
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind
from dextouch.streams import pack, unpack

_IMAGES, _IMAGE_DT = "images/", "image_dt_ns/"
# Type and shape of the fields that are one array each; -1 is the number of steps.
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "tactile_kpa": ("float32", (-1, 2, 320)),
    "tactile_valid": ("bool", (-1, 2)),
    "actions": ("float64", (-1, 67)),
    "t_ref_ns": ("int64", (-1,)),
    "anchor": ("float64", (3, 4, 4)),
    "K_head": ("float64", (3, 3)),
}


def encode_window(window: Window) -> bytes:
    """Serialize a window."""
    arrays = {name: getattr(window, name) for name in _ARRAYS}
    arrays["anchor"] = np.stack(window.anchor.as_tuple())
    for camera, images in window.images.items():
        arrays[_IMAGES + camera] = images
        arrays[_IMAGE_DT + camera] = window.image_dt_ns[camera]
    return pack({"action_kind": window.action_kind, "instruction": window.instruction}, arrays)


def decode_window(data: bytes, *, max_bytes: int) -> Window:
    """Deserialize and validate a window from an untrusted source; arrays are read-only.

    Raises:
        LimitExceededError: more bytes than allowed.
        InvalidInputError: not a valid window.
    """
    fields, arrays = unpack(data, max_bytes=max_bytes)
    cameras = [name.removeprefix(_IMAGES) for name in arrays if name.startswith(_IMAGES)]
    _check_arrays(arrays, cameras)
    action_kind, instruction = fields.get("action_kind"), fields.get("instruction")
    if action_kind not in get_args(ActionKind) or not isinstance(instruction, str):
        raise InvalidInputError(
            f"window: got action kind {action_kind!r} and instruction {instruction!r}, "
            f"expected one of {get_args(ActionKind)} and a text"
        )
    plain: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
    plain["anchor"] = AnchorPoses(*arrays["anchor"])
    return Window(
        images={camera: arrays[_IMAGES + camera] for camera in cameras},
        image_dt_ns={camera: arrays[_IMAGE_DT + camera] for camera in cameras},
        action_kind=fields["action_kind"],
        instruction=instruction,
        **plain,
    )


def _check_arrays(arrays: dict[str, np.ndarray], cameras: list[str]) -> None:
    n = len(arrays["t_ref_ns"]) if "t_ref_ns" in arrays and arrays["t_ref_ns"].ndim else 0
    expected = {
        name: (dtype, tuple(n if size < 0 else size for size in shape))
        for name, (dtype, shape) in _ARRAYS.items()
    }
    for camera in cameras:
        # Height and width vary by camera; gray images have one channel.
        shape = arrays[_IMAGES + camera].shape
        channels = 1 if shape[3:] == (1,) else 3
        expected[_IMAGES + camera] = ("uint8", (n, *shape[1:3], channels))
        expected[_IMAGE_DT + camera] = ("int64", (n,))
    got = {name: (array.dtype.name, array.shape) for name, array in arrays.items()}
    for name in sorted(expected.keys() | got.keys()):
        if name not in got or name not in expected or got[name] != expected[name]:
            raise InvalidInputError(
                f"window: array {name!r} is {got.get(name, 'missing')}, "
                f"expected {expected.get(name, 'none')}"
            )
