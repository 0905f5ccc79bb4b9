"""Compares what a camera's pictures show with how the camera moved: still, turned or mirrored.

A picture flows (Lucas and Kanade, 1981, in parts of the picture, of which the median is taken) as
its camera turns, and as it moves past a scene at one depth, which is unknown. Hands that fill half
of the picture and more may flow otherwise: nothing that is said here makes a take a bad one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, Int64

from dextouch.geometry import interpolate_poses, invert
from dextouch.geometry.rotations import rotation_angle
from dextouch.streams.pictures import COLUMNS, ROWS, apart, noise_levels

# Cameras on tracked bodies, with the stream of the tracker.
TRACKERS: Final = {
    "camera_head": "head",
    "camera_wrist_left": "wrist_left",
    "camera_wrist_right": "wrist_right",
}
_AS_READ: Final = "as_they_are"
# How images may be turned or mirrored against their camera's matrix; x is right and y down.
TURNS: Final[Mapping[str, tuple[tuple[int, int], tuple[int, int]]]] = {
    _AS_READ: ((1, 0), (0, 1)),
    "mirrored_left_for_right": ((-1, 0), (0, 1)),
    "mirrored_top_for_bottom": ((1, 0), (0, -1)),
    "turned_by_180_degrees": ((-1, 0), (0, -1)),
    "turned_by_90_degrees_clockwise": ((0, -1), (1, 0)),
    "turned_by_90_degrees_anticlockwise": ((0, 1), (-1, 0)),
    "transposed": ((0, 1), (1, 0)),
    "transposed_and_turned_by_180_degrees": ((0, -1), (-1, 0)),
}
# Share of the flow that a reading explains if it is right, and more than others that are wrong.
# Hands that the head follows explain up to 0.5 otherwise.
RIGHT_SHARE, MIN_APART = 0.65, 0.25
# Parts of a picture, of 4 by 4 blocks, and the RMS change of levels from block to block along the
# evener axis that tells how one flows; half of them must.
PARTS: Final = (5, 7)
MIN_SLOPE: Final = 1.0
# Flows are as large as they are predicted, or as near scenes are; chance makes them much smaller.
MIN_WEIGHT: Final = 0.2
# Predicted flow of an image, RMS, below which a camera stands still: 0.5 px of VGA at 500 px.
MIN_FLOW_RAD: Final = 1e-3
MIN_VIEW_IMAGES: Final = 60
# What is late may look turned in a motion to and fro: turned is what no lag explains as well.
MAX_LAG_S, LAG_STEP_S, LATE_APART = 0.4, 0.02, 0.1
# While a camera turns by so much in a second, or moves past what is a metre away, its picture is
# off by 30 px of VGA at 500 px, and changes by more than noise does; in so many images at least.
TURNED_RAD, STILL_NOISE, STILL_SHARE, MIN_TURNED = 0.06, 2.0, 0.9, 15
_FINE_NS: Final = 10_000_000


@dataclass(frozen=True)
class View:
    """Pictures of one camera at its times, its matrix for images of (height, width) pixels."""

    t_ns: Int64[np.ndarray, " n"]
    pictures: Float32[np.ndarray, "n 24 32"]
    K: Float64[np.ndarray, "3 3"]
    size_px: tuple[int, int]

    def flow(self) -> Float64[np.ndarray, "steps 2"]:
        """Median flow of parts of the picture from image to image, right and down.

        In focal lengths; NaN where less than half of the parts have edges.
        """
        middle = (self.pictures[1:] + self.pictures[:-1]) / 2
        change = np.diff(self.pictures, axis=0)
        change -= np.median(change, axis=(1, 2), keepdims=True)
        x = (middle[:, 2:-2, 3:-1] - middle[:, 2:-2, 1:-3]) / 2
        y = (middle[:, 3:-1, 2:-2] - middle[:, 1:-3, 2:-2]) / 2
        rows, columns = PARTS
        # By step, part and block: both slopes and the change.
        values = np.stack([x, y, change[:, 2:-2, 2:-2]], axis=-1, dtype=np.float64)
        values = values.reshape(len(x), rows, x.shape[1] // rows, columns, -1, 3)
        values = values.swapaxes(2, 3).reshape(len(x), rows * columns, -1, 3)
        slopes = values[..., :2]
        A = slopes.swapaxes(2, 3) @ slopes
        sure = np.linalg.eigvalsh(A)[..., 0] > MIN_SLOPE**2 * slopes.shape[2]
        A += 1e-9 * np.eye(2)
        flow = np.linalg.solve(A, -slopes.swapaxes(2, 3) @ values[..., 2:])[..., 0]
        flow[~sure] = np.nan
        known = sure.mean(axis=1) >= 0.5
        blocks = np.full((len(x), 2), np.nan)
        blocks[known] = np.nanmedian(flow[known], axis=1)
        (height, width), (focal_x, focal_y) = self.size_px, np.diag(self.K)[:2]
        return np.asarray(blocks * [width / COLUMNS / focal_x, height / ROWS / focal_y])


class MovingCamera:
    """How a camera at poses T_world_camera, two at least, turns and moves, as flow of a picture."""

    def __init__(
        self, t_ns: Int64[np.ndarray, " m"], Ts_world_camera: Float64[np.ndarray, "m 4 4"]
    ) -> None:
        self.t_ns = np.arange(t_ns[0], t_ns[-1], _FINE_NS)
        left = np.searchsorted(t_ns, self.t_ns, side="right").clip(1, len(t_ns) - 1) - 1
        weight = (self.t_ns - t_ns[left]) / (t_ns[left + 1] - t_ns[left])
        self._Ts = interpolate_poses(Ts_world_camera, left, weight)
        T = invert(self._Ts[1:]) @ self._Ts[:-1]
        # Where the middle of the picture before is now, for a far scene, and per 1/m of a near one.
        steps = np.concatenate([T[:, :2, 2] / T[:, 2:3, 2], T[:, :2, 3]], axis=1)
        self._flow = np.concatenate([np.zeros((1, 4)), np.cumsum(steps, axis=0)])

    def flow(self, t_ns: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "steps 2 2"]:
        """Flow between these times: [turn, move] by [right, down]."""
        flow = [np.interp(t_ns, self.t_ns, column) for column in self._flow.T]
        return np.diff(np.array(flow).T.reshape(-1, 2, 2), axis=0)

    def turned_rad(self, t_ns: np.ndarray, later_ns: int) -> Float64[np.ndarray, " n"]:
        """By how much it turns, or moves past what is 1 m away, from each time on; 0 at the end."""
        last = len(self._Ts) - 1
        at, later = (np.searchsorted(self.t_ns, t).clip(0, last) for t in (t_ns, t_ns + later_ns))
        return turned_rad(self._Ts[at], self._Ts[later])


def turned_rad(Ts: np.ndarray, later: np.ndarray) -> Float64[np.ndarray, " n"]:
    """By how much bodies turn from poses to others, or move past what is a metre away."""
    moved = invert(Ts) @ later
    far_m = np.linalg.norm(moved[:, :3, 3], axis=1)
    return np.asarray(rotation_angle(moved[:, :3, :3]) + far_m)


def _explained(flow: np.ndarray, predicted: np.ndarray, turn: str = _AS_READ) -> float:
    """Share of the flow that the camera's turns and moves explain, both the way they go."""
    # Of a turn and a move past what is half a metre away.
    if not len(flow) or np.mean((np.array([1.0, 2.0]) @ predicted) ** 2) < MIN_FLOW_RAD**2:
        return 0.0
    A = np.einsum("ij,nkj->nik", np.array(TURNS[turn], dtype=np.float64), predicted).reshape(-1, 2)
    y, shares = flow.ravel(), [0.0]
    for columns in ([0, 1], [0], [1]):
        weights = np.linalg.lstsq(A[:, columns], y, rcond=None)[0]
        if (weights > 0).all() and weights.max() > MIN_WEIGHT:
            shares.append(1 - float(((y - A[:, columns] @ weights) ** 2).sum() / (y @ y)))
    return max(shares)


@dataclass(frozen=True)
class ViewFaults:
    """What a camera's pictures and its motion say of each other; None where they say nothing.

    Attributes:
        still_share: of the images before which the camera turned, those that are the same.
        looks: how the images may be turned or mirrored, with the share of the flow that explains.
    """

    still_share: float | None = None
    looks: Mapping[str, float] = field(default_factory=dict)


def view_faults(view: View, motion: MovingCamera) -> ViewFaults:
    """Compare the pictures of a camera with its motion."""
    margin_ns = round(MAX_LAG_S * 1e9)
    inside = view.t_ns >= motion.t_ns[0] + margin_ns
    inside &= view.t_ns <= motion.t_ns[-1] - margin_ns
    view = View(view.t_ns[inside], view.pictures[inside], view.K, view.size_px)
    if len(view.t_ns) < MIN_VIEW_IMAGES:
        return ViewFaults()
    still_share, flow = _still_share(view, motion), view.flow()
    # Across a pause there is no flow.
    known = np.diff(view.t_ns) < 2 * np.median(np.diff(view.t_ns))
    known &= np.isfinite(flow).all(axis=1)
    if np.count_nonzero(known) < MIN_VIEW_IMAGES:
        return ViewFaults(still_share)
    flow, predicted = flow[known], motion.flow(view.t_ns)[known]
    shares = {turn: _explained(flow, predicted, turn) for turn in TURNS}
    turn = max(shares, key=shares.__getitem__)
    if shares[turn] < max(RIGHT_SHARE, shares[_AS_READ] + MIN_APART):
        return ViewFaults(still_share)
    lags_ns = np.rint(1e9 * np.arange(-MAX_LAG_S, MAX_LAG_S + LAG_STEP_S, LAG_STEP_S)).astype(int)
    late = max(_explained(flow, motion.flow(view.t_ns - lag)[known]) for lag in lags_ns)
    halves = np.array_split(np.arange(len(flow)), 2)
    if shares[turn] < late + LATE_APART or any(
        _explained(flow[p], predicted[p], turn) <= _explained(flow[p], predicted[p]) for p in halves
    ):
        return ViewFaults(still_share)
    near = {one: share for one, share in shares.items() if share > shares[turn] - MIN_APART}
    return ViewFaults(still_share, near)


def _still_share(view: View, motion: MovingCamera) -> float | None:
    step_ns = float(np.median(np.diff(view.t_ns)))
    later = max(1, round(1e9 / step_ns))
    turned = motion.turned_rad(view.t_ns[:-later], round(later * step_ns)) > TURNED_RAD
    if np.count_nonzero(turned) < MIN_TURNED:
        return None
    changed = apart(view.pictures[later:], view.pictures[:-later])[turned]
    return float((changed < STILL_NOISE * noise_levels(view.pictures)).mean())
