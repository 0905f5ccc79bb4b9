"""Windows of an episode, resampling to the model grid, and their form on the wire (msgpack)."""

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind
from dextouch.streams import pack, unpack

# Stamps of one instant may differ by rounding.
SAME_INSTANT_NS = 1_000
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


@dataclass(frozen=True)
class StreamData:
    """Samples of one stream of an episode on the reference clock."""

    t_ref_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __len__(self) -> int:
        return len(self.t_ref_ns)


@dataclass(frozen=True)
class Window:
    """n consecutive steps of the model grid.

    `images` are the nearest ones (one channel if requested in gray), `image_dt_ns` the image's
    stamp minus the step's. `tactile_kpa` [step, left/right, taxel] is the mean of the samples in
    (t−1, t]; where `tactile_valid` is false there was none, and the row is zero. `actions` are
    relative to the *measured* poses of the first step, whose absolute poses are `anchor`; `K_head`
    is in pixels.
    """

    images: dict[str, UInt8[np.ndarray, "n h w c"]]
    image_dt_ns: dict[str, Int64[np.ndarray, " n"]]
    tactile_kpa: Float32[np.ndarray, "n 2 320"]
    tactile_valid: Bool[np.ndarray, "n 2"]
    actions: Float64[np.ndarray, "n 67"]
    action_kind: ActionKind
    instruction: str
    t_ref_ns: Int64[np.ndarray, " n"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]

    def __len__(self) -> int:
        return len(self.t_ref_ns)


@dataclass(frozen=True)
class NativeWindow:
    """The same time span with every stream at its native rate."""

    streams: dict[str, StreamData]
    start_ns: int
    stop_ns: int
    instruction: str
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


def step_ranges(
    stamps_ns: np.ndarray, grid_ns: np.ndarray, start: int, stop: int
) -> Int64[np.ndarray, "n 2"]:
    """Sample ranges [low, high) with t−1 < stamp ≤ t for grid steps start … stop-1.

    Step 0 has no predecessor: it takes the first sample of the stream, if that lies within half a
    step of it. A range is empty if there is no sample.

    Args:
        stamps_ns: of the samples, strictly increasing.
        grid_ns: of all steps of the episode.
        start: first step.
        stop: one past the last step.
    """
    edges = np.searchsorted(stamps_ns, grid_ns[max(0, start - 1) : stop] + SAME_INSTANT_NS, "right")
    if start > 0:
        return np.stack([edges[:-1], edges[1:]], axis=1).astype(np.int64)
    ranges = np.stack([np.concatenate([[0], edges[:-1]]), edges], axis=1).astype(np.int64)
    half_step_ns = int(grid_ns[1] - grid_ns[0]) // 2 if len(grid_ns) > 1 else SAME_INSTANT_NS
    near = len(stamps_ns) > 0 and abs(int(stamps_ns[0] - grid_ns[0])) <= half_step_ns
    ranges[0] = (0, 1) if near else (0, 0)
    return ranges


def mean_over_ranges(
    values: np.ndarray, ranges: np.ndarray
) -> tuple[Float32[np.ndarray, "n taxels"], Bool[np.ndarray, " n"]]:
    """Means of rows [low, high) in float32, and a mask of non-empty ranges.

    Args:
        values: rows, indexed by `ranges`.
        ranges: [n, 2].
    """
    valid = ranges[:, 1] > ranges[:, 0]
    means = np.zeros((len(ranges), *values.shape[1:]), dtype=np.float32)
    for step, (low, high) in enumerate(ranges.tolist()):
        if high > low:
            # Bit-identical to `mean`, without its overhead.
            means[step] = np.add.reduce(values[low:high], axis=0, dtype=np.float64) / (high - low)
    return means, valid


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
