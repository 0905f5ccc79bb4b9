"""Leaves out what cannot be true in recorded poses, joints and keypoints (docs/health.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast, get_args

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import nearest_index
from dextouch.schemas import Domain
from dextouch.streams import (
    BODIES,
    COMMANDED,
    Implausible,
    implausible_bodies,
    implausible_values,
    lasting_jumps,
)
from services.alignment.synchronization.recorded_streams import DatedStream
from services.alignment.synchronization.resampling import RefusedReason, runs_of, stream_gap_ns


@dataclass(frozen=True)
class CheckedStream:
    """A stream without its implausible samples, and from when to when, on the host's clock."""

    stream: DatedStream
    parts_ns: tuple[tuple[int, int, RefusedReason], ...] = ()


def checked_stream(stream: DatedStream, *, max_gap_ns: int) -> CheckedStream:
    """Check one stream, and leave out what is implausible.

    Where a tracker found itself anew, a gap is made longer than `max_gap_ns`, the longest that is
    interpolated. Raises InvalidInputError: the whole stream is implausible (`details`).
    """
    kind, name = stream.descriptor.kind, stream.name
    if stream.implausible:
        return CheckedStream(*_left_out(stream, list(stream.implausible)))
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
    stream = _without_nodes(stream, found)
    stream, parts_ns = _left_out(stream, [one for one in found if one.nodes is None])
    if kind == "pose" and not name.endswith(COMMANDED):
        return _cut_at_lasting_jumps(CheckedStream(stream, parts_ns), max_gap_ns)
    return CheckedStream(stream, parts_ns)


def check_bodies(streams: Mapping[str, DatedStream], domain: Domain) -> None:
    """Refuse a head and wrists that cannot be those of one body; raises InvalidInputError."""
    if not all(name in streams for name in BODIES):
        return
    t_ns = streams["head"].t_ns
    names = (*BODIES, *(name for name in streams if name.endswith(COMMANDED)))
    bodies = {n: streams[n] for n in names if n in streams and streams[n].descriptor.kind == "pose"}
    poses = {name: _poses_at(stream, t_ns) for name, stream in bodies.items()}
    to_body = {name: stream.convert for name, stream in bodies.items()}
    found = implausible_bodies(poses, to_body, of_robot=domain == "robot")
    if found is not None:
        raise InvalidInputError(
            f"stream {found.stream!r}: {found.message}, and record again",
            fault=found.cause,
            stream=found.stream,
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
    unseen = None if stream.unseen is None else stream.unseen[kept]
    return replace(stream, timing=timing, unseen=unseen)


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


def _without_nodes(stream: DatedStream, found: list[Implausible]) -> DatedStream:
    """The stream whose keypoints are not seen while only some of them are frozen."""
    ofs = [one for one in found if one.nodes is not None]
    if not ofs:
        return stream
    count = float(sum(one.nodes.sum() for one in ofs if one.nodes is not None))
    quality = stream.quality | {f"{stream.name}_num_frozen_nodes": count}
    lost = [one.nodes for one in ofs if not one.harmless]
    return replace(stream, unseen=lost[0] if lost else None, quality=quality)


def _poses_at(stream: DatedStream, t_ns: np.ndarray) -> Float64[np.ndarray, "n 7"]:
    """Poses as they were sent, of the samples nearest to these times."""
    raw = replace(stream, convert=np.asarray).load()
    poses = raw.values.astype(np.float64)
    seen = np.isfinite(poses).all(axis=1) & (np.linalg.norm(poses[:, 3:], axis=1) > 0)
    return poses[seen][nearest_index(raw.t_ns[seen], t_ns)] if seen.any() else poses[:0]
