"""Errors of an aligned episode against the true episode that mock devices replayed."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.episodes import EpisodeReader, StreamData
from dextouch.errors import InvalidInputError
from dextouch.geometry import invert, nearest_index
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands.actions import poses_from_actions
from dextouch.hands.robot_hand import NUM_JOINTS, RobotHand
from dextouch.metrics import tactile
from dextouch.tactile import in_contact
from dextouch.tactile.layout import SIDES, Side, TactileLayout, common_layout
from services.alignment.retargeting.hand_retargeter import HandRetargeter
from services.alignment.synchronization.resampling import (
    GridPlacement,
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)

NS_PER_MS = 1e6
# How far apart a sample and its true one may be.
NEAR_NS = 60_000_000
MAX_COMPARED_SAMPLES = 400
# Another sample than the nearest is believed only if its values fit this much better: a hand at
# rest looks the same at every moment, up to noise.
CLEARLY_BETTER = 0.5


@dataclass(frozen=True)
class Match:
    """Matched samples of a stream and the true ones; `offset_ns` is episode minus true time.

    `num_dropped` true samples between the first and the last pair have none.
    """

    index: Int64[np.ndarray, " n"]
    true_index: Int64[np.ndarray, " n"]
    offset_ns: Int64[np.ndarray, " n"]
    num_dropped: int

    @property
    def mean_offset_ns(self) -> float:
        """Mean offset in nanoseconds."""
        return float(self.offset_ns.mean())


def compare_with_truth(
    episode: EpisodeReader, truth: EpisodeReader, *, origin_in_truth_ns: int
) -> dict[str, Any]:
    """Errors of an episode against the truth episode that its mock devices replayed.

    `origin_in_truth_ns` is the true time of the episode's time 0. By stream are `clock_rms_ms`
    without a constant delay, `latency_ms` (calibrated plus found), `latency_error_ms` (what
    calibration left) and `num_dropped`; `taxel_iou` and `taxel_mae_kpa` are over samples that
    arrived (None without gloves), `fingertip_error_mm`, `wrist_error_mm`, `wrist_error_deg` means
    over the model grid. It raises InvalidInputError if the two share no stream.
    """
    origin_ns = origin_in_truth_ns
    matches = match_streams(episode, truth, origin_ns)
    if not matches:
        raise InvalidInputError(
            f"truth: the episode has {sorted(episode.streams)}, the truth "
            f"{sorted(truth.streams)}; expected common streams"
        )
    left = {name: (m.mean_offset_ns + origin_ns) / NS_PER_MS for name, m in matches.items()}
    known = {report.stream: report.latency_ms or 0.0 for report in episode.attributes.clocks}
    touch = [name for name in matches if episode.streams[name].kind == "tactile"]
    layout = common_layout(
        [one.streams[name].tactile_layout for name in touch for one in (episode, truth)],
        what=f"episode {episode.attributes.episode_id!r} and its truth",
    )
    gloves = (
        (
            episode.read(name).values[matches[name].index],
            truth.read(name).values[matches[name].true_index],
        )
        for name in touch
    )
    return {
        "clock_rms_ms": {
            name: float(np.std(m.offset_ns.astype(np.float64)) / NS_PER_MS)
            for name, m in matches.items()
        },
        "latency_ms": {name: known.get(name, 0.0) + error for name, error in left.items()},
        "latency_error_ms": left,
        "num_dropped": {name: m.num_dropped for name, m in matches.items()},
        **_taxel_errors(gloves, layout),
        **_pose_errors(episode, truth, origin_ns),
    }


def match_streams(
    episode: EpisodeReader, truth: EpisodeReader, origin_in_truth_ns: int
) -> dict[str, Match]:
    """`match_samples` for all streams that an episode shares with its truth, but actions."""
    return {
        name: match_samples(
            episode.read(name),
            truth.read(name),
            origin_in_truth_ns,
            NEAR_NS,
            period_ns=truth.streams[name].period_ns(),
        )
        for name, stream in episode.streams.items()
        if name in truth.streams and stream.unit != "action"
    }


def match_samples(
    mine: StreamData, true: StreamData, origin_ns: int, reach_ns: int, *, period_ns: int
) -> Match:
    """Match samples with true ones, shifted by periods up to `reach_ns` where clearly better."""
    num = round(reach_ns / period_ns)
    shifts_ns = [origin_ns + period_ns * shift for shift in sorted(range(-num, num + 1), key=abs)]
    differences = np.array([_difference(mine, true, shift_ns, period_ns) for shift_ns in shifts_ns])
    best = int(np.argmin(differences))
    if not differences[best] < CLEARLY_BETTER * differences[0]:
        best = 0
    nearest = nearest_index(true.t_ref_ns, mine.t_ref_ns + shifts_ns[best])
    index = np.flatnonzero(np.concatenate([[True], np.diff(nearest) > 0]))
    true_index = nearest[index]
    offset_ns = mine.t_ref_ns[index] - true.t_ref_ns[true_index]
    span = int(true_index[-1] - true_index[0]) + 1
    return Match(index, true_index, offset_ns, span - len(index))


def pose_difference(
    Ts_world_a: Float64[np.ndarray, "n 4 4"], Ts_world_b: Float64[np.ndarray, "n 4 4"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distance (m) and angle (rad) between simultaneous poses."""
    distance_m = np.linalg.norm(Ts_world_a[:, :3, 3] - Ts_world_b[:, :3, 3], axis=-1)
    return distance_m, rotation_angle((invert(Ts_world_a) @ Ts_world_b)[:, :3, :3])


def _difference(mine: StreamData, true: StreamData, shift_ns: int, period_ns: int) -> float:
    """Mean difference of values with the stream shifted; infinite without overlap."""
    step = max(1, len(mine) // MAX_COMPARED_SAMPLES)
    t_ns, values = mine.t_ref_ns[::step] + shift_ns, mine.values[::step].astype(np.float64)
    inside = (t_ns >= true.t_ref_ns[0] - period_ns) & (t_ns <= true.t_ref_ns[-1] + period_ns)
    if inside.sum() < len(t_ns) / 2:
        return float("inf")
    nearest = true.values[nearest_index(true.t_ref_ns, t_ns[inside])]
    return float(np.abs(values[inside] - nearest).mean())


def _taxel_errors(
    gloves: Iterable[tuple[np.ndarray, np.ndarray]], layout: TactileLayout
) -> dict[str, float | None]:
    pairs = list(gloves)
    if not pairs:
        return {"taxel_iou": None, "taxel_mae_kpa": None}
    mine, true = (np.concatenate(arrays).astype(np.float64) for arrays in zip(*pairs, strict=True))
    touched = bool((in_contact(mine) | in_contact(true)).any())
    both = {"predicted_kpa": mine, "true_kpa": true}
    iou = tactile.contact_iou(**both, layout=layout) if touched else None
    return {"taxel_iou": iou, "taxel_mae_kpa": tactile.mae(**both, layout=layout)}


def _pose_errors(episode: EpisodeReader, truth: EpisodeReader, origin_ns: int) -> dict[str, float]:
    action = episode.read("action")
    reached = poses_from_actions(action.values, episode.attributes.anchor.to_poses())
    at_ns = action.t_ref_ns + origin_ns
    distances, angles, tips = [], [], []
    for side in SIDES:
        values, at = _placed(truth, f"wrist_{side}", at_ns)
        distance, angle = pose_difference(
            getattr(reached, f"Ts_world_wrist_{side}")[at.valid],
            poses_on_grid(values, at)[at.valid],
        )
        distances.append(distance)
        angles.append(angle)
        joints_rad, valid = _true_joints(truth, side, at_ns)
        hand, mine_rad = RobotHand(side), getattr(reached, f"joints_{side}_rad")
        apart = hand.fingertips_m(mine_rad[valid]) - hand.fingertips_m(joints_rad[valid])
        tips.append(np.linalg.norm(apart, axis=-1))
    return {
        "wrist_error_mm": float(np.concatenate(distances).mean() * 1e3),
        "wrist_error_deg": float(np.rad2deg(np.concatenate(angles).mean())),
        "fingertip_error_mm": float(np.concatenate(tips).mean() * 1e3),
    }


def _placed(truth: EpisodeReader, name: str, at_ns: np.ndarray) -> tuple[np.ndarray, GridPlacement]:
    """Values of a true stream, and the neighbours of these times among them."""
    stream, period_ns = truth.read(name), truth.streams[name].period_ns()
    at = place_on_grid(stream.t_ref_ns, at_ns, period_ns=period_ns, max_gap_ns=3 * period_ns)
    return stream.values, at


def _true_joints(
    truth: EpisodeReader, side: Side, at_ns: np.ndarray
) -> tuple[Float64[np.ndarray, "n 20"], Bool[np.ndarray, " n"]]:
    if "joints_measured" not in truth.streams:
        keypoints, at = _placed(truth, f"keypoints_{side}", at_ns)
        return HandRetargeter(side).retarget(vectors_on_grid(keypoints, at)).joints_rad, at.valid
    joints_rad, at = _placed(truth, "joints_measured", at_ns)
    first = 0 if side == "left" else NUM_JOINTS
    return vectors_on_grid(joints_rad, at)[:, first : first + NUM_JOINTS], at.valid
