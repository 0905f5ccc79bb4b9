"""Errors of an aligned episode against the true episode that mock devices replayed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.episodes import StreamData
from dextouch.errors import InvalidInputError
from dextouch.geometry import nearest_index
from dextouch.hands.actions import HandTrajectory, poses_from_actions
from dextouch.hands.robot_hand import NUM_JOINTS, RobotHand
from dextouch.metrics import tactile
from dextouch.schemas import EpisodeAttributes
from dextouch.streams import StreamDescriptor
from dextouch.tactile import in_contact
from dextouch.tactile.layout import SIDES
from services.alignment.retargeting.hand_retargeter import HandRetargeter
from services.alignment.retargeting.wrist import pose_difference
from services.alignment.synchronization.resampling import (
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)

NS_PER_MS = 1e6
# How far apart a sample and its true one may be: around a known origin, and without one.
NEAR_NS = 60_000_000
FAR_NS = 1_500_000_000
MAX_COMPARED_SAMPLES = 400
# Another sample than the nearest is believed only if its values fit this much better: a hand at
# rest looks the same at every moment, up to noise.
CLEARLY_BETTER = 0.5


@runtime_checkable
class Episode(Protocol):
    """The part of `dextouch.episodes.EpisodeReader` that the comparison uses."""

    @property
    def attributes(self) -> EpisodeAttributes:
        """Domain, anchor, clock reports."""

    @property
    def streams(self) -> Mapping[str, StreamDescriptor]:
        """Descriptors by name."""

    def read(self, name: str) -> StreamData:
        """All samples of a stream."""


@dataclass(frozen=True)
class Match:
    """Correspondence of the samples of a stream with the true ones.

    `offset_ns` is episode time minus true time of each pair; `num_dropped` true samples between
    the first and the last pair have none.
    """

    index: Int64[np.ndarray, " n"]
    true_index: Int64[np.ndarray, " n"]
    offset_ns: Int64[np.ndarray, " n"]
    num_dropped: int

    @property
    def mean_offset_ns(self) -> float:
        """Mean offset in nanoseconds."""
        return float(self.offset_ns.mean())

    @property
    def rms_ms(self) -> float:
        """Standard deviation of the offset in milliseconds."""
        return float(np.std(self.offset_ns.astype(np.float64)) / NS_PER_MS)


def compare_with_truth(
    episode: Episode, truth: Episode, *, origin_in_truth_ns: int | None = None
) -> dict[str, Any]:
    """Errors of an episode against the truth episode that its mock devices replayed.

    Args:
        episode: made by alignment from the recording of the replay.
        truth: the replayed episode.
        origin_in_truth_ns: true time of the episode's time 0. With it `latency_error_ms` is
            absolute; without it the median stream is taken as exact.

    Returns:
        `clock_rms_ms` {stream: ms} without each stream's constant delay; `latency_ms` {stream:
        the delay, calibrated plus found}; `latency_error_ms` {stream: what calibration left};
        `num_dropped` {stream}; `taxel_iou` and `taxel_mae_kpa` over samples that arrived (None
        without gloves); `fingertip_error_mm`, `wrist_error_mm`, `wrist_error_deg`, means over
        the model grid; `origin_ms`.

    Raises:
        InvalidInputError: the two share no stream.
    """
    shared = [
        name
        for name, stream in episode.streams.items()
        if name in truth.streams and stream.unit != "action"
    ]
    if not shared:
        raise InvalidInputError(
            f"truth: the episode has {sorted(episode.streams)}, the truth "
            f"{sorted(truth.streams)}; expected common streams"
        )
    origin_ns = origin_in_truth_ns
    if origin_ns is None:
        found = [match_samples(episode, truth, n, 0, FAR_NS).mean_offset_ns for n in shared]
        origin_ns = -round(float(np.median(found)))
    matches = {name: match_samples(episode, truth, name, origin_ns, NEAR_NS) for name in shared}
    left = {name: (m.mean_offset_ns + origin_ns) / NS_PER_MS for name, m in matches.items()}
    known = {report.stream: report.latency_ms or 0.0 for report in episode.attributes.clocks}
    return {
        "clock_rms_ms": {name: match.rms_ms for name, match in matches.items()},
        "latency_ms": {name: known.get(name, 0.0) + error for name, error in left.items()},
        "latency_error_ms": left,
        "num_dropped": {name: match.num_dropped for name, match in matches.items()},
        "origin_ms": origin_ns / NS_PER_MS,
        **_taxel_errors(episode, truth, matches),
        **_pose_errors(episode, truth, origin_ns),
    }


def match_samples(
    episode: Episode, truth: Episode, name: str, origin_ns: int, reach_ns: int
) -> Match:
    """Match every sample with its true one, near in time and of similar values.

    A constant delay may be longer than a period, so shifts by whole periods, up to `reach_ns`, are
    tried too, and used if the values then match clearly better.
    """
    mine, true = episode.read(name), truth.read(name)
    period_ns = truth.streams[name].period_ns()
    num = round(reach_ns / period_ns)
    shifts_ns = [origin_ns + period_ns * shift for shift in sorted(range(-num, num + 1), key=abs)]
    differences = np.array([_difference(mine, true, shift_ns, period_ns) for shift_ns in shifts_ns])
    best = int(np.argmin(differences))
    if not differences[best] < CLEARLY_BETTER * differences[0]:
        best = 0
    return _pair(mine, true, shifts_ns[best])


def _difference(mine: StreamData, true: StreamData, shift_ns: int, period_ns: int) -> float:
    """Mean difference of values with the stream shifted; infinite without overlap."""
    step = max(1, len(mine) // MAX_COMPARED_SAMPLES)
    t_ns, values = mine.t_ref_ns[::step] + shift_ns, mine.values[::step].astype(np.float64)
    inside = (t_ns >= true.t_ref_ns[0] - period_ns) & (t_ns <= true.t_ref_ns[-1] + period_ns)
    if inside.sum() < len(t_ns) / 2:
        return float("inf")
    nearest = true.values[nearest_index(true.t_ref_ns, t_ns[inside])]
    return float(np.abs(values[inside] - nearest).mean())


def _pair(mine: StreamData, true: StreamData, shift_ns: int) -> Match:
    nearest = nearest_index(true.t_ref_ns, mine.t_ref_ns + shift_ns)
    index = np.flatnonzero(np.concatenate([[True], np.diff(nearest) > 0]))
    true_index = nearest[index]
    offset_ns = mine.t_ref_ns[index] - true.t_ref_ns[true_index]
    span = int(true_index[-1] - true_index[0]) + 1
    return Match(index, true_index, offset_ns, span - len(index))


def _taxel_errors(
    episode: Episode, truth: Episode, matches: Mapping[str, Match]
) -> dict[str, float | None]:
    pairs = [
        (
            episode.read(name).values[match.index].astype(np.float64),
            truth.read(name).values[match.true_index].astype(np.float64),
        )
        for name, match in matches.items()
        if episode.streams[name].kind == "tactile"
    ]
    if not pairs:
        return {"taxel_iou": None, "taxel_mae_kpa": None}
    mine, true = (np.concatenate(arrays) for arrays in zip(*pairs, strict=True))
    touched = bool((in_contact(mine) | in_contact(true)).any())
    iou = tactile.contact_iou(predicted_kpa=mine, true_kpa=true) if touched else None
    return {"taxel_iou": iou, "taxel_mae_kpa": tactile.mae(predicted_kpa=mine, true_kpa=true)}


def _pose_errors(episode: Episode, truth: Episode, origin_ns: int) -> dict[str, float]:
    action = episode.read("action")
    reached = poses_from_actions(action.values, episode.attributes.anchor.to_poses())
    at_ns = action.t_ref_ns + origin_ns
    distances, angles, tips = [], [], []
    for side in SIDES:
        mine = _of_side(reached, side)
        Ts_true, valid = _true_poses(truth, f"wrist_{side}", at_ns)
        distance, angle = pose_difference(mine[0][valid], Ts_true[valid])
        distances.append(distance)
        angles.append(angle)
        true_joints, valid = _true_joints(truth, side, at_ns)
        hand = RobotHand(side)
        apart = hand.fingertips_m(mine[1][valid]) - hand.fingertips_m(true_joints[valid])
        tips.append(np.linalg.norm(apart, axis=-1))
    return {
        "wrist_error_mm": float(np.concatenate(distances).mean() * 1e3),
        "wrist_error_deg": float(np.rad2deg(np.concatenate(angles).mean())),
        "fingertip_error_mm": float(np.concatenate(tips).mean() * 1e3),
    }


def _of_side(trajectory: HandTrajectory, side: str) -> tuple[np.ndarray, np.ndarray]:
    if side == "left":
        return trajectory.Ts_world_wrist_left, trajectory.joints_left_rad
    return trajectory.Ts_world_wrist_right, trajectory.joints_right_rad


def _true_poses(
    truth: Episode, name: str, at_ns: np.ndarray
) -> tuple[Float64[np.ndarray, "n 4 4"], np.ndarray]:
    stream, period_ns = truth.read(name), truth.streams[name].period_ns()
    at = place_on_grid(stream.t_ref_ns, at_ns, period_ns=period_ns, max_gap_ns=3 * period_ns)
    return poses_on_grid(stream.values, at), at.valid


def _true_joints(
    truth: Episode, side: str, at_ns: np.ndarray
) -> tuple[Float64[np.ndarray, "n 20"], np.ndarray]:
    """The robot's joints, or those retargeted from the true human hand."""
    is_robot = "joints_measured" in truth.streams
    name = "joints_measured" if is_robot else f"keypoints_{side}"
    stream, period_ns = truth.read(name), truth.streams[name].period_ns()
    at = place_on_grid(stream.t_ref_ns, at_ns, period_ns=period_ns, max_gap_ns=3 * period_ns)
    values = vectors_on_grid(stream.values, at)
    if not is_robot:
        return HandRetargeter(side).retarget(values).joints_rad, at.valid
    first = 0 if side == "left" else NUM_JOINTS
    return values[:, first : first + NUM_JOINTS], at.valid
