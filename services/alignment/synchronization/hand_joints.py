"""Retargeting of both tracked hands, resampled to the steps of the grid."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float64, UInt8

from dextouch.schemas import Matrix
from dextouch.tactile.layout import SIDES
from services.alignment.retargeting.hand_profile import calibrated_profile
from services.alignment.retargeting.hand_retargeter import (
    HandRetargeter,
    RetargetResult,
    RetargetStatus,
)
from services.alignment.retargeting.keypoint_axes import hand_axes_check
from services.alignment.synchronization.recorded_streams import LoadedStream
from services.alignment.synchronization.resampling import GridPlacement, vectors_on_grid

NS_PER_S = 1e9
# Samples of a recording from which a hand's axes, side and unit are checked.
MAX_CHECKED = 2000


def retarget_hands(
    streams: Mapping[str, LoadedStream],
    at: Mapping[str, GridPlacement],
    calibration: Mapping[str, Matrix],
) -> tuple[Float64[np.ndarray, "n 40"], dict[str, float]]:
    """Joint angles of both hands, left before right, on the grid, and quality figures.

    Each hand is retargeted in its own thread.

    Every sample is retargeted once, at the rate at which the hand was tracked; the grid's steps
    take the line between their two neighbours, which `at` has found to be in no gap.

    `at` is valid at every step. `hand_profile_SIDE` of the calibration is the person's hand, which
    is measured from the recording itself where it is absent.

    Raises:
        InvalidInputError: keypoints that are not a hand, of the other side or in other axes, see
            `hand_axes_check` and `HandRetargeter.retarget`.
    """
    with ThreadPoolExecutor(len(SIDES), thread_name_prefix="retarget") as threads:
        hands = list(
            threads.map(
                lambda side: _retarget(
                    HandRetargeter(side, calibrated_profile(calibration, side)),
                    streams[f"keypoints_{side}"],
                    at[f"keypoints_{side}"],
                ),
                SIDES,
            )
        )
    joints_rad = np.concatenate([joints for joints, _ in hands], axis=1)
    return joints_rad, hands[0][1] | hands[1][1]


def _retarget(
    retargeter: HandRetargeter, stream: LoadedStream, at: GridPlacement
) -> tuple[Float64[np.ndarray, "n 20"], dict[str, float]]:
    side = retargeter.hand.side
    first, stop = int(at.left.min()), int(at.left.max()) + 2
    keypoints_m = stream.values[first:stop]
    # What the calibration turns was turned when the stream was read: the rest is refused.
    hand_axes_check(keypoints_m[:: 1 + len(keypoints_m) // MAX_CHECKED], side, {})
    t_ns = stream.t_ns[first:stop]
    # int64 first, so that seconds stay exact to the nanosecond.
    t_s = (t_ns - t_ns[0]).astype(np.float64) / NS_PER_S
    result = retargeter.retarget(keypoints_m, t_s=t_s)
    near = GridPlacement(at.left - first, at.weight, at.valid)
    # Extrapolation beyond the first or last sample could exceed the limits.
    hand = retargeter.hand
    joints_rad = np.clip(vectors_on_grid(result.joints_rad, near), hand.lower_rad, hand.upper_rad)
    return joints_rad, _quality(side, result, near)


def _quality(side: str, result: RetargetResult, at: GridPlacement) -> dict[str, float]:
    status = status_on_grid(result.status, at)
    name = f"retargeting_{side}"
    figures = {f"{name}_num_steps_not_solved": float((status != RetargetStatus.SOLVED).sum())}
    again = result.finger_status == RetargetStatus.REACQUIRED
    figures[f"{name}_num_fingers_reacquired"] = float(again.sum())
    errors_mm = result.tip_error_m[result.solved] * 1e3
    if errors_mm.size:
        figures[f"{name}_tip_error_mm"] = float(errors_mm.mean())
        figures[f"{name}_tip_error_p95_mm"] = float(np.percentile(errors_mm, 95))
    shares = {
        f"{name}_share_{kind.name.lower()}": float((status == kind).mean())
        for kind in RetargetStatus
    }
    return figures | shares


def status_on_grid(status: np.ndarray, at: GridPlacement) -> UInt8[np.ndarray, " n"]:
    """Status of each step: the worse of its two samples."""
    left = np.where(at.weight == 1, at.left + 1, at.left)
    right = np.where(at.weight == 0, at.left, at.left + 1)
    return np.maximum(status[left], status[right]).astype(np.uint8)
