"""Windows of an episode, and resampling of its streams from native rates to the model grid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind

# Stamps of one instant may differ by rounding.
SAME_INSTANT_NS = 1_000


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


def nearest_indices(stamps_ns: np.ndarray, t_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
    """Index of the stamp nearest to each time; the earlier one in a tie.

    Args:
        stamps_ns: at least one, strictly increasing.
        t_ns: query times.
    """
    right = np.searchsorted(stamps_ns, t_ns).clip(1, max(1, len(stamps_ns) - 1))
    left = right - 1
    right = right.clip(max=len(stamps_ns) - 1)
    later = np.abs(stamps_ns[right] - t_ns) < np.abs(t_ns - stamps_ns[left])
    return np.where(later, right, left).astype(np.int64)


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
