"""Leaves out what cannot be true in recorded poses, joints and keypoints, and refuses other units.

`dextouch.streams.plausibility` finds it; stations show the same live (docs/health.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, cast, get_args

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands import CHAINS, NUM_KEYPOINTS, chain_indices
from dextouch.schemas import Domain
from dextouch.streams import (
    Implausible,
    implausible_repeats,
    implausible_values,
    lasting_jumps,
)
from services.alignment.synchronization.recorded_streams import DatedStream
from services.alignment.synchronization.resampling import RefusedReason, runs_of, stream_gap_ns

# Steps in which hands are where heads look and arms reach, if quaternions are read rightly.
RIGHT_SHARE: Final = 0.9
WRONG_SHARE: Final = 0.3
ALWAYS_SHARE: Final = 0.98
MAX_VIEW_RAD: Final = np.radians(75.0)
# By so much a robot's wrist is behind its command.
MAX_LAG_RAD: Final = np.radians(30.0)
COMMANDED: Final = "_commanded"
MIN_ORDER_SAMPLES: Final = 60
LEAST_DISTANCE_M: Final = 1e-6


@dataclass(frozen=True)
class CheckedStream:
    """A stream without its implausible samples, and from when to when they were left out.

    `parts_ns` count on the host's clock.
    """

    stream: DatedStream
    parts_ns: tuple[tuple[int, int, RefusedReason], ...] = ()


def checked_stream(stream: DatedStream, *, max_gap_ns: int) -> CheckedStream:
    """Check one stream, and leave out what is implausible.

    Args:
        stream: of a recording.
        max_gap_ns: longest gap that is interpolated. Where a tracker found itself anew there will
            be a longer one, since nothing connects its worlds before and after.

    Raises:
        InvalidInputError: the whole stream is implausible (`details` has `fault` and `stream`).
    """
    kind, name = stream.descriptor.kind, stream.name
    if kind not in {"pose", "keypoints", "robot_state"} or len(stream.t_ns) < 2:
        return CheckedStream(stream)
    raw = replace(stream, convert=np.asarray).load().values
    recorded = stream.recording.streams[name]
    of_robot = stream.recording.attributes.domain == "robot"
    found = implausible_values(recorded, stream.t_ns, raw, of_robot=of_robot)
    for one in found:
        if one.whole:
            raise InvalidInputError(
                f"stream {name!r}: {one.message}; correct what sends them, and record again",
                fault=one.cause,
                stream=name,
            )
    stream, parts_ns = _left_out(stream, found)
    if kind == "pose" and not name.endswith(COMMANDED):
        return _cut_at_lasting_jumps(CheckedStream(stream, parts_ns), max_gap_ns)
    if kind == "keypoints" and raw.shape[1] == NUM_KEYPOINTS:
        stream = _without_frozen_fingers(stream)
    return CheckedStream(stream, parts_ns)


def check_quaternion_order(streams: Mapping[str, DatedStream], domain: Domain) -> None:
    """Refuse a head or a wrist whose quaternions are x, y, z, w.

    Heads are upright and look at the hands, a person's fingers point away from the head, and a
    robot's wrists turn as commanded: where that does not hold, but does once the columns are read
    in the other order, they are in it.

    Raises:
        InvalidInputError: names the stream.
    """
    names = ("head", "wrist_left", "wrist_right")
    if not all(name in streams for name in names):
        return
    t_ns = streams["head"].t_ns
    poses, others = (
        {name: _poses_at(streams[name], t_ns, order=order) for name in names}
        for order in ((3, 4, 5, 6), (6, 3, 4, 5))
    )
    for name in names[1:]:
        if name + COMMANDED in streams:
            commanded = _poses_at(streams[name + COMMANDED], t_ns, order=(3, 4, 5, 6))
            _compare_orders(
                name,
                "turned as commanded",
                *(_share_as_commanded(of[name], commanded) for of in (poses, others)),
            )
    shares = {
        name: tuple(_share_as_usual(name, {**poses, name: of[name]}) for of in (poses, others))
        for name in names
    }
    _compare_orders("head", "upright and sees the hands", *shares["head"])
    # Cameras may stand opposite a robot. A person's hand may turn to the face, but hardly all the
    # time; and trackers of one kind are read alike.
    wrists = [shares[name] for name in names[1:]]
    if domain == "human" and min(otherwise for _, otherwise in wrists) >= ALWAYS_SHARE:
        for name in names[1:]:
            if shares[name][0] <= 1 - ALWAYS_SHARE:
                _compare_orders(name, "pointing forward", *shares[name])


def _compare_orders(name: str, usual: str, as_read: float, otherwise: float) -> None:
    """Refuse a stream that is as usual only in the other order of its quaternions."""
    if as_read <= WRONG_SHARE and otherwise >= RIGHT_SHARE:
        raise InvalidInputError(
            f"stream {name!r}: {usual} in {as_read:.0%} of the samples, but in {otherwise:.0%} of "
            "them if its quaternions are x, y, z, w; expected w, x, y, z: correct the order where "
            "they are sent, and record again",
            fault="quaternion_order",
            stream=name,
        )


def _left_out(
    stream: DatedStream, found: list[Implausible]
) -> tuple[DatedStream, tuple[tuple[int, int, RefusedReason], ...]]:
    """The stream without these samples, and the stretches that they leave."""
    parts: list[tuple[int, int, RefusedReason]] = []
    left_out = np.zeros(len(stream.t_ns), dtype=bool)
    quality = dict(stream.quality)
    for one in found:
        name = f"{stream.name}_num_{one.cause}_samples"
        quality[name] = quality.get(name, 0.0) + float(one.samples.sum())
        if one.harmless:
            continue
        left_out |= one.samples
        if one.factor > 1:
            # It is a slower stream than it says.
            rate_hz = stream.descriptor.nominal_rate_hz / one.factor
            slower = stream.descriptor.model_copy(update={"nominal_rate_hz": rate_hz})
            stream = replace(stream, descriptor=slower)
        elif one.cause in get_args(RefusedReason):
            parts += _parts_ns(stream.t_ns, one.samples, cast("RefusedReason", one.cause))
    return replace(_only(stream, ~left_out), quality=quality), tuple(parts)


def _only(stream: DatedStream, kept: Bool[np.ndarray, " n"]) -> DatedStream:
    timing = stream.timing
    timing = replace(timing, kept=timing.kept[kept], t_host_ns=timing.t_host_ns[kept])
    return replace(stream, timing=timing)


def _parts_ns(
    t_ns: np.ndarray, samples: np.ndarray, reason: RefusedReason
) -> list[tuple[int, int, RefusedReason]]:
    """From the last sample before those that are wrong to the first one after them."""
    last = len(t_ns) - 1
    return [
        (int(t_ns[max(first - 1, 0)]), int(t_ns[min(stop, last)]), reason)
        for first, stop in runs_of(samples)
    ]


def _cut_at_lasting_jumps(checked: CheckedStream, max_gap_ns: int) -> CheckedStream:
    """Leave out samples around each jump of the tracker's world, so that nothing connects them."""
    stream = checked.stream
    loaded = stream.load()
    seen = np.isfinite(loaded.values).all(axis=1)
    t_ns, period_ns = loaded.t_ns[seen], stream.descriptor.period_ns()
    jumps = lasting_jumps(t_ns, loaded.values[seen], period_ns=period_ns)
    if not len(jumps):
        return checked
    reach_ns = stream_gap_ns(max_gap_ns, period_ns) // 2 + period_ns
    at_ns = (t_ns[jumps] + t_ns[jumps - 1]) // 2
    # Of the jumps around each sample the nearer one.
    after = np.searchsorted(at_ns, stream.t_ns).clip(max=len(at_ns) - 1)
    nearest = np.minimum(
        np.abs(stream.t_ns - at_ns[after]), np.abs(stream.t_ns - at_ns[np.maximum(after - 1, 0)])
    )
    near = nearest <= reach_ns
    quality = stream.quality | {f"{stream.name}_num_lasting_jumps": float(len(jumps))}
    parts_ns = (*checked.parts_ns, *_parts_ns(stream.t_ns, near, "jump"))
    return CheckedStream(replace(_only(stream, ~near), quality=quality), parts_ns)


def _without_frozen_fingers(stream: DatedStream) -> DatedStream:
    """The stream whose fingers are not seen while only they are frozen."""
    raw = replace(stream, convert=np.asarray).load().values
    frozen, unseen = np.zeros((2, *raw.shape[:2]), dtype=bool)
    for chain in CHAINS:
        nodes = np.array(chain_indices(chain))
        for one in implausible_repeats(raw[:, nodes], what=chain, may_lock=True):
            if one.cause == "frozen":
                frozen[np.ix_(one.samples, nodes)] = True
                unseen[np.ix_(one.samples, nodes)] = not one.harmless
    if not frozen.any():
        return stream
    quality = stream.quality | {f"{stream.name}_num_frozen_nodes": float(frozen.sum())}
    return replace(stream, unseen=unseen if unseen.any() else None, quality=quality)


def _poses_at(
    stream: DatedStream, t_ns: np.ndarray, order: tuple[int, ...]
) -> Float64[np.ndarray, "n 4 4"]:
    """Transforms of the samples nearest to these times, with quaternions in another order."""
    columns = [0, 1, 2, *order]
    loaded = replace(stream, convert=lambda raw: stream.convert(raw[:, columns])).load()
    seen = np.isfinite(loaded.values).all(axis=1)
    if not seen.any():
        return np.zeros((0, 4, 4))
    near = np.searchsorted(loaded.t_ns[seen], t_ns).clip(max=int(seen.sum()) - 1)
    return transform_from_pose(loaded.values[seen][near])


def _share_as_usual(name: str, Ts: Mapping[str, np.ndarray]) -> float:
    """Share of the samples in which the head sees the hands, or a hand points away from it."""
    if min(len(T) for T in Ts.values()) < MIN_ORDER_SAMPLES:
        return 0.0
    head, body = Ts["head"], Ts[name]
    if name != "head":
        # Fingers point along -z of the wrist.
        away_m = body[:, :3, 3] - head[:, :3, 3]
        return float((_cosines(away_m, -body[:, :3, 2]) > 0).mean())
    hands_m = (Ts["wrist_left"][:, :3, 3] + Ts["wrist_right"][:, :3, 3]) / 2
    sees = _cosines(hands_m - head[:, :3, 3], head[:, :3, 2]) > np.cos(MAX_VIEW_RAD)
    # Rows of images go down, and z of the world goes up.
    is_upright = head[:, 2, 1] < -np.cos(MAX_VIEW_RAD)
    return float((sees & is_upright).mean())


def _share_as_commanded(Ts: np.ndarray, commanded: np.ndarray) -> float:
    """Share of the samples in which a wrist is turned about as it was commanded."""
    if min(len(Ts), len(commanded)) < MIN_ORDER_SAMPLES:
        return 0.0
    apart_rad = rotation_angle(np.swapaxes(Ts[:, :3, :3], -1, -2) @ commanded[:, :3, :3])
    return float((apart_rad < MAX_LAG_RAD).mean())


def _cosines(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(some, axis=1) * np.linalg.norm(others, axis=1)
    return np.asarray((some * others).sum(axis=1) / np.maximum(lengths, LEAST_DISTANCE_M))
